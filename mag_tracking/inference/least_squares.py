"""Non-linear least squares from many starting points in parallel.

A model is a function that returns residuals and Jacobians, or, if it is linear in most of its
parameters, an object with the methods of `SeparableModel`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
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
    cost (at most the fraction `tolerance`) became negligible. T10 section 2.3, Alg. 1.
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
    """Residuals, Jacobians and costs; the cost is infinite if any result is not finite."""
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
    """Covariance of a sum of correlated scores (n, n_x), the gradients of each sample's cost at the
    minimum, independent beyond `lag` samples ([NeweyWest87]_, Bartlett)."""
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
    (n, k, n_x) and residuals (n, k). NaN if a variance in `covariance` (due to noise alone) is
    infinite.
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


class SeparableModel(Protocol):
    """Model of whitened measurements basis(theta) p: linear in p, non-linear in theta."""

    def basis(self, theta: FloatArray) -> FloatArray:
        """Design matrices of the linear parameters.

        Parameters
        ----------
        theta : (n, n_theta) array
            Non-linear parameters.

        Returns
        -------
        (n, n_y, k) array
        """

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """Derivative of basis(theta) p with respect to theta.

        Parameters
        ----------
        theta : (n, n_theta) array
            Non-linear parameters.
        p : (n, k) array
            Linear parameters.

        Returns
        -------
        (n, n_y, n_theta) array
        """


class SeparableProblem:
    """Least-squares problem of a separable model, with p eliminated by variable projection.

    The Jacobian is the approximation of [Kaufman75]_; TSP14 eq. (46).

    Parameters
    ----------
    y : (n_y,), whitened measurements
    nuisance : (n_y, q), whitened linear terms that do not depend on theta, such as backgrounds
    prior : mean and std (n_theta,) of theta; an infinite std means no prior

    Attributes
    ----------
    energy : sum of the squared residuals of a fit of the nuisance terms alone
    """

    def __init__(self, model: SeparableModel, y: FloatArray, nuisance: FloatArray | None = None,
                 prior: tuple[FloatArray, FloatArray] | None = None) -> None:
        self._model = model
        mean, std = (np.zeros(0), np.zeros(0)) if prior is None else prior
        self._known = np.flatnonzero(np.isfinite(std))
        self._mean, self._std = mean[self._known], std[self._known]
        # The nuisance terms are projected out of model and measurements.
        self._Q = np.zeros((len(y), 0)) if nuisance is None else np.linalg.qr(nuisance)[0]
        self._y = y - self._Q @ (self._Q.T @ y)
        self.energy = float(self._y @ self._y)

    def _without_nuisance(self, A: FloatArray) -> FloatArray:
        """Project the nuisance terms out of `A` (n, n_y, k)."""
        return A - self._Q @ (self._Q.T @ A)

    def cost(self, theta: FloatArray) -> FloatArray:
        """Minimum over p of the squared whitened residuals including the prior, (n,)."""
        with ignoring_overflow():
            A = self._without_nuisance(self._model.basis(theta))
            p, _, _ = project_out_linear(A, self._y)
            # Cheaper than the sum of the squared residuals, and accurate enough for a grid of
            # starting points.
            cost = self.energy - np.einsum('ni,ni->n', p, self._y @ A)
            cost = cost + np.square(self._prior_residual(theta)).sum(axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (n, n_y + n_known) and Jacobians of the prediction, for `refine`."""
        A = self._without_nuisance(self._model.basis(theta))
        p, residual, inverse = project_out_linear(A, self._y)
        D = self._without_nuisance(self._model.derivative(theta, p))
        J = D - A @ (inverse @ (np.swapaxes(A, 1, 2) @ D))
        prior_J = np.eye(theta.shape[1])[self._known] / self._std[:, None]
        return np.hstack([residual, self._prior_residual(theta)]), np.concatenate(
            [J, np.broadcast_to(prior_J, (len(J), *prior_J.shape))], axis=1)

    def _prior_residual(self, theta: FloatArray) -> FloatArray:
        """Whitened residuals (n, n_known) of the parameters that have a prior."""
        residual: FloatArray = (self._mean - theta[:, self._known]) / self._std
        return residual

    def linear(self, theta: FloatArray) -> FloatArray:
        """Linear parameters (k,) that minimise the cost at one theta (n_theta,)."""
        p: FloatArray = project_out_linear(
            self._without_nuisance(self._model.basis(theta[None])), self._y)[0][0]
        return p


@dataclass(frozen=True)
class Minimum:
    """Result of a search for the lowest minimum."""

    theta: FloatArray
    """Non-linear parameters, (n_theta,)."""
    cost: float
    """Sum of squared whitened residuals; infinite if no starting point was usable."""
    converged: bool
    """Whether the final search converged."""
    rivals: tuple[tuple[FloatArray, float], ...] = ()
    """Other distinct minima as (theta, cost), lowest cost first."""


def search(smooth: SeparableProblem, coarse: SeparableProblem, fine: SeparableProblem,
           starts: FloatArray, min_difference: FloatArray,
           companions: Callable[[FloatArray], FloatArray] | None = None) -> Minimum:
    """Search for the lowest minimum of `fine` from many starting points (n, n_theta).

    `coarse` is a reduced problem with nearly the same minima, and `smooth` a smoother one. Points
    that differ by more than `min_difference` in any parameter are distinct. `companions` maps the
    best coarse minimum to points near minima often confused with it, where the search also starts.
    """
    theta, cost = coarse_minima(smooth, coarse, starts, min_difference)
    if companions is not None:
        added, added_cost, _, _ = refine(coarse.residual_and_jacobian,
                                         companions(theta[np.argmin(cost)]), 40, 1e-6)
        theta, cost = np.vstack([theta, added]), np.append(cost, added_cost)
    return fine_minimum(fine, theta, cost, min_difference)


def coarse_minima(smooth: SeparableProblem, coarse: SeparableProblem, starts: FloatArray,
                  min_difference: FloatArray, n_refined: int = 60, n_steps: int = 4,
                  n_distinct: int = 8) -> tuple[FloatArray, FloatArray]:
    """Minima (n, n_theta) of a reduced problem, and their costs.

    Of all starting points, the best `n_refined` of `smooth` are refined by `n_steps` steps. The
    best `n_distinct` distinct ones (see `search`) are then refined to minima of `coarse`.
    """
    theta, cost = starts, smooth.cost(starts)
    theta = theta[np.argsort(cost, kind='stable')[:n_refined]]
    theta, cost, _, _ = refine(smooth.residual_and_jacobian, theta, n_steps)
    theta = theta[distinct(theta, cost, min_difference, n_distinct)]
    theta, cost, _, _ = refine(coarse.residual_and_jacobian, theta, 40, 1e-6)
    return theta, cost


def fine_minimum(fine: SeparableProblem, theta: FloatArray, cost: FloatArray,
                 min_difference: FloatArray, n_best: int = 4) -> Minimum:
    """Lowest minimum of `fine` from the `n_best` distinct points (see `search`) of lowest cost."""
    theta = theta[distinct(theta, cost, min_difference, n_best)]
    theta, cost, _, converged = refine(fine.residual_and_jacobian, theta, 100, 1e-8)
    order = np.argsort(cost, kind='stable')
    best = order[0]
    rivals: list[tuple[FloatArray, float]] = []
    for k in order[1:]:
        if all((np.abs(theta[k] - x) > min_difference).any()
               for x in (theta[best], *(x for x, _ in rivals))):
            rivals.append((theta[k], float(cost[k])))
    return Minimum(theta[best], float(cost[best]), bool(converged[best]), tuple(rivals))


def distinct(theta: FloatArray, cost: FloatArray, min_difference: FloatArray,
             max_points: int) -> IntArray:
    """Indices of the distinct points of lowest cost, ascending in cost, at most `max_points`."""
    selected: list[int] = []
    for i in np.argsort(cost, kind='stable').tolist():
        if all((np.abs(theta[i] - theta[other]) > min_difference).any() for other in selected):
            selected.append(i)
            if len(selected) == max_points:
                break
    return np.array(selected, dtype=np.int64)
