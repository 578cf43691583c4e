"""Effect of ten open live pages on the latency, with 100 sensors at 100 Hz.

    PYTHONPATH=test python -m bench.pages

`bench.load` runs alternately with and without the pages, because the load of the machine varies.
The figure is the ratio of the 99 % quantiles of the latency. The aim is a ratio of at most 1.1
without losses; otherwise the exit status is 1.
"""

import argparse
import sys

import numpy as np

from bench.figures import Figures
from bench.load import measure

PAGES, MAX_WORSE = 10, 1.10


def main():
    """Print the ratio; return 1 if the aim is missed or if there were losses."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--minutes', type=float, default=1.0)
    args = parser.parse_args()
    p99, has_losses = {0: [], PAGES: []}, False
    for k in range(args.rounds):
        for n in (0, PAGES) if k % 2 == 0 else (PAGES, 0):
            print(f'--- round {k + 1}, {n} pages', flush=True)
            found = measure(argparse.Namespace(
                sensors=100, minutes=args.minutes, batches=False, one_process=False, lean=False,
                sequential=False, pages=n))
            if found is None:
                return 1
            p99[n].append(found[0])
            has_losses |= found[1]
    without, with_pages = np.median(p99[0]), np.median(p99[PAGES])
    print(f'99 % quantile of the latency: {without:.1f} ms without pages, '
          f'{with_pages:.1f} ms with {PAGES} pages; ratio {with_pages / without:.2f} '
          f'(aim {MAX_WORSE}); {"with" if has_losses else "without"} losses')
    figures = Figures('pages')
    figures.record(f'99 % latency with {PAGES} pages over that without', with_pages / without,
                   'times', MAX_WORSE)
    figures.save()
    return int(has_losses or not with_pages <= MAX_WORSE * without)


if __name__ == '__main__':
    sys.exit(main())
