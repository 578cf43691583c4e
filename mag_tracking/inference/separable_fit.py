"""Fits of models that are linear in most of their parameters, from many starts.

The model comes in as an object, so that this file is mathematics only.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import project_out_linear, refine
from mag_tracking.inference.matrices import ignoring_overflow


class SeparableModel(Protocol):
    """Whitened measurements basis(theta) p: linear in p, not in the few theta."""

    def basis(self, theta: FloatArray) -> FloatArray:
        """(n, n_y, k) for theta (n, n_theta)."""

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """d(basis(theta) p)/d(theta), (n, n_y, n_theta)."""


class SeparableProblem:
    """A separable model and what it is to fit; p is eliminated for every theta.

    Parameters
    ----------
    model : SeparableModel
    y : (n_y,)
        Whitened.
    nuisance : (n_y, q), optional
        Further linear terms that do not depend on theta (backgrounds), whitened.
    prior : (mean, std) of (n_theta,), optional
        What is known of theta beforehand; an infinite deviation says nothing.

    Source: variable projection with the Jacobian of Kaufman (1975); TSP14 eq. (46).
    """

    def __init__(self, model: SeparableModel, y: FloatArray, nuisance: FloatArray | None = None,
                 prior: tuple[FloatArray, FloatArray] | None = None) -> None:
        self._model = model
        self._prior = None if prior is None else _Prior(*prior)
        # The nuisance is projected out of everything, once.
        self._Q = np.zeros((len(y), 0)) if nuisance is None else np.linalg.qr(nuisance)[0]
        self._y = y - self._Q @ (self._Q.T @ y)
        self.energy = float(self._y @ self._y)
        """Sum of squares of what the nuisance alone does not explain."""

    def _without_nuisance(self, A: FloatArray) -> FloatArray:
        """A (n, n_y, k) without what the nuisance explains."""
        return A - self._Q @ (self._Q.T @ A)

    def cost(self, theta: FloatArray) -> FloatArray:
        """(n,) least sum of squares for theta (n, n_theta); infinite where it is no number."""
        with ignoring_overflow():
            A = self._without_nuisance(self._model.basis(theta))
            p, _, _ = project_out_linear(A, self._y)
            # Not from the residuals: a grid of starts has many, and digits enough.
            cost = self.energy - np.einsum('ni,ni->n', p, self._y @ A)
            if self._prior is not None:
                cost = cost + np.square(self._prior.residual(theta)).sum(axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n, n_y) and the Jacobians (n, n_y, n_theta) of what is predicted."""
        A = self._without_nuisance(self._model.basis(theta))
        p, residual, inverse = project_out_linear(A, self._y)
        D = self._without_nuisance(self._model.derivative(theta, p))
        J = D - A @ (inverse @ (np.swapaxes(A, 1, 2) @ D))
        if self._prior is None:
            return residual, J
        known = self._prior.residual(theta)
        return (np.hstack([residual, known]), np.concatenate(
            [J, np.broadcast_to(self._prior.jacobian, (len(J), *self._prior.jacobian.shape))],
            axis=1))

    def linear(self, theta: FloatArray) -> FloatArray:
        """p (k,) at theta (n_theta,)."""
        p: FloatArray = project_out_linear(
            self._without_nuisance(self._model.basis(theta[None])), self._y)[0][0]
        return p


class _Prior:
    """A Gaussian prior as whitened measurements of theta."""

    def __init__(self, mean: FloatArray, std: FloatArray) -> None:
        self._known = np.flatnonzero(np.isfinite(std))
        self._mean, self._std = mean[self._known], std[self._known]
        self.jacobian = (np.eye(len(mean)) / std)[self._known]
        """(n_known, n_theta)"""

    def residual(self, theta: FloatArray) -> FloatArray:
        """(n, n_known) for theta (n, n_theta)."""
        left: FloatArray = (self._mean - theta[:, self._known]) / self._std
        return left


@dataclass(frozen=True)
class Minimum:
    """The lowest minimum that a search found."""

    theta: FloatArray
    """(n_theta,)."""
    cost: float
    """Sum of squared whitened residuals; infinite where no start was usable."""
    converged: bool
    rivals: tuple[tuple[FloatArray, float], ...] = ()
    """(theta, cost) of other minima that it ended in, best first."""


def search(smooth: SeparableProblem, coarse: SeparableProblem, fine: SeparableProblem,
           starts: FloatArray, apart: FloatArray,
           companions: Callable[[FloatArray], FloatArray] | None = None) -> Minimum:
    """The lowest minimum of a separable problem, from many starts.

    Parameters
    ----------
    smooth, coarse : SeparableProblem
        Smaller problems with nearly the same minima, the first one smoother; see `coarse_minima`.
    fine : SeparableProblem
        The one to solve; see `fine_minimum`.
    starts : (n, n_theta)
    apart : (n_theta,)
        Points differ that are farther from each other than this in any of the numbers.
    companions : function, optional
        Takes the best point (n_theta,) of the coarse problem, gives others (n, n_theta) whose
        minima are often mistaken for its own; the search goes on from them, too.

    Returns
    -------
    Minimum
    """
    theta, cost = coarse_minima(smooth, coarse, starts, apart)
    if companions is not None:
        more, more_cost, _, _ = refine(coarse.residual_and_jacobian,
                                       companions(theta[np.argmin(cost)]), 40, 1e-6)
        theta, cost = np.vstack([theta, more]), np.append(cost, more_cost)
    return fine_minimum(fine, theta, cost, apart)


def coarse_minima(smooth: SeparableProblem, coarse: SeparableProblem, starts: FloatArray,
                  apart: FloatArray, n_refined: int = 60, n_steps: int = 4,
                  n_distinct: int = 8) -> tuple[FloatArray, FloatArray]:
    """Minima (n, n_theta) of a separable problem, and their costs (n,).

    By the `smooth` problem all `starts` (n, n_theta) are judged, and the best `n_refined` get
    `n_steps` steps of Levenberg and Marquardt. The best `n_distinct` of those that differ by more
    than `apart` (n_theta,) go to their minima of the `coarse` one.
    """
    theta, cost = starts, smooth.cost(starts)
    theta = theta[np.argsort(cost, kind='stable')[:n_refined]]
    theta, cost, _, _ = refine(smooth.residual_and_jacobian, theta, n_steps)
    theta = theta[distinct(theta, cost, apart, n_distinct)]
    theta, cost, _, _ = refine(coarse.residual_and_jacobian, theta, 40, 1e-6)
    return theta, cost


def fine_minimum(fine: SeparableProblem, theta: FloatArray, cost: FloatArray, apart: FloatArray,
                 n_best: int = 4) -> Minimum:
    """The lowest minimum of a separable problem, from points `theta` (n, n_theta).

    It starts from the best `n_best` by `cost` (n,) of those that differ by more than `apart`
    (n_theta,).
    """
    theta = theta[distinct(theta, cost, apart, n_best)]
    theta, cost, _, converged = refine(fine.residual_and_jacobian, theta, 100, 1e-8)
    order = np.argsort(cost, kind='stable')
    best = order[0]
    rivals: list[tuple[FloatArray, float]] = []
    for k in order[1:]:
        if all((np.abs(theta[k] - x) > apart).any()
               for x in (theta[best], *(x for x, _ in rivals))):
            rivals.append((theta[k], float(cost[k])))
    return Minimum(theta[best], float(cost[best]), bool(converged[best]), tuple(rivals))


def distinct(theta: FloatArray, cost: FloatArray, apart: FloatArray, most: int) -> IntArray:
    """Rows of the best `most` of theta (n, n_theta) of which no two are the same point.

    Points differ that are farther from each other than `apart` (n_theta,) in any of the numbers.
    """
    kept: list[int] = []
    for row in np.argsort(cost, kind='stable').tolist():
        if all((np.abs(theta[row] - theta[other]) > apart).any() for other in kept):
            kept.append(row)
            if len(kept) == most:
                break
    return np.array(kept, dtype=np.int64)
