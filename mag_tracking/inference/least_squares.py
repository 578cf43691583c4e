"""Non-linear least squares from many starts at once.

The model comes in as a function or an object, so that this file is mathematics only.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.matrices import ignoring_overflow, pseudo_inverse

ResidualAndJacobian: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Takes points (n, n_x), returns residuals (n, n_y) and Jacobians (n, n_y, n_x)."""

CORRELATION_TIME_S = 0.2
"""[s] What a model leaves out of a vehicle is alike for so long: a car's length at 20 m/s."""


def refine(residual_and_jacobian: ResidualAndJacobian, x: ArrayLike, n_iterations: int = 40,
           tolerance: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Levenberg-Marquardt on many starts at once, each with its own damping.

    Parameters
    ----------
    residual_and_jacobian : function
        Takes (n, n_x), returns whitened residuals (n, n_y) (measured minus
        predicted) and the Jacobians (n, n_y, n_x) of the prediction.
    x : (n, n_x)
        Starts.
    n_iterations : int
    tolerance : float
        A start is done, too, when a step makes its cost smaller by less than this share of it.

    Returns
    -------
    x : (n, n_x)
    cost : (n,)
        Sum of squared whitened residuals; infinite where a start is unusable.
    covariance : (n, n_x, n_x)
        Pseudo-inverse of the information at x.
    converged : (n,) bool
        Done before the iterations were used up, and not because no damping helped.

    Source: T10 section 2.3, Alg. 1.
    """
    x = np.array(x, dtype=float)
    residual, J, cost = _evaluate(residual_and_jacobian, x)
    damping = np.full(len(x), 1e-3)
    converged = np.zeros(len(x), dtype=bool)
    busy = np.flatnonzero(np.isfinite(cost))
    for _ in range(n_iterations):
        if not len(busy):
            break
        step = _damped_step(J[busy], residual[busy], damping[busy])
        trial = x[busy] + step
        trial_residual, trial_J, trial_cost = _evaluate(residual_and_jacobian, trial)
        better = trial_cost < cost[busy]
        gain = cost[busy] - trial_cost
        done = (np.abs(step) <= 1e-10 * np.abs(x[busy])).all(axis=1)
        done |= better & (gain <= tolerance * cost[busy])
        moved = busy[better]
        x[moved], cost[moved] = trial[better], trial_cost[better]
        residual[moved], J[moved] = trial_residual[better], trial_J[better]
        damping[busy] *= np.where(better, 0.2, 5.0)
        converged[busy[done]] = True
        busy = busy[~done & (damping[busy] < MAX_DAMPING)]
    return x, cost, pseudo_inverse(np.einsum('nyi,nyj->nij', J, J)), converged


MAX_DAMPING = 1e12
"""Steps that are so small and still lead uphill lead nowhere."""


def _damped_step(J: FloatArray, residual: FloatArray, damping: FloatArray) -> FloatArray:
    """Steps (n, n_x) of Levenberg and Marquardt."""
    Jt = np.swapaxes(J, 1, 2)
    information = Jt @ J
    # Marquardt's scaling: damping is relative to each parameter's own information.
    diagonal = np.einsum('nii->ni', information)
    A = information + (damping[:, None] * diagonal)[:, :, None] * np.eye(J.shape[2])
    step: FloatArray = np.einsum('nij,nj->ni', pseudo_inverse(A),
                                 np.einsum('nij,nj->ni', Jt, residual))
    return step


def _evaluate(residual_and_jacobian: ResidualAndJacobian, x: FloatArray
              ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals, Jacobians and costs; an unusable point costs infinity."""
    with ignoring_overflow():
        residual, J = residual_and_jacobian(x)
        cost = np.einsum('ni,ni->n', residual, residual)
    bad = ~(np.isfinite(cost) & np.isfinite(J).all(axis=(1, 2)))
    residual[bad], J[bad], cost[bad] = 0.0, 0.0, np.inf
    return residual, J, cost


def project_out_linear(A: FloatArray, y: FloatArray
                       ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Best linear parameters of many linear models y = A p + e, e ~ N(0, I).

    Parameters
    ----------
    A : (n, n_y, k)
    y : (n_y,)

    Returns
    -------
    p : (n, k)
        Zero in directions that A hardly has (`LINEAR_RANK`).
    residual : (n, n_y)
        y - A p.
    inverse : (n, k, k)
        Pseudo-inverse of A'A.
    """
    At = np.swapaxes(A, 1, 2)
    inverse = pseudo_inverse(At @ A, LINEAR_RANK_TOLERANCE)
    p = np.einsum('nij,nj->ni', inverse, At @ y)
    return p, y - np.einsum('nyi,ni->ny', A, p), inverse


LINEAR_RANK_TOLERANCE = 1e-11
"""Dipoles that are almost at one place would cancel each other with moments without bounds."""


def score_sum_covariance(scores: FloatArray, lag: int) -> FloatArray:
    """Covariance of the sum of scores that are correlated over some neighbours.

    Parameters
    ----------
    scores : (n, n_x)
        Gradient of each sample's cost at the minimum, in order of time.
    lag : int
        Samples that are further apart are taken for independent.

    Returns
    -------
    (n_x, n_x)
        Positive semidefinite. Where model and noise are right it is the information, about.

    Source: Newey and West 1987, with Bartlett's weights.
    """
    S = scores.T @ scores
    for k in range(1, min(lag, len(scores) - 1) + 1):
        pairs = scores[k:].T @ scores[:-k]
        S += (1.0 - k / (lag + 1.0)) * (pairs + pairs.T)
    return S


def model_error_covariance(t: Sequence[FloatArray], derivatives: Sequence[FloatArray],
                        left: Sequence[FloatArray], covariance: FloatArray) -> FloatArray:
    """What must be added to a covariance for what a model leaves out.

    The residuals then are no noise: they are alike for a while, and count for less than their
    number. Nothing is taken away where chance made them look less than noise.

    Parameters
    ----------
    t, derivatives, left : of each sensor (n,) [s], (n, k, n_x), (n, k)
        Times in order; whitened derivatives and residuals.
    covariance : (n_x, n_x)
        By noise alone.

    Returns
    -------
    (n_x, n_x)
        NaN where a variance is infinite.
    """
    scale = np.sqrt(np.diagonal(covariance))
    excess = np.zeros_like(covariance)
    for times, H, r in zip(t, derivatives, left, strict=True):
        columns = H * scale
        step = np.median(np.diff(times)) if len(times) > 1 else CORRELATION_TIME_S
        excess += score_sum_covariance(np.einsum('nai,na->ni', columns, r),
                                    int(CORRELATION_TIME_S / max(step, 1e-9)))
        excess -= np.einsum('nai,naj->ij', columns, columns)
    if not np.isfinite(excess).all():
        return np.full_like(covariance, np.nan)
    w, V = np.linalg.eigh(excess)
    root = (covariance / np.outer(scale, scale)) @ (V * np.sqrt(np.maximum(w, 0.0)))
    missing: FloatArray = np.outer(scale, scale) * (root @ root.T)
    return missing
