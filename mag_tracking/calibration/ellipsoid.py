"""Ellipsoid through the readings of a tumbled sensor: directions, quadric and robust refinement."""

from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from mag_tracking.arrays import FloatArray, IntArray

EMPTY_OCTANT = 0.125
"""Maximum weight of an empty octant relative to the mean weight of an octant."""
N_CELLS = 500
"""Number of equal cells on the sphere of directions, about 10 degrees wide."""
MAX_CELL_WEIGHT = 3.0
"""Maximum total weight of a cell, in multiples of the median number of readings per cell."""
_OCTANTS = np.array(list(product([1.0, -1.0], repeat=3)))
_OCTANT_NAMES = [''.join(name) for name in product(('+x', '-x'), ('+y', '-y'), ('+z', '-z'))]

OUTLIER_STDS = 4.0
"""[std] Distance from the ellipsoid beyond which a reading is an outlier."""
MIN_SCALE = 1e-9
"""Minimum standard deviation of residuals, relative to the radius; less is due to rounding."""
POSSIBLE_CAUSES = ('possible causes are too few directions, a sensor at rest, or a field that is '
                   'not uniform')
"""Possible causes if the readings do not fit an ellipsoid."""
LOSS_SCALE = 2.0
"""[std] Residual at which the loss changes from quadratic to linear."""
N_BLOCKS = 40
"""Number of intervals of the block jackknife, longer than the correlation time of the residuals."""
_ROWS, _COLUMNS = np.triu_indices(3)

BASIS = np.zeros((6, 3, 3))
"""(6, 3, 3) Symmetric basis matrices of `correction`, one for each of its entries."""
BASIS[range(6), _ROWS, _COLUMNS] = BASIS[range(6), _COLUMNS, _ROWS] = 1.0


def _cells() -> cKDTree:
    """Build a k-d tree of N_CELLS evenly spread unit vectors (a Fibonacci spiral)."""
    i = np.arange(N_CELLS) + 0.5
    z, angle = 1.0 - 2.0 * i / N_CELLS, np.pi * (1.0 + np.sqrt(5.0)) * i
    rho = np.sqrt(1.0 - z * z)
    return cKDTree(np.stack([rho * np.cos(angle), rho * np.sin(angle), z], axis=1))


_CELLS = _cells()


def binned(q: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
    """Unit vectors of `q` (n, 3), the cell of each (n,), and the count of each cell (N_CELLS,)."""
    u = q / np.maximum(np.linalg.norm(q, axis=1), 1e-12)[:, None]
    cell = np.asarray(_CELLS.query(u)[1], dtype=np.int64)
    return u, cell, np.asarray(np.bincount(cell, minlength=N_CELLS), dtype=np.int64)


def even_weights(q: FloatArray) -> FloatArray:
    """Weights (n,), 0 to 1, that limit crowded directions of `q` (n, 3) to `MAX_CELL_WEIGHT`."""
    _, cell, n = binned(q)
    return np.minimum(1.0, MAX_CELL_WEIGHT * np.median(n[n > 0]) / n[cell])


def coverage(u: FloatArray, w: FloatArray) -> float:
    """Coverage of the sphere by unit vectors (n, 3) with weights (n,): 0 to 1, 1 if even.

    It is the smallest eigenvalue of the weighted mean of f fᵀ, with the spherical harmonics f to
    degree two.
    """
    x, y, z = u.T
    s = np.sqrt(15.0)
    f = np.column_stack([np.ones(len(u)), np.sqrt(3.0) * u, s * x * y, s * y * z, s * x * z,
                         0.5 * s * (x * x - y * y), 0.5 * np.sqrt(5.0) * (3.0 * z * z - 1.0)])
    # Rounding can make a zero negative.
    return max(0.0, float(np.linalg.eigvalsh(f.T @ (w[:, None] * f) / w.sum())[0]))


def empty_octants(u: FloatArray, w: FloatArray) -> tuple[str, ...]:
    """Octants, e.g. '+x-y+z', whose weight is below `EMPTY_OCTANT` of the mean weight."""
    weight = 8.0 * np.bincount(np.argmax(u @ _OCTANTS.T, axis=1), w, 8) / w.sum()
    return tuple(name for name, w in zip(_OCTANT_NAMES, weight, strict=True) if w < EMPTY_OCTANT)


def fit_quadric(z: FloatArray) -> tuple[FloatArray, FloatArray, str]:
    """Fit an ellipsoid to normalised readings (n, 3), excluding outliers ([Renaudin10]_).

    Returns offset, correction, and the reason for a failure. The weights by direction and the
    exclusion of outliers are additions of this package.
    """
    # The midpoint of the extremes is inside the ellipsoid, even if the sensor was mostly at rest.
    w = even_weights(z - 0.5 * (z.min(axis=0) + z.max(axis=0)))
    o: FloatArray = np.full(3, np.nan)
    C: FloatArray = np.full((3, 3), np.nan)
    for _ in range(5):
        x, y, v = z.T
        # sqrt(2) makes the length of the vector of coefficients independent of the axes.
        D = np.column_stack([z * z, np.sqrt(2.0) * np.stack([x * y, x * v, y * v], 1), z,
                             np.ones(len(z))])
        a = np.linalg.svd(np.sqrt(w)[:, None] * D, full_matrices=False)[2][-1]
        A = np.diag(a[:3])
        A[[0, 0, 1], [1, 2, 2]] = A[[1, 2, 2], [0, 0, 1]] = a[3:6] / np.sqrt(2.0)
        A, a = (A, a) if np.trace(A) > 0.0 else (-A, -a)
        e = np.linalg.eigvalsh(A)
        if not e[0] > 1e-6 * e[2]:
            return o, C, ('the readings do not lie on an ellipsoid: the ratio of the smallest to '
                          'the largest eigenvalue of the quadric must be positive, got '
                          f'{e[0] / e[2]:.2g}; {POSSIBLE_CAUSES}')
        o = -0.5 * np.linalg.solve(A, a[6:9])
        k = o @ A @ o - a[9]
        if not k > 0.0:
            return o, C, ('the readings do not lie on an ellipsoid: the squared radius must be '
                          f'positive, got {k:.2g}; {POSSIBLE_CAUSES}')
        e, V = np.linalg.eigh(A / k)
        C = (V * np.sqrt(e)) @ V.T
        q = (z - o) @ C
        w = even_weights(q)
        d = np.abs(np.linalg.norm(q, axis=1) - 1.0)
        w = w * (d <= OUTLIER_STDS * robust_std(d, w))
    return o, C, ''


def robust_std(d: FloatArray, w: FloatArray) -> float:
    """Robust std of residuals (n,) from the weighted median of their magnitudes, >= `MIN_SCALE`."""
    order = np.argsort(np.abs(d))
    cumulative_weight = np.cumsum(w[order])
    median = np.abs(d)[order][np.searchsorted(cumulative_weight, 0.5 * cumulative_weight[-1])]
    return max(1.4826 * float(median), MIN_SCALE)


class Quality(NamedTuple):
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
    theta: FloatArray = np.concatenate([o, C[_ROWS, _COLUMNS]])
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
    quality = Quality(fit.status > 0, int((n > 0).sum()), coverage(u, w[is_inlier]),
                      float(np.sqrt(np.average(d[is_inlier]**2, weights=w[is_inlier]))),
                      int((~is_inlier).sum()), empty_octants(u, w[is_inlier]))
    return theta[:3], _symmetric(theta), _covariance(d / scale, J / scale, w), quality


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
    """Covariance (9, 9) by a block jackknife in time, because real residuals are correlated, with
    one Newton step per block; infinite if singular."""
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
