"""A covariance that covers another estimate, too.

Where two estimates of one state contradict each other, and it is not known which is wrong, the
covariance of the one that is kept grows until it covers the other.

Source: Uhlmann 2003, Covariance consistency methods for fault-tolerant distributed data fusion
(covariance union); here the position alone decides, and the other estimate has no covariance.
"""

import numpy as np

from mag_tracking.arrays import FloatArray


def inflated_to_cover(P: FloatArray, difference: FloatArray) -> FloatArray:
    """Covariance `P` (n, n) of a state, widened until its horizontal position covers another.

    The state begins with x and y [m]. Along their `difference` (k,), k <= n, from the other
    estimate the deviation is then no smaller than it. The rest of the state is widened along with
    them, and only with them.
    """
    d = difference[:2]
    square, variance = float(d @ d), float(d @ P[:2, :2] @ d)
    if not square > 0.0 or square**2 <= variance:
        return P
    whole = np.zeros(len(P))
    whole[:len(difference)] = difference
    return P + (1.0 - variance / square**2) * np.outer(whole, whole)
