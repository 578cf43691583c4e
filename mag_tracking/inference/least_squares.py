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
    """Minimise sums of squares by Levenberg-Marquardt from many starting points `x` in parallel.

    `residual_and_jacobian` returns whitened residuals, measured minus predicted, and the Jacobians
    of the prediction. Returns the final points; their costs, infinite if the model is not finite at
    the start; the pseudo-inverses of the information; and whether the step or the decrease of the
    cost (at most the fraction `tolerance`) became negligible. Each start has its own damping; one
    that reaches `MAX_DAMPING` has not converged. T10 section 2.3, Alg. 1.
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
    """Linear parameters p (n, k) of models y = A p + e, e ~ N(0, I), by least squares.

    `A` is (n, n_y, k), and `y` (n_y,) is common to all. Returns p, zero in nearly singular
    directions of A (`LINEAR_RANK_TOLERANCE`); the residuals (n, n_y); and the pseudo-inverses of
    A'A.
    """
    At = np.swapaxes(A, 1, 2)
    inverse = pseudo_inverse(At @ A, LINEAR_RANK_TOLERANCE)
    p = np.einsum('nij,nj->ni', inverse, At @ y)
    return p, y - np.einsum('nyi,ni->ny', A, p), inverse


LINEAR_RANK_TOLERANCE = 1e-11
"""Relative eigenvalue below which a linear direction is excluded. Dipoles at nearly the same
position would otherwise cancel each other with unbounded moments."""


def score_sum_covariance(scores: FloatArray, lag: int) -> FloatArray:
    """Covariance of a sum of correlated scores (n, n_x), chronological ([NeweyWest87]_, Bartlett).

    `scores` are the gradients of each sample's cost at the minimum; beyond `lag` samples they are
    independent. Positive semidefinite; about the information if model and noise are correct.
    """
    S = scores.T @ scores
    for k in range(1, min(lag, len(scores) - 1) + 1):
        pairs = scores[k:].T @ scores[:-k]
        S += (1.0 - k / (lag + 1.0)) * (pairs + pairs.T)
    return S


def model_error_covariance(t: Sequence[FloatArray], derivatives: Sequence[FloatArray],
                           residuals: Sequence[FloatArray], covariance: FloatArray) -> FloatArray:
    """Additional covariance (n_x, n_x) of an estimate due to errors of the model.

    Residuals of model errors are correlated over `CORRELATION_TIME_S` and contain less information
    than their number suggests. For each sensor: ascending times [s], whitened derivatives
    (n, k, n_x) and residuals (n, k). Positive semidefinite even if residuals are small by chance;
    NaN if a variance in `covariance` (due to noise alone) is infinite.
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
