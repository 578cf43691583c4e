"""Moments of a Gaussian mixture."""

import numpy as np

from mag_tracking.arrays import FloatArray


def second_moment(weights: FloatArray, differences: FloatArray,
                  covariances: FloatArray) -> FloatArray:
    """Mean squared error matrix of an estimate if the truth follows a Gaussian mixture.

    Parameters
    ----------
    weights : (n,) array
        Weights of the components, not necessarily normalised.
    differences : (n, d) array
        Means of the components minus the estimate.
    covariances : (n, d, d) array
        Covariances of the components.

    Returns
    -------
    (d, d) array
        Second moment about the estimate; the covariance if the estimate is the mean of the mixture.

    References
    ----------
    [BarShalom01]_ section 1.4.16, with the estimate in place of the mean.
    """
    w = weights / weights.sum()
    moment: FloatArray = (np.einsum('n,nij->ij', w, covariances)
                          + np.einsum('n,ni,nj->ij', w, differences, differences))
    return moment
