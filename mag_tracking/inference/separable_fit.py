"""Fits of models that are linear in most of their parameters, from many starting points.

A model is an object with the methods of `SeparableModel`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import project_out_linear, refine
from mag_tracking.inference.matrices import ignoring_overflow


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
        self._prior = None if prior is None else _Prior(*prior)
        # The nuisance terms are projected out of model and measurements.
        self._Q = np.zeros((len(y), 0)) if nuisance is None else np.linalg.qr(nuisance)[0]
        self._y = y - self._Q @ (self._Q.T @ y)
        self.energy = float(self._y @ self._y)

    def _without_nuisance(self, A: FloatArray) -> FloatArray:
        """Project the nuisance terms out of `A` (n, n_y, k)."""
        return A - self._Q @ (self._Q.T @ A)

    def cost(self, theta: FloatArray) -> FloatArray:
        """Minimum over p of the squared whitened residuals including the prior, (n,) for each
        theta; infinite where the model is not finite."""
        with ignoring_overflow():
            A = self._without_nuisance(self._model.basis(theta))
            p, _, _ = project_out_linear(A, self._y)
            # Cheaper than the sum of the squared residuals, and accurate enough for a grid of
            # starting points.
            cost = self.energy - np.einsum('ni,ni->n', p, self._y @ A)
            if self._prior is not None:
                cost = cost + np.square(self._prior.residual(theta)).sum(axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Whitened residuals (n, n_y + n_known) and Jacobians of the prediction, for `refine`; the
        n_known parameters with a prior come last."""
        A = self._without_nuisance(self._model.basis(theta))
        p, residual, inverse = project_out_linear(A, self._y)
        D = self._without_nuisance(self._model.derivative(theta, p))
        J = D - A @ (inverse @ (np.swapaxes(A, 1, 2) @ D))
        if self._prior is None:
            return residual, J
        prior_residual = self._prior.residual(theta)
        return (np.hstack([residual, prior_residual]), np.concatenate(
            [J, np.broadcast_to(self._prior.jacobian, (len(J), *self._prior.jacobian.shape))],
            axis=1))

    def linear(self, theta: FloatArray) -> FloatArray:
        """Linear parameters (k,) that minimise the cost at one theta (n_theta,)."""
        p: FloatArray = project_out_linear(
            self._without_nuisance(self._model.basis(theta[None])), self._y)[0][0]
        return p


class _Prior:
    """Gaussian prior as whitened measurements of the n_known parameters that have a prior."""

    def __init__(self, mean: FloatArray, std: FloatArray) -> None:
        self._prior_indices = np.flatnonzero(np.isfinite(std))
        self._mean, self._std = mean[self._prior_indices], std[self._prior_indices]
        self.jacobian = (np.eye(len(mean)) / std)[self._prior_indices]
        """Derivative of the whitened measurements, (n_known, n_theta)."""

    def residual(self, theta: FloatArray) -> FloatArray:
        """Whitened residuals (n, n_known) of the prior at theta (n, n_theta)."""
        residual_of_prior: FloatArray = (self._mean - theta[:, self._prior_indices]) / self._std
        return residual_of_prior


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

    All starting points are evaluated with `smooth`, and the best `n_refined` are refined by
    `n_steps` Levenberg-Marquardt steps. The best `n_distinct` distinct ones (see `search`) are then
    refined to minima of `coarse`.
    """
    theta, cost = starts, smooth.cost(starts)
    theta = theta[np.argsort(cost, kind='stable')[:n_refined]]
    theta, cost, _, _ = refine(smooth.residual_and_jacobian, theta, n_steps)
    theta = theta[distinct(theta, cost, min_difference, n_distinct)]
    theta, cost, _, _ = refine(coarse.residual_and_jacobian, theta, 40, 1e-6)
    return theta, cost


def fine_minimum(fine: SeparableProblem, theta: FloatArray, cost: FloatArray,
                 min_difference: FloatArray, n_best: int = 4) -> Minimum:
    """Find the lowest minimum of `fine` from the `n_best` distinct points (see `search`) of lowest
    cost."""
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
