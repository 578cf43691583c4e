"""`make bench`: vehicles that stop, and one that stood there when the nodes were started."""

import argparse
import sys
from functools import partial

import numpy as np

from bench.figures import Figures
from bench.two_simulators import count_over
from support.standing import SOON_S, STOPS, TRACKED_M, first_after, goes_on, right_after

RUNS = 20


def one(what, run):
    """Result of a run of `support.standing`."""
    if what == 'stops':
        return goes_on(STOPS[run % len(STOPS)], run // len(STOPS))
    return right_after(run) if what == 'leaves' else first_after(run)


def summary(figures, what, found):
    """(line, whether it is as good as it has to be)."""
    n = len(found)
    if what == 'stops':
        figures.keep('stopped for 5, 20 and 60 s: runs with one track', sum(found) / n, '', 0.9,
                     True, note=f'{n} runs')
        return (f'stopped for 5, 20 and 60 s: in {sum(found)} of {n} runs the same track goes on '
                'and leaves (aim 90 %)', sum(found) >= 0.9 * n)
    if what == 'leaves':
        soon = sum(s <= SOON_S for s in found)
        figures.keep(f'stood at the start: background right within {SOON_S:g} s', soon / n, '', 1.0,
                     True, note=f'{n} runs')
        return (f'stood there at the start: in {soon} of {n} runs the background is right within '
                f'{SOON_S:g} s of its leaving, at the median after {np.median(found):.1f} s '
                '(aim all)', soon == n)
    tracked = sum(error < TRACKED_M for error, *_ in found)
    sure, wrong = (sum(f[k] for f in found) for k in (1, 2))
    figures.keep('first vehicle afterwards, offline: tracked', tracked / n, '', 1.0, True,
                 note=f'{n} runs')
    figures.keep('first vehicle afterwards, offline: wrong poses without a flag', wrong, '', 0,
                 note=f'of {sure}')
    return (f'the first vehicle after it, offline: tracked in {tracked} of {n} runs, {wrong} of '
            f'{sure} poses without a flag wrong (aim all, none)', tracked == n and not wrong)


def main():
    """Print a line for each question; returns 1 where an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--runs', type=int, default=RUNS)
    given = parser.parse_args()
    figures = Figures('standing')
    status = count_over([('stops',), ('leaves',), ('first',)], one, given.runs,
                        partial(summary, figures))
    figures.save()
    return status


if __name__ == '__main__':
    sys.exit(main())
