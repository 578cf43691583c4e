"""The quadric through the readings of a tumbled sensor, by linear least squares.

Source: Renaudin, Afzal and Lachapelle, Complete triaxis magnetometer calibration in the magnetic
domain (2010); the weights by direction and the outliers set aside are this package's own.
"""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.directions import even_weights

OUTLIER = 4.0
"""[std] Readings further from the ellipsoid are outliers."""

MIN_SCALE = 1e-9
"""Residual std, over the radius, below which it is rounding."""

DOUBT = 'too few directions, a sensor that lay still, or a field that is not uniform'


def fit_quadric(z: FloatArray) -> tuple[FloatArray, FloatArray, str]:
    """Offset (3,), correction (3, 3) and reason of a linear fit to normalised readings (n, 3).

    Outliers are set aside.
    """
    # Half-way between the extremes is inside, however long the sensor lay still somewhere.
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
            return o, C, ('the readings lie on no ellipsoid, smallest over largest eigenvalue of '
                          f'the quadric {e[0] / e[2]:.2g}, must be positive: {DOUBT}')
        o = -0.5 * np.linalg.solve(A, a[6:9])
        k = o @ A @ o - a[9]
        if not k > 0.0:
            return o, C, f'the readings lie on no ellipsoid, squared radius {k:.2g}: {DOUBT}'
        e, V = np.linalg.eigh(A / k)
        C = (V * np.sqrt(e)) @ V.T
        q = (z - o) @ C
        w = even_weights(q)
        d = np.abs(np.linalg.norm(q, axis=1) - 1.0)
        w = w * (d <= OUTLIER * robust_std(d, w))
    return o, C, ''


def robust_std(d: FloatArray, w: FloatArray) -> float:
    """Standard deviation from the weighted median of |d|; `d` and weights `w` are (n,)."""
    order = np.argsort(np.abs(d))
    total = np.cumsum(w[order])
    middle = np.abs(d)[order][np.searchsorted(total, 0.5 * total[-1])]
    return max(1.4826 * float(middle), MIN_SCALE)
