"""Random trucks, cars and turning cars from two simulators of different structure.

Passes of each kind from each simulator are tracked with two sensors at 100 Hz. The figures are the
fraction of unflagged poses that are wrong, filtered and smoothed, the normalised
errors and the errors of the speed. The aims are at most 1 % of such poses, a mean NEES per axis
within 5 m of at most 5 for trucks and 2.5 for cars, and 90 % of the speeds within 10 %.
"""

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np
from tqdm import tqdm

from bench.figures import Figures
from support.random_passes import KINDS, SIMULATORS, one_random_pass

MAX_NEES = {'truck': 5.0, 'car': 2.5, 'turning': 2.5}
MAX_WRONG, MIN_SPEED = 0.01, 0.9


def fraction_of_wrong(found):
    """Count the unflagged poses of [`Tracked`]; return (number, fraction of wrong poses)."""
    n_unflagged = sum(int((~f.ambiguous).sum()) for f in found)
    return n_unflagged, sum(int(f.unflagged_and_wrong.sum()) for f in found) / max(n_unflagged, 1)


def count_over(products, one_pass, n, summary):
    """Run `n` passes of each of `products`, print its summary; return 1 if an aim is missed."""
    met = True
    with ProcessPoolExecutor(max(1, min(4, os.cpu_count() or 1))) as pool:
        jobs = {p: [pool.submit(one_pass, *p, seed) for seed in range(n)] for p in products}
        for product, passes in jobs.items():
            found = [job.result() for job in tqdm(passes, desc=', '.join(product), disable=None,
                                                  leave=False)]
            line, is_met = summary(*product, found)
            print(line, flush=True)
            met &= is_met
    return 0 if met else 1


def summary(figures, simulator, kind, found):
    """Record the figures of one kind and simulator; return a line and whether the aims are met."""
    passes = [f for f in found if (~f.ambiguous).any()]
    near = [~f.ambiguous & (f.distance < 5.0) for f in passes]
    nees = np.array([f.nees[rows].mean() for f, rows in zip(passes, near, strict=True)
                     if rows.any()])
    closest = [f.error[np.argmin(f.distance)] for f in passes]
    speed_ratio = np.array([f.speed_ratio for f in found])
    within = np.mean(np.abs(speed_ratio - 1.0) < 0.1)
    n_unflagged, rate = fraction_of_wrong(passes)
    n_smoothed = sum(f.smoothed_unflagged for f in found)
    smoothed = sum(f.smoothed_wrong for f in found) / max(n_smoothed, 1)
    name = f'{simulator}, {kind}'
    missed = [
        figures.record(f'{name}: unflagged and wrong', 100.0 * rate, '%', 100.0 * MAX_WRONG,
                       note=f'of {n_unflagged} poses'),
        figures.record(f'{name}: NEES per axis within 5 m, mean', nees.mean(), '', MAX_NEES[kind]),
        figures.record(f'{name}: speed within 10 %', 100.0 * within, '%', 100.0 * MIN_SPEED, True)]
    figures.record(f'{name}: median error at the closest point', np.median(closest), 'm')
    figures.record(f'{name}: smoothed, unflagged and wrong', 100.0 * smoothed, '%',
                   note=f'of {n_smoothed} poses')
    met = not any(missed)
    return (f'  {simulator}, {kind}: {len(passes)} of {len(found)} with unflagged '
            f'poses; {n_unflagged} such poses, unflagged and wrong {rate:.1%} (aim 1 %), in '
            f'{sum(f.unflagged_and_wrong.any() for f in passes)} passes; within 5 m NEES per '
            f'axis mean {nees.mean():.1f} (aim {MAX_NEES[kind]:.1f}), median '
            f'{np.median(nees):.1f}; speed '
            f'within 10 % in {within:.0%} (aim 90 %); at the closest point median '
            f'{np.median(closest):.2f} m; of {n_smoothed} unflagged smoothed poses '
            f'{smoothed:.1%} unflagged and wrong{"" if met else "  MISSED"}', met)


def main():
    """Print a line for each kind of each simulator; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--passes', type=int, default=40)
    n = parser.parse_args().passes
    print(f'{n} random passes of each kind of each simulator, two sensors, 100 Hz')
    figures = Figures('two_simulators')
    status = count_over([(s, k) for s in SIMULATORS for k in KINDS], one_random_pass, n,
                        partial(summary, figures))
    figures.save()
    return status


if __name__ == '__main__':
    sys.exit(main())
