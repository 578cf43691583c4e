"""Non-linear least squares from many starts at once.

The model comes in as a function or an object, so that this file is mathematics only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.matrices import pseudo_inverse, running_away

ResidualAndJacobian: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Takes points (n, n_x), returns residuals (n, n_y) and Jacobians (n, n_y, n_x)."""

CORRELATED_S = 0.2
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
        busy = busy[~done & (damping[busy] < MOST_DAMPING)]
    return x, cost, pseudo_inverse(np.einsum('nyi,nyj->nij', J, J)), converged


MOST_DAMPING = 1e12
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
    with running_away():
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
    inverse = pseudo_inverse(At @ A, LINEAR_RANK)
    p = np.einsum('nij,nj->ni', inverse, At @ y)
    return p, y - np.einsum('nyi,ni->ny', A, p), inverse


LINEAR_RANK = 1e-11
"""Dipoles that are almost at one place would cancel each other with moments without bounds."""


def correlated_scores(scores: FloatArray, lag: int) -> FloatArray:
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


def left_out_covariance(t: Sequence[FloatArray], derivatives: Sequence[FloatArray],
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
        step = np.median(np.diff(times)) if len(times) > 1 else CORRELATED_S
        excess += correlated_scores(np.einsum('nai,na->ni', columns, r),
                                    int(CORRELATED_S / max(step, 1e-9)))
        excess -= np.einsum('nai,naj->ij', columns, columns)
    if not np.isfinite(excess).all():
        return np.full_like(covariance, np.nan)
    w, V = np.linalg.eigh(excess)
    root = (covariance / np.outer(scale, scale)) @ (V * np.sqrt(np.maximum(w, 0.0)))
    missing: FloatArray = np.outer(scale, scale) * (root @ root.T)
    return missing


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

    Source: variable projection with the Jacobian of Kaufman (1975); TSP14 eq. (46).
    """

    def __init__(self, model: SeparableModel, y: FloatArray,
                 nuisance: FloatArray | None = None) -> None:
        self._model = model
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
        with running_away():
            A = self._without_nuisance(self._model.basis(theta))
            p, _, _ = project_out_linear(A, self._y)
            # Not from the residuals: a grid of starts has many, and digits enough.
            cost = self.energy - np.einsum('ni,ni->n', p, self._y @ A)
        return np.where(np.isfinite(cost), cost, np.inf)

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n, n_y) and the Jacobians (n, n_y, n_theta) of what is predicted."""
        A = self._without_nuisance(self._model.basis(theta))
        p, residual, inverse = project_out_linear(A, self._y)
        D = self._without_nuisance(self._model.derivative(theta, p))
        return residual, D - A @ (inverse @ (np.swapaxes(A, 1, 2) @ D))

    def linear(self, theta: FloatArray) -> FloatArray:
        """p (k,) at theta (n_theta,)."""
        p: FloatArray = project_out_linear(
            self._without_nuisance(self._model.basis(theta[None])), self._y)[0][0]
        return p


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
           companions: Callable[[FloatArray], FloatArray] | None = None, n_refined: int = 60,
           n_steps: int = 4, n_distinct: int = 8, n_best: int = 4) -> Minimum:
    """The lowest minimum of a separable problem, from many starts.

    Parameters
    ----------
    smooth, coarse : SeparableProblem
        Smaller problems with nearly the same minima, the first one smoother. By it all `starts`
        are judged, and the best `n_refined` get `n_steps` steps of Levenberg and Marquardt. The
        best `n_distinct` of those that differ go to their minima of the second.
    fine : SeparableProblem
        The one to solve, from the best `n_best` of these minima.
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
    theta, cost = starts, smooth.cost(starts)
    theta = theta[np.argsort(cost, kind='stable')[:n_refined]]
    theta, cost, _, _ = refine(smooth.residual_and_jacobian, theta, n_steps)
    theta = theta[distinct(theta, cost, apart, n_distinct)]
    theta, cost, _, _ = refine(coarse.residual_and_jacobian, theta, 40, 1e-6)
    if companions is not None:
        more, more_cost, _, _ = refine(coarse.residual_and_jacobian,
                                       companions(theta[np.argmin(cost)]), 40, 1e-6)
        theta, cost = np.vstack([theta, more]), np.append(cost, more_cost)
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
