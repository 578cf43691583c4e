"""Covariance union: a covariance inflated to cover a second estimate.

Used if two estimates of one state contradict each other and it is not known which one is wrong: the
covariance of the estimate that is kept grows until it covers the other.
"""

import numpy as np

from mag_tracking.arrays import FloatArray


def inflated_to_cover(P: FloatArray, difference: FloatArray) -> FloatArray:
    """Covariance of a state, inflated until its horizontal position covers another estimate.

    The standard deviation along the horizontal difference becomes no smaller than the difference.
    Other components are inflated in proportion to their own difference, fully correlated with it.

    Parameters
    ----------
    P : (n, n) array
        Covariance of a state that begins with x and y [m].
    difference : (k,) array
        The other estimate minus this one, of the first k <= n components.

    Returns
    -------
    (n, n) array
        `P` itself if it covers the other estimate already.

    Notes
    -----
    Only the horizontal position decides, and the other estimate has no covariance.

    References
    ----------
    [Uhlmann03]_, covariance union.
    """
    d = difference[:2]
    square, variance = float(d @ d), float(d @ P[:2, :2] @ d)
    if not square > 0.0 or square**2 <= variance:
        return P
    whole = np.zeros(len(P))
    whole[:len(difference)] = difference
    return P + (1.0 - variance / square**2) * np.outer(whole, whole)
