"""Non-linear least squares from many starting points in parallel.

A model is a function that returns residuals and Jacobians.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.matrices import ignoring_overflow, pseudo_inverse

ResidualAndJacobian: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Function of points (n, n_x) that returns residuals (n, n_y) and Jacobians (n, n_y, n_x)."""

CORRELATION_TIME_S = 0.2
"""Correlation time of the model error of a vehicle [s]: a car length at 20 m/s."""


def refine(residual_and_jacobian: ResidualAndJacobian, x: ArrayLike, n_iterations: int = 40,
           tolerance: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Minimise a sum of squares by Levenberg-Marquardt from many starting points in parallel.

    Each starting point has its own damping.

    Parameters
    ----------
    residual_and_jacobian : callable
        Function of points (n, n_x) that returns whitened residuals (n, n_y), measured minus
        predicted, and the Jacobians (n, n_y, n_x) of the prediction.
    x : (n, n_x) array
        Starting points.
    n_iterations : int
        Maximum number of iterations.
    tolerance : float
        A search has converged if one step decreases the cost by at most this fraction.

    Returns
    -------
    x : (n, n_x) array
        Final points.
    cost : (n,) array
        Sum of squared whitened residuals; infinite if the model is not finite at a starting point.
    covariance : (n, n_x, n_x) array
        Pseudo-inverse of the information at `x`.
    converged : (n,) bool array
        Whether the step or the decrease of the cost became negligible within `n_iterations`. False
        if no damping below `MAX_DAMPING` decreases the cost.

    References
    ----------
    [T10]_ section 2.3, Alg. 1.
    """
    x = np.array(x, dtype=float)
    residual, J, cost = _evaluate(residual_and_jacobian, x)
    damping = np.full(len(x), 1e-3)
    converged = np.zeros(len(x), dtype=bool)
    active = np.flatnonzero(np.isfinite(cost))
    for _ in range(n_iterations):
        if not len(active):
            break
        step = _damped_step(J[active], residual[active], damping[active])
        trial = x[active] + step
        trial_residual, trial_J, trial_cost = _evaluate(residual_and_jacobian, trial)
        is_better = trial_cost < cost[active]
        decrease = cost[active] - trial_cost
        is_done = (np.abs(step) <= 1e-10 * np.abs(x[active])).all(axis=1)
        is_done |= is_better & (decrease <= tolerance * cost[active])
        improved = active[is_better]
        x[improved], cost[improved] = trial[is_better], trial_cost[is_better]
        residual[improved], J[improved] = trial_residual[is_better], trial_J[is_better]
        damping[active] *= np.where(is_better, 0.2, 5.0)
        converged[active[is_done]] = True
        active = active[~is_done & (damping[active] < MAX_DAMPING)]
    return x, cost, pseudo_inverse(np.einsum('nyi,nyj->nij', J, J)), converged


MAX_DAMPING = 1e12
"""Damping at which a search stops, because even tiny steps do not decrease the cost."""


def _damped_step(J: FloatArray, residual: FloatArray, damping: FloatArray) -> FloatArray:
    """Levenberg-Marquardt steps (n, n_x) for the damping (n,) of each point."""
    Jt = np.swapaxes(J, 1, 2)
    information = Jt @ J
    # Marquardt's scaling: damping is relative to the information of each parameter.
    diagonal = np.einsum('nii->ni', information)
    A = information + (damping[:, None] * diagonal)[:, :, None] * np.eye(J.shape[2])
    step: FloatArray = np.einsum('nij,nj->ni', pseudo_inverse(A),
                                 np.einsum('nij,nj->ni', Jt, residual))
    return step


def _evaluate(residual_and_jacobian: ResidualAndJacobian, x: FloatArray
              ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluate residuals, Jacobians and costs; the cost is infinite if any result is not finite."""
    with ignoring_overflow():
        residual, J = residual_and_jacobian(x)
        cost = np.einsum('ni,ni->n', residual, residual)
    is_unusable = ~(np.isfinite(cost) & np.isfinite(J).all(axis=(1, 2)))
    residual[is_unusable], J[is_unusable], cost[is_unusable] = 0.0, 0.0, np.inf
    return residual, J, cost


def project_out_linear(A: FloatArray, y: FloatArray
                       ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Estimate the linear parameters p of several models y = A p + e, e ~ N(0, I).

    Parameters
    ----------
    A : (n, n_y, k) array
        Design matrices.
    y : (n_y,) array
        Whitened measurements.

    Returns
    -------
    p : (n, k) array
        Zero in nearly singular directions of `A` (`LINEAR_RANK_TOLERANCE`).
    residual : (n, n_y) array
        Residuals y - A p.
    inverse : (n, k, k) array
        Pseudo-inverse of A'A.
    """
    At = np.swapaxes(A, 1, 2)
    inverse = pseudo_inverse(At @ A, LINEAR_RANK_TOLERANCE)
    p = np.einsum('nij,nj->ni', inverse, At @ y)
    return p, y - np.einsum('nyi,ni->ny', A, p), inverse


LINEAR_RANK_TOLERANCE = 1e-11
"""Relative eigenvalue below which a linear direction is excluded. Dipoles at nearly the same
position would otherwise cancel each other with unbounded moments."""


def score_sum_covariance(scores: FloatArray, lag: int) -> FloatArray:
    """Covariance of a sum of correlated scores, by the Newey-West method with Bartlett weights.

    Parameters
    ----------
    scores : (n, n_x) array
        Gradient of the cost of each sample at the minimum, chronological.
    lag : int
        Samples further apart than this are treated as independent.

    Returns
    -------
    (n_x, n_x) array
        Positive semidefinite; approximately the information if model and noise are correct.

    References
    ----------
    [NeweyWest87]_.
    """
    S = scores.T @ scores
    for k in range(1, min(lag, len(scores) - 1) + 1):
        pairs = scores[k:].T @ scores[:-k]
        S += (1.0 - k / (lag + 1.0)) * (pairs + pairs.T)
    return S


def model_error_covariance(t: Sequence[FloatArray], derivatives: Sequence[FloatArray],
                           residuals: Sequence[FloatArray], covariance: FloatArray) -> FloatArray:
    """Additional covariance of an estimate due to errors of the model.

    Residuals caused by model errors are correlated over `CORRELATION_TIME_S`, so they contain less
    information than their number suggests. The result is positive semidefinite, even if the
    residuals are smaller than the noise by chance.

    Parameters
    ----------
    t : sequence of (n,) array, s
        Timestamps of each sensor, ascending.
    derivatives : sequence of (n, k, n_x) array
        Whitened derivatives of each sensor.
    residuals : sequence of (n, k) array
        Whitened residuals of each sensor.
    covariance : (n_x, n_x) array
        Covariance due to noise alone.

    Returns
    -------
    (n_x, n_x) array
        NaN if a variance is infinite.
    """
    scale = np.sqrt(np.diagonal(covariance))
    excess = np.zeros_like(covariance)
    for times, H, r in zip(t, derivatives, residuals, strict=True):
        columns = H * scale
        step = np.median(np.diff(times)) if len(times) > 1 else CORRELATION_TIME_S
        excess += score_sum_covariance(np.einsum('nai,na->ni', columns, r),
                                       int(CORRELATION_TIME_S / max(step, 1e-9)))
        excess -= np.einsum('nai,naj->ij', columns, columns)
    if not np.isfinite(excess).all():
        return np.full_like(covariance, np.nan)
    w, V = np.linalg.eigh(excess)
    root = (covariance / np.outer(scale, scale)) @ (V * np.sqrt(np.maximum(w, 0.0)))
    addition: FloatArray = np.outer(scale, scale) * (root @ root.T)
    return addition
