"""Batch fit of a pass: fraction of global optima found, and duration.

Random passes of rows of one, two and three dipoles are simulated at 100 Hz, along the road and with
any heading. The optimum is found if the cost is not above the minimum at the truth (aim: 99 %). The
time includes the whole fit, with search and covariance. The baseline is
`scipy.optimize.least_squares` (x_scale='jac', otherwise defaults), which estimates all unknowns of
the same compiled model. Its two runs start from a plausible guess and from the best of the 432
starting points of the search. Runs of both methods alternate.
"""

import sys
import time

import numpy as np
from scipy.optimize import least_squares
from tqdm import tqdm

from bench.figures import Figures
from mag_tracking.analysis.pass_data import background_columns, separable_problem
from mag_tracking.analysis.pass_fit import fit_pass, starting_paths
from mag_tracking.inference.least_squares import refine
from mag_tracking.physics.passes import RowPass
from support.passes import NOISE, ROAD, measured, random_path


def timed(function, *args, **kwargs):
    """Call a function; return (result, duration [s])."""
    start = time.perf_counter()
    return function(*args, **kwargs), time.perf_counter() - start


def fit_one_pass(seed, n_dipoles, road, compared=True):
    """Fit one pass; return (is optimal, duration [s] of the fit, two durations [s] of scipy).

    scipy runs twice: from a plausible guess, and from the best start of the search. Both durations
    are NaN unless `compared`.
    """
    rng = np.random.default_rng([seed, n_dipoles, road])
    path, moments = random_path(rng, n_dipoles, road)
    data = measured(ROAD, path, moments, rng)

    def create_model(t, positions, M):
        return RowPass(t, positions, M, n_dipoles)

    fit, duration = timed(fit_pass, data, n_dipoles)
    problem = separable_problem(data, create_model)
    _, truth, _, _ = refine(problem.residual_and_jacobian, path[None], 100, 1e-8)
    found = fit.cost <= truth[0] * (1.0 + 1e-6)
    if not compared:
        return found, duration, np.nan, np.nan
    model = RowPass(data.t, data.positions, data.whitening, n_dipoles)
    columns, y = background_columns(data, data.whitening), (data.field / NOISE).ravel()
    first = len(path)

    def residual(x):
        p = x[first:first + 3 * n_dipoles]
        return y - model.basis(x[None, :first])[0] @ p - columns @ x[first + 3 * n_dipoles:]

    starts = starting_paths(data, n_dipoles)
    guess = np.array([0.0, 0.0, 0.5, 10.0, 0.0, 0.0, 3.0])[:first]
    guess[:3] -= data.t[np.argmax(np.square(data.field_change).sum(axis=1))] * guess[3:6]
    seconds = []
    for start in (guess, starts[np.argmin(problem.cost(starts))]):
        x0 = np.concatenate([start, problem.linear(start), np.zeros(columns.shape[1])])
        seconds.append(timed(least_squares, residual, x0, x_scale='jac')[1])
    return found, duration, *seconds


def main(n=200, n_compared=40):
    """Print a line for each kind of pass and number of dipoles."""
    print(f'{n} random passes each: global optimum found; time of the whole fit, compared with '
          f'scipy for {n_compared} of them')
    figures = Figures('pass_search')
    fit_one_pass(0, 1, True)
    for road in (True, False):
        for n_dipoles in (1, 2, 3):
            rows = np.array([fit_one_pass(seed, n_dipoles, road, seed < n_compared)
                             for seed in tqdm(range(n), disable=None, leave=False)], dtype=float)
            ours, guess, best = rows[:n_compared, 1:].mean(axis=0)
            m_ours, m_guess, m_best = np.median(rows[:n_compared, 1:], axis=0)
            name = f'{"road" if road else "any heading"}, {n_dipoles} dipoles'
            figures.record(f'{name}: global optimum found', 100.0 * rows[:, 0].mean(), '%', 99.0,
                           True)
            figures.record(f'{name}: time of a fit', 1e3 * ours, 'ms')
            figures.record(f'{name}: time over scipy from a guess', ours / guess, 'times')
            figures.record(f'{name}: time over scipy from the best start', ours / best, 'times')
            print(f'  {name}: '
                  f'{rows[:, 0].mean():.1%}; {1e3 * ours:.0f} ms, ratio to scipy: '
                  f'{ours / guess:.2f} from a guess (median {m_ours / m_guess:.2f}), '
                  f'{ours / best:.2f} from the best start (median {m_ours / m_best:.2f})',
                  flush=True)
    figures.save()
    return 0


if __name__ == '__main__':
    sys.exit(main())
