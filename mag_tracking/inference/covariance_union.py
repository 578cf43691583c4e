"""Covariance union: a covariance inflated to cover a second estimate.

If two estimates of one state contradict each other and it is unknown which of them is wrong, the
covariance of one estimate is inflated until it covers the other estimate.
"""

import numpy as np

from mag_tracking.arrays import FloatArray


def inflated_to_cover(P: FloatArray, difference: FloatArray) -> FloatArray:
    """Inflate the covariance of a state until it covers another estimate of the position.

    The standard deviation along the horizontal difference becomes at least the length of that
    difference. Each other component is inflated in proportion to its own difference; the added
    errors of all components are fully correlated.

    Parameters
    ----------
    P : (n, n) array
        Covariance of a state that begins with x and y [m].
    difference : (k,) array
        Other estimate minus this estimate, for the first k <= n components.

    Returns
    -------
    (n, n) array
        `P` itself if it already covers the other estimate.

    Notes
    -----
    Only the horizontal position determines the inflation. The covariance of the other estimate is
    not used.

    References
    ----------
    [Uhlmann03]_, covariance union.
    """
    d = difference[:2]
    square, variance = float(d @ d), float(d @ P[:2, :2] @ d)
    if not square > 0.0 or square**2 <= variance:
        return P
    padded_difference = np.zeros(len(P))
    padded_difference[:len(difference)] = difference
    return P + (1.0 - variance / square**2) * np.outer(padded_difference, padded_difference)
