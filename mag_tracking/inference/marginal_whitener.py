"""Whitening of measurements with linear nuisance terms that have a Gaussian prior.

For y = C c + e with standard normal c and e, the covariance of y is I + C C'. Its inverse root is
the identity outside the few directions spanned by C. Whitening a large problem is therefore cheap.
"""

import numpy as np

from mag_tracking.arrays import FloatArray


class MarginalWhitener:
    """Whitening by the inverse root of I + C C'.

    C, `columns` (n_y, q), contains the nuisance terms, each times the std of its coefficient.
    """

    def __init__(self, columns: FloatArray) -> None:
        self._U, singular_values, _ = np.linalg.svd(columns, full_matrices=False)
        self._singular_values = singular_values
        self._attenuation: FloatArray = 1.0 - 1.0 / np.sqrt(1.0 + singular_values**2)

    def __call__(self, A: FloatArray) -> FloatArray:
        """Return `A`, (..., n_y, k) or (n_y,), multiplied by the inverse root of I + C C'."""
        whitened: FloatArray = A - (self._U * self._attenuation) @ (self._U.T @ A)
        return whitened

    def correction_factor(self, A: FloatArray) -> FloatArray:
        """Factor F(A) (q, k) of the low-rank correction in A' inv(I + C C') B = A'B - F(A)'
        F(B)."""
        gain: FloatArray = self._singular_values / np.sqrt(1.0 + self._singular_values**2)
        return gain[:, None] * (self._U.T @ A)
