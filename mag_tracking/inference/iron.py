"""Hard and soft iron of a vehicle from its moments at several headings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray


@dataclass(frozen=True)
class Iron:
    """Hard and soft iron of a vehicle, with covariance."""

    hard: FloatArray
    """Hard iron moment m0, (3,) A m², vehicle frame (x forward, z up)."""
    soft: float
    """Soft iron D, m³."""
    covariance: FloatArray
    """Covariance of [m0, D], (4, 4), in the squared units of m0 [A m²] and D [m³]."""
    residuals: FloatArray
    """Measured minus predicted moments, (n, 3) A m², world frame."""
    normalised_cost: float
    """Chi-square of the residuals per degree of freedom; about 1 if the model and the covariances
    are correct. NaN without covariances."""


def hard_and_soft_iron(moments: ArrayLike, headings: ArrayLike, field_strength: ArrayLike,
                       covariances: ArrayLike | None = None) -> Iron:
    """Estimate m0 and D in m = Rz(heading) m0 + D field_strength by least squares.

    `moments` (n, 3) [A m²] and `field_strength` = B0/mu0 [A/m] are in the world frame; with 3
    B0/mu0, D is as defined in T10. Without `covariances`, moments have equal weight and the
    residuals determine the covariance. Raises ValueError for invalid input, or if hard and soft
    iron cannot be separated: a single heading, equal headings, or a vertical earth field. TSP14
    section VI.E; T10 eq. (6.16).
    """
    moments, headings = np.asarray(moments, dtype=float), np.asarray(headings, dtype=float)
    field_strength = np.asarray(field_strength, dtype=float)
    n = len(headings)
    if moments.shape != (n, 3) or headings.shape != (n,) or field_strength.shape != (3,):
        raise ValueError(f'expected moments (n, 3), headings (n,) and field_strength (3,), got '
                         f'{moments.shape}, {headings.shape}, {field_strength.shape}')
    if not (np.isfinite(moments).all() and np.isfinite(headings).all()
            and np.isfinite(field_strength).all()):
        raise ValueError('moments, headings and field_strength must be finite')
    A = np.zeros((n, 3, 4))
    c, s = np.cos(headings), np.sin(headings)
    A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = c, -s, s, c
    A[:, 2, 2] = 1.0
    A[:, :, 3] = field_strength
    W = _whitening_matrices(covariances, n)
    whitened = (W @ A).reshape(3 * n, 4)
    # The units of m0 and D differ, so the columns are normalised first.
    scale = np.linalg.norm(whitened, axis=0)
    # Headings a hundredth of a degree apart are treated as equal.
    if (n < 2 or not (scale > 0.0).all()
            or np.linalg.svd(whitened / scale, compute_uv=False)[-1] < 1e-4):
        raise ValueError('hard and soft iron cannot be separated: headings must differ and the '
                         'earth field must have a horizontal component')
    y = (W @ moments[:, :, None]).ravel()
    theta = np.linalg.lstsq(whitened / scale, y, rcond=None)[0] / scale
    covariance = np.linalg.inv((whitened / scale).T @ (whitened / scale)) / np.outer(scale, scale)
    residual = y - whitened @ theta
    cost = float(residual @ residual) / (3 * n - 4)
    if covariances is None:
        covariance, cost = covariance * cost, float('nan')
    return Iron(theta[:3], float(theta[3]), covariance, moments - A @ theta, cost)


def _whitening_matrices(covariances: ArrayLike | None, n: int) -> FloatArray:
    """Inverse Cholesky factors (n, 3, 3) of `n` covariances, identity matrices if None; raises
    ValueError for a wrong shape or a covariance that is not positive definite."""
    if covariances is None:
        return np.tile(np.eye(3), (n, 1, 1))
    covariances = np.asarray(covariances, dtype=float)
    if covariances.shape != (n, 3, 3):
        raise ValueError(f'expected covariances ({n}, 3, 3), got {covariances.shape}')
    try:
        return np.linalg.inv(np.linalg.cholesky(covariances))
    except np.linalg.LinAlgError:
        raise ValueError('a covariance is not positive definite') from None
