"""The ellipsoid through the readings of a tumbled sensor, by robust geometric least squares.

Source: Kok and Schön, Magnetometer calibration using inertial sensors (2016), section V.A; the
weights by direction and the robust loss are this package's own.
"""

from typing import TypedDict

import numpy as np
from scipy.optimize import least_squares

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.directions import counted, coverage, empty_octants, even_weights
from mag_tracking.calibration.quadric import OUTLIER, robust_std

SOFT = 2.0
"""[std] Where the loss turns from square to linear; costs Gaussian noise little precision."""

N_BLOCKS = 40
"""Stretches of time that are left out in turn for the covariance; each must be long against the
time over which residuals are correlated."""

_UPPER = np.triu_indices(3)
_ROWS, _COLUMNS = _UPPER

BASIS = np.zeros((6, 3, 3))
"""(6, 3, 3) The symmetric matrices that `correction` is a sum of, one for each of its entries."""

BASIS[range(6), _ROWS, _COLUMNS] = BASIS[range(6), _COLUMNS, _ROWS] = 1.0


class Quality(TypedDict):
    """How well the readings tell the ellipsoid."""

    solved: bool
    """Whether the least squares converged."""
    directions: int
    """Cells with readings."""
    coverage: float
    """As in `EllipsoidFit`."""
    scatter: float
    """About the ellipsoid, over its radius, without outliers."""
    n_outliers: int
    empty: tuple[str, ...]
    """Octants with hardly a reading."""


def refine_ellipsoid(z: FloatArray, o: FloatArray, C: FloatArray) -> tuple[
        FloatArray, FloatArray, FloatArray, Quality]:
    """Offset (3,), correction (3, 3), covariance (9, 9) and quality of a fit of |C (z - o)| = 1.

    `z` (n, 3) are normalised readings; `o` and `C` are where the fit begins.
    """
    theta: FloatArray = np.concatenate([o, C[_UPPER]])
    for _ in range(2):
        w = even_weights(_model(theta, z)[0])
        scale = SOFT * robust_std(_model(theta, z)[1], w)
        fit = least_squares(  # type: ignore[operator]  # mypy takes the stubs' module of that name
            lambda p, s=scale: _model(p, z)[1] / s, theta,
            jac=lambda p, s=scale: _model(p, z)[2] / s,
            loss=lambda square, w=w: _loss(square, w), max_nfev=100)
        theta = fit.x
    q, d, J = _model(theta, z)
    fine = np.abs(d) <= OUTLIER * robust_std(d, w)
    u, _, n = counted(q[fine])
    quality: Quality = {
        'solved': fit.status > 0, 'directions': int((n > 0).sum()),
        'coverage': coverage(u, w[fine]),
        'scatter': float(np.sqrt(np.average(d[fine]**2, weights=w[fine]))),
        'n_outliers': int((~fine).sum()), 'empty': empty_octants(u, w[fine])}
    C = _symmetric(theta)
    return theta[:3], C, _covariance(d / scale, J / scale, w), quality


def _symmetric(theta: FloatArray) -> FloatArray:
    """(3, 3) correction from the parameters (9,)."""
    return np.asarray(np.tensordot(theta[3:], BASIS, 1), dtype=np.float64)


def _model(theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corrected readings (n, 3), their sizes less one (n,), and its Jacobian (n, 9)."""
    C = _symmetric(theta)
    y = z - theta[:3]
    q = y @ C
    r = np.linalg.norm(q, axis=1)
    u = q / np.maximum(r, 1e-12)[:, None]
    return q, r - 1.0, np.column_stack([-u @ C, np.einsum('ni,kij,nj->nk', u, BASIS, y)])


def _loss(square: FloatArray, w: FloatArray) -> FloatArray:
    """Weighted soft L1 and its two derivatives, as scipy wants them."""
    root = np.sqrt(1.0 + square)
    return w * np.stack([2.0 * (root - 1.0), 1.0 / root, -0.5 / root**3])


def _covariance(f: FloatArray, J: FloatArray, w: FloatArray) -> FloatArray:
    """(9, 9) by leaving out stretches of time in turn, one Newton step each; inf if one is vital.

    Residuals of a real sensor are correlated in time; what their number promises is not true.
    """
    n_blocks = min(N_BLOCKS, len(f))
    starts = np.arange(n_blocks) * len(f) // n_blocks
    scores = np.add.reduceat((w * f / np.sqrt(1.0 + f * f))[:, None] * J, starts)
    K = np.sqrt(w * (1.0 + f * f)**-1.5)[:, None] * J
    parts = np.stack([k.T @ k for k in np.split(K, starts[1:])])
    try:
        steps = np.linalg.solve(parts.sum(axis=0) - parts, scores[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return np.full((9, 9), np.inf)
    return (n_blocks - 1) / n_blocks * steps.T @ steps
