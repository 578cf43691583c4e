"""Vehicles that stop, and vehicles that are parked at a sensor when the nodes start.

Stops of 5, 20 and 60 s are simulated, and departures of a vehicle that is present at the start. The
figures are the fraction of runs in which one track continues after the stop (aim: 90 %), the
fraction of runs in which the backgrounds are correct within 3 s after the departure (aim: all), and
the results for the next vehicle, offline (aims: all tracked, no wrong pose without a flag).
"""

import argparse
import sys
from functools import partial

import numpy as np

from bench.figures import Figures
from bench.two_simulators import count_over
from support.standing import (
    MAX_RECOVERY_S,
    STOPS,
    TRACKED_M,
    background_recovery_s,
    error_after_parked,
    is_one_track,
)

RUNS = 20


def run_case(case, run):
    """Call the function of a case in `support.standing` for run number `run`; return its result."""
    if case == 'stops':
        return is_one_track(STOPS[run % len(STOPS)], run // len(STOPS))
    return background_recovery_s(run) if case == 'leaves' else error_after_parked(run)


def summary(figures, case, found):
    """Record the figures of one case; return a line and whether the aim is met."""
    n = len(found)
    if case == 'stops':
        figures.record('stopped for 5, 20 and 60 s: runs with one track', sum(found) / n, '', 0.9,
                       True, note=f'{n} runs')
        return (f'stopped for 5, 20 and 60 s: in {sum(found)} of {n} runs the same track continues '
                'and departs (aim 90 %)', sum(found) >= 0.9 * n)
    if case == 'leaves':
        n_in_time = sum(s <= MAX_RECOVERY_S for s in found)
        figures.record(f'present at the start: correct background within {MAX_RECOVERY_S:g} s',
                       n_in_time / n, '', 1.0, True, note=f'{n} runs')
        return (f'present at the start: in {n_in_time} of {n} runs the background is correct '
                f'within {MAX_RECOVERY_S:g} s after the departure, median {np.median(found):.1f} s '
                '(aim all)', n_in_time == n)
    tracked = sum(error < TRACKED_M for error, *_ in found)
    unflagged, wrong = (sum(f[k] for f in found) for k in (1, 2))
    figures.record('first vehicle afterwards, offline: tracked', tracked / n, '', 1.0, True,
                   note=f'{n} runs')
    figures.record('first vehicle afterwards, offline: wrong poses without a flag', wrong, '', 0,
                   note=f'of {unflagged}')
    return (f'first vehicle afterwards, offline: tracked in {tracked} of {n} runs (aim all), '
            f'{wrong} of {unflagged} poses without a flag are wrong (aim none)',
            tracked == n and not wrong)


def main():
    """Print a line for each case; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--runs', type=int, default=RUNS)
    args = parser.parse_args()
    figures = Figures('standing')
    status = count_over([('stops',), ('leaves',), ('first',)], run_case, args.runs,
                        partial(summary, figures))
    figures.save()
    return status


if __name__ == '__main__':
    sys.exit(main())
