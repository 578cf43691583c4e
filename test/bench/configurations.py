"""Wrong poses without a flag if sensors or the network file are wrong.

Each wrong configuration of two sensors beside a road, and each healthy one, is tracked live while
a car passes, with equal passes in all configurations. At most 2 % of the unflagged poses of a wrong
configuration may be wrong. Of the right poses of a healthy configuration, as many as possible must
be unflagged.
"""

import argparse
import sys
from functools import partial

from bench.figures import Figures
from bench.two_simulators import count_over
from support.configurations import CONFIGURATIONS, Poses, tracked_poses
from support.random_passes import SIMULATORS

MAX_WRONG = 0.02


def poses_of_run(name, run):
    """Return the `Poses` of a run; even and odd runs use different simulators."""
    return tracked_poses(name, SIMULATORS[run % 2], run // 2)


def summary(figures, name, found):
    """Record the figures of a configuration; return its table row and whether the aim is met."""
    total = sum(found, Poses())
    share = total.wrong / max(total.unflagged, 1)
    met = not figures.record(f'{name}: unflagged and wrong', 100.0 * share, '%',
                             100.0 * MAX_WRONG, note=f'{total.wrong} of {total.unflagged}')
    if CONFIGURATIONS[name].is_healthy:
        figures.record(f'{name}: unflagged among the right poses',
                       100.0 * (total.unflagged - total.wrong) / max(total.right, 1), '%',
                       more_is_better=True)
    return (f'| {name} | {total.n} | {total.right} | {total.unflagged} | {total.wrong} '
            f'({share:.1%}) | {total.smoothed} | {total.smoothed_wrong} |'
            f'{"" if met else " missed"}', met)


def main():
    """Print a row for each configuration; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--runs', type=int, default=6, help='number of runs per simulator')
    parser.add_argument('--only', nargs='+', default=list(CONFIGURATIONS),
                        choices=list(CONFIGURATIONS), metavar='CONFIGURATION')
    args = parser.parse_args()
    figures = Figures('configurations')
    print('| configuration | poses | right | unflagged | wrong among these | smoothed, unflagged | '
          'wrong among these |\n|---|---|---|---|---|---|---|')
    status = count_over([(name,) for name in args.only], poses_of_run, 2 * args.runs,
                        partial(summary, figures))
    if args.only == list(CONFIGURATIONS):
        figures.save()
    return status


if __name__ == '__main__':
    sys.exit(main())
