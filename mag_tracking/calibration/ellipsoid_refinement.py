"""Robust geometric least-squares fit of an ellipsoid to the readings of a tumbled sensor."""

from typing import TypedDict

import numpy as np
from scipy.optimize import least_squares

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.directions import binned, coverage, empty_octants, even_weights
from mag_tracking.calibration.quadric import OUTLIER_STDS, robust_std

LOSS_SCALE = 2.0
"""[std] Residual at which the loss changes from quadratic to linear; the loss of efficiency for
Gaussian noise is small."""

N_BLOCKS = 40
"""Number of intervals of the block jackknife for the covariance. Each interval must be long
compared with the correlation time of the residuals."""

_UPPER = np.triu_indices(3)
_ROWS, _COLUMNS = _UPPER

BASIS = np.zeros((6, 3, 3))
"""(6, 3, 3) Symmetric basis matrices of `correction`, one for each of its entries."""

BASIS[range(6), _ROWS, _COLUMNS] = BASIS[range(6), _COLUMNS, _ROWS] = 1.0


class Quality(TypedDict):
    """Quality measures of a fitted ellipsoid."""

    solved: bool
    """Whether the least-squares fit converged."""
    directions: int
    """Number of cells with readings."""
    coverage: float
    """Coverage of the sphere by the corrected readings, as in `EllipsoidFit`."""
    scatter: float
    """Scatter about the ellipsoid relative to its radius, without outliers."""
    n_outliers: int
    empty: tuple[str, ...]
    """Names of the octants with few or no readings, e.g. '+x-y+z'."""


def refine_ellipsoid(z: FloatArray, o: FloatArray, C: FloatArray) -> tuple[
        FloatArray, FloatArray, FloatArray, Quality]:
    """Fit ‖C (z - o)‖ = 1 to normalised readings (n, 3), from initial `o` and `C`.

    Returns the offset, the correction, the covariance (9, 9) of the offset and the six entries of
    the correction, and the quality. [KokSchon16]_ section V.A; the weights by direction and the
    robust loss are additions of this package.
    """
    theta: FloatArray = np.concatenate([o, C[_UPPER]])
    for _ in range(2):
        w = even_weights(_model(theta, z)[0])
        scale = LOSS_SCALE * robust_std(_model(theta, z)[1], w)
        fit = least_squares(  # type: ignore[operator]  # mypy finds a module of that name
            lambda p, s=scale: _model(p, z)[1] / s, theta,
            jac=lambda p, s=scale: _model(p, z)[2] / s,
            loss=lambda square, w=w: _loss(square, w), max_nfev=100)
        theta = fit.x
    q, d, J = _model(theta, z)
    is_inlier = np.abs(d) <= OUTLIER_STDS * robust_std(d, w)
    u, _, n = binned(q[is_inlier])
    quality: Quality = {
        'solved': fit.status > 0, 'directions': int((n > 0).sum()),
        'coverage': coverage(u, w[is_inlier]),
        'scatter': float(np.sqrt(np.average(d[is_inlier]**2, weights=w[is_inlier]))),
        'n_outliers': int((~is_inlier).sum()), 'empty': empty_octants(u, w[is_inlier])}
    C = _symmetric(theta)
    return theta[:3], C, _covariance(d / scale, J / scale, w), quality


def _symmetric(theta: FloatArray) -> FloatArray:
    """Symmetric correction matrix (3, 3) from the parameters (9,) of the ellipsoid."""
    return np.asarray(np.tensordot(theta[3:], BASIS, 1), dtype=np.float64)


def _model(theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corrected readings (n, 3), their magnitudes minus one (n,), and Jacobian of these (n, 9)."""
    C = _symmetric(theta)
    y = z - theta[:3]
    q = y @ C
    r = np.linalg.norm(q, axis=1)
    u = q / np.maximum(r, 1e-12)[:, None]
    return q, r - 1.0, np.column_stack([-u @ C, np.einsum('ni,kij,nj->nk', u, BASIS, y)])


def _loss(square: FloatArray, w: FloatArray) -> FloatArray:
    """Weighted soft-L1 loss with its first two derivatives, as `scipy.optimize` requires."""
    root = np.sqrt(1.0 + square)
    return w * np.stack([2.0 * (root - 1.0), 1.0 / root, -0.5 / root**3])


def _covariance(f: FloatArray, J: FloatArray, w: FloatArray) -> FloatArray:
    """Covariance (9, 9) by a block jackknife in time, one Newton step per block.

    Real residuals are correlated in time, so their number overstates the information. Infinite if
    the fit is singular without one of the blocks.
    """
    n_blocks = min(N_BLOCKS, len(f))
    starts = np.arange(n_blocks) * len(f) // n_blocks
    scores = np.add.reduceat((w * f / np.sqrt(1.0 + f * f))[:, None] * J, starts)
    K = np.sqrt(w * (1.0 + f * f)**-1.5)[:, None] * J
    hessians = np.stack([k.T @ k for k in np.split(K, starts[1:])])
    try:
        steps = np.linalg.solve(hessians.sum(axis=0) - hessians, scores[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return np.full((9, 9), np.inf)
    return (n_blocks - 1) / n_blocks * steps.T @ steps
