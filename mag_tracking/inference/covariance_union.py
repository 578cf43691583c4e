"""Covariance union: a covariance inflated to cover a second estimate.

If two estimates of one state contradict each other and it is unknown which of them is wrong, the
covariance of one estimate is inflated until it covers the other estimate.
"""

import numpy as np

from mag_tracking.arrays import FloatArray


def inflated_to_cover(P: FloatArray, difference: FloatArray) -> FloatArray:
    """Inflate `P`, whose state begins with x and y, to cover another estimate ([Uhlmann03]_).

    `difference` is the other estimate minus this one, for the first components. The std along its
    horizontal part becomes at least the length of that part; the other components are inflated in
    proportion to their differences, fully correlated. `P` itself is returned if it suffices. The
    covariance of the other estimate is not used.
    """
    d = difference[:2]
    square, variance = float(d @ d), float(d @ P[:2, :2] @ d)
    if not square > 0.0 or square**2 <= variance:
        return P
    padded_difference = np.zeros(len(P))
    padded_difference[:len(difference)] = difference
    return P + (1.0 - variance / square**2) * np.outer(padded_difference, padded_difference)
