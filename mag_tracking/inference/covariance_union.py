"""Covariances that cover another estimate, too.

Where two estimates of one state contradict each other, and it is not known which is wrong, the
covariance of the one that is kept grows until it covers the other.

Source: Uhlmann 2003, Covariance consistency methods for fault-tolerant distributed data fusion
(covariance union), here for a difference in one direction.
"""

import numpy as np

from mag_tracking.arrays import FloatArray


def covering(P: FloatArray, difference: FloatArray) -> FloatArray:
    """Covariance `P` (n, n) of a state, widened until it covers a `difference` (k,), k <= n.

    The state begins with x and y [m]; along the difference of those, the deviation is then no
    smaller than it. The rest of the state differs along with them.
    """
    d = difference[:2]
    square, variance = float(d @ d), float(d @ P[:2, :2] @ d)
    if square**2 <= variance:
        return P
    whole = np.zeros(len(P))
    whole[:len(difference)] = difference
    return P + (1.0 - variance / square**2) * np.outer(whole, whole)
