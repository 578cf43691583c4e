"""Moments of a mixture of Gaussians."""

import numpy as np

from mag_tracking.arrays import FloatArray


def second_moment(weights: FloatArray, differences: FloatArray,
                  covariances: FloatArray) -> FloatArray:
    """Mean square of the error of one estimate, where each member of a mixture may be right.

    Parameters
    ----------
    weights : (n,) array
        Of the members; they need not sum to one.
    differences : (n, d) array
        Means of the members minus the estimate.
    covariances : (n, d, d) array
        Of the members.

    Returns
    -------
    (d, d) array
        About the estimate; a covariance where that is the mean of the mixture.

    References
    ----------
    Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and Navigation,
    section 1.4.16, with the estimate in place of the mean.
    """
    w = weights / weights.sum()
    moment: FloatArray = (np.einsum('n,nij->ij', w, covariances)
                          + np.einsum('n,ni,nj->ij', w, differences, differences))
    return moment
