"""Linear least-squares fit of a quadric to the readings of a tumbled sensor."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.directions import even_weights

OUTLIER_STDS = 4.0
"""[std] Distance from the ellipsoid beyond which a reading is an outlier."""

MIN_SCALE = 1e-9
"""Minimum standard deviation of residuals, relative to the radius; less is due to rounding."""

POSSIBLE_CAUSES = ('possible causes are too few directions, a sensor at rest, or a field that is '
                   'not uniform')
"""Possible causes if the readings do not fit an ellipsoid."""


def fit_quadric(z: FloatArray) -> tuple[FloatArray, FloatArray, str]:
    """Fit an ellipsoid to normalised readings (n, 3), excluding outliers ([Renaudin10]_).

    Returns offset, correction, and the reason for a failure, empty if an ellipsoid was found. The
    weights by direction and the exclusion of outliers are additions of this package.
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
