"""Moments of a Gaussian mixture."""

import numpy as np

from mag_tracking.arrays import FloatArray


def second_moment(weights: FloatArray, differences: FloatArray,
                  covariances: FloatArray) -> FloatArray:
    """Second moment (d, d) of a Gaussian mixture about an estimate, [BarShalom01]_ section 1.4.16.

    `differences` (n, d) are the component means minus the estimate; `weights` need no
    normalisation. It is the covariance if the estimate is the mean of the mixture.
    """
    w = weights / weights.sum()
    moment: FloatArray = (np.einsum('n,nij->ij', w, covariances)
                          + np.einsum('n,ni,nj->ij', w, differences, differences))
    return moment
