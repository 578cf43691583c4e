"""Whitening of measurements with linear nuisance terms that have a Gaussian prior.

With y = C c + e and c, e standard normal, the covariance of y is I + C C'. Its inverse root is I in
all directions outside the few that C spans, so that whitening a large problem is cheap.
"""

import numpy as np

from mag_tracking.arrays import FloatArray


class MarginalWhitener:
    """Inverse root of the covariance I + C C'.

    Parameters
    ----------
    columns : (n_y, q) array
        C: columns of the nuisance terms, each times the standard deviation of its coefficient.
    """

    def __init__(self, columns: FloatArray) -> None:
        self._U, size, _ = np.linalg.svd(columns, full_matrices=False)
        self._size = size
        self._taken: FloatArray = 1.0 - 1.0 / np.sqrt(1.0 + size**2)

    def __call__(self, A: FloatArray) -> FloatArray:
        """Whiten `A` (..., n_y, k), or (n_y,)."""
        whitened: FloatArray = A - (self._U * self._taken) @ (self._U.T @ A)
        return whitened

    def correction_factor(self, A: FloatArray) -> FloatArray:
        """Factor F(A) of the low-rank correction: A' inv(I + C C') B = A'B - F(A)' F(B).

        Parameters
        ----------
        A : (n_y, k) array

        Returns
        -------
        (q, k) array
        """
        share: FloatArray = self._size / np.sqrt(1.0 + self._size**2)
        return share[:, None] * (self._U.T @ A)
