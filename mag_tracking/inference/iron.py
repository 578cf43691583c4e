"""Hard and soft iron of a vehicle from its moments at several headings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray


@dataclass(frozen=True)
class Iron:
    """What a vehicle's moment is made of, and how well that is known."""

    hard: FloatArray
    """(3,) [A m^2], m0 in the vehicle's frame, x forward and z up."""
    soft: float
    """[m^3], D."""
    covariance: FloatArray
    """(4, 4) of [m0, D]."""
    residuals: FloatArray
    """(n, 3) [A m^2], world: moment minus what the two make of it."""
    normalised_cost: float
    """Weighted sum of squared residuals over the degrees of freedom; about one where the model and
    the covariances are right. NaN without covariances."""


def hard_and_soft_iron(moments: ArrayLike, headings: ArrayLike, induction: ArrayLike,
                       covariances: ArrayLike | None = None) -> Iron:
    """Least squares for m0 and D in m = Rz(heading) m0 + D induction.

    Parameters
    ----------
    moments : (n, 3) [A m^2], world
    headings : (n,) [rad]
        Anticlockwise from x.
    induction : (3,) [A/m], world
        B0/mu0; with 3 B0/mu0 the D that comes out is T10's.
    covariances : (n, 3, 3) [(A m^2)^2], optional
        Without them all moments count alike, and the residuals tell how uncertain they are.

    Returns
    -------
    Iron

    Raises
    ------
    ValueError
        Shapes that do not fit, numbers that are not finite, a covariance that is not positive
        definite, or headings from which the two cannot be told apart: one alone, several that
        are the same, or an earth field that is vertical.

    Source: TSP14 section VI.E, T10 eq. (6.16).
    """
    moments, headings = np.asarray(moments, dtype=float), np.asarray(headings, dtype=float)
    induction = np.asarray(induction, dtype=float)
    n = len(headings)
    if moments.shape != (n, 3) or headings.shape != (n,) or induction.shape != (3,):
        raise ValueError(f'expected moments (n, 3), headings (n,) and induction (3,), got '
                         f'{moments.shape}, {headings.shape}, {induction.shape}')
    if not (np.isfinite(moments).all() and np.isfinite(headings).all()
            and np.isfinite(induction).all()):
        raise ValueError('a moment, a heading or the induction is not finite')
    A = np.zeros((n, 3, 4))
    c, s = np.cos(headings), np.sin(headings)
    A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = c, -s, s, c
    A[:, 2, 2] = 1.0
    A[:, :, 3] = induction
    W = _whitening(covariances, n)
    whitened = (W @ A).reshape(3 * n, 4)
    # D is in cubic metres of a field of tens of A/m: unit columns first.
    scale = np.linalg.norm(whitened, axis=0)
    # Headings a hundredth of a degree apart are taken for the same.
    if (n < 2 or not (scale > 0.0).all()
            or np.linalg.svd(whitened / scale, compute_uv=False)[-1] < 1e-4):
        raise ValueError('hard and soft iron cannot be told apart: that takes headings that '
                         'differ, and an earth field with a horizontal part')
    y = (W @ moments[:, :, None]).ravel()
    theta = np.linalg.lstsq(whitened / scale, y, rcond=None)[0] / scale
    covariance = np.linalg.inv((whitened / scale).T @ (whitened / scale)) / np.outer(scale, scale)
    left = y - whitened @ theta
    cost = float(left @ left) / (3 * n - 4)
    if covariances is None:
        covariance, cost = covariance * cost, float('nan')
    return Iron(theta[:3], float(theta[3]), covariance, moments - A @ theta, cost)


def _whitening(covariances: ArrayLike | None, n: int) -> FloatArray:
    """(n, 3, 3) inverse Cholesky factors; identities without covariances."""
    if covariances is None:
        return np.tile(np.eye(3), (n, 1, 1))
    covariances = np.asarray(covariances, dtype=float)
    if covariances.shape != (n, 3, 3):
        raise ValueError(f'expected covariances ({n}, 3, 3), got {covariances.shape}')
    try:
        return np.linalg.inv(np.linalg.cholesky(covariances))
    except np.linalg.LinAlgError:
        raise ValueError('a covariance is not positive definite') from None
