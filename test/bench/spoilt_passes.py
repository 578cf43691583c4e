"""Wrong poses in random passes, for each of several sensor and stream faults.

Each pass is simulated by one of two simulators, modified by one fault and tracked live with two
sensors at 100 Hz, without a prescan. The figures are the fraction of tracked passes, and the
fraction of unflagged poses that are wrong. The aim is at most 1 % of such poses. A
flagged or missing track is not an error.
"""

import argparse
import sys
from functools import partial

from bench.figures import Figures
from bench.two_simulators import MAX_WRONG, count_over, fraction_of_wrong
from support import spoiler
from support.dense_traffic import dense_traffic
from support.random_passes import KINDS, SIMULATORS, one_random_pass
from support.spoilt_runs import MIN_HEADING_COSINE

FAULTS = {
    'none': (),
    'steps of 0.1 uT': (spoiler.steps, 1e-7),
    'steps of 0.3 uT': (spoiler.steps, 3e-7),
    'stated noise of 0.1 T': (spoiler.covariance, 1e-2),
    'glitches of 50 uT, 0.2 %': (spoiler.glitches, 2e-3, 5e-5),
    'clipped at half its peak': (spoiler.clipped, 0.5),
    'axes x and z only': (spoiler.only_axes, 'xz'),
    '30 % lost': (spoiler.dropped, 0.3),
    'one in four (25 Hz)': (spoiler.thinned, 4),
    'one clock 50 ms late': (spoiler.delayed, 'mag_2', 0.05),
    'one axis flipped': (spoiler.wrong_sign, 'mag_2', 'y'),
    'hum of 0.2 uT': (spoiler.hum, (2e-7, 2e-7, 2e-7)),
    'drift of 10 nT/s': (spoiler.drift, 1e-8),
    'temperature step of 0.3 uT': (spoiler.temperature_step, 3e-7, 4.0),
    'beginning cut by 5 s': (spoiler.beginning_cut, 5.0),
    'dense traffic for 5 s': (dense_traffic, 5.0),
}
"""{fault: (function that returns the fault, its arguments)}."""


def faults_of(stream_fault):
    """Functions that apply the fault `stream_fault` of `FAULTS` to `Readings`.

    The list is empty for 'none'.
    """
    if not FAULTS[stream_fault]:
        return []
    fault, *arguments = FAULTS[stream_fault]
    return [fault(*arguments)]


def faulty_pass(stream_fault, simulator, kind, seed):
    """Track a random pass with a fault of `FAULTS`; return its `Tracked`."""
    return one_random_pass(simulator, kind, seed, faults=faults_of(stream_fault))


def summary(figures, stream_fault, simulator, kind, found):
    """Record the figures of one combination; return a line and whether the aim is met."""
    n_unflagged, rate = fraction_of_wrong(found)
    n_tracked = sum(len(f.error) > 0 for f in found)
    n_tracked_right = sum(bool(f.heading > MIN_HEADING_COSINE) for f in found)
    met = not figures.record(f'{stream_fault}; {simulator}, {kind}: unflagged and wrong',
                             100.0 * rate, '%', 100.0 * MAX_WRONG,
                             note=f'of {n_unflagged} poses')
    figures.record(f'{stream_fault}; {simulator}, {kind}: tracked',
                   n_tracked / len(found), '', None, True)
    return (f'  {stream_fault:27s} {simulator}, {kind}: {sum(f.detected for f in found):2d} of '
            f'{len(found)} detected, {n_tracked:2d} tracked, {n_tracked_right:2d} in the right '
            f'direction; {sum((~f.ambiguous).any() for f in found):2d} with unflagged poses, '
            f'unflagged and wrong {rate:5.1%} in '
            f'{sum(f.unflagged_and_wrong.any() for f in found)} passes'
            f'{"" if met else "  MISSED"}', met)


def main():
    """Print a line for each combination; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--passes', type=int, default=8)
    parser.add_argument('--kinds', nargs='+', choices=KINDS, default=['car'])
    args = parser.parse_args()
    print(f'{args.passes} random passes of each combination, two sensors, 100 Hz; the aim is at '
          f'most {MAX_WRONG:.0%} unflagged and wrong')
    figures = Figures('spoilt_passes')
    status = count_over([(w, s, k) for w in FAULTS for s in SIMULATORS for k in args.kinds],
                        faulty_pass, args.passes, partial(summary, figures))
    figures.save()
    return status


if __name__ == '__main__':
    sys.exit(main())
