"""Linear terms with a Gaussian prior, taken out of whitened measurements.

With y = C c + e, c and e standard normal, the covariance of y is I + C C'. Its inverse root is I on
all directions but the few that C spans, so that a large problem stays cheap.
"""

import numpy as np

from mag_tracking.arrays import FloatArray


class MarginalWhitener:
    """The inverse root of I + C C'."""

    def __init__(self, columns: FloatArray) -> None:
        """`columns` C (n_y, q), each times the standard deviation of its coefficient."""
        self._U, size, _ = np.linalg.svd(columns, full_matrices=False)
        self._size = size
        self._taken: FloatArray = 1.0 - 1.0 / np.sqrt(1.0 + size**2)

    def __call__(self, A: FloatArray) -> FloatArray:
        """The inverse root times A (..., n_y, k), or (n_y,)."""
        whitened: FloatArray = A - (self._U * self._taken) @ (self._U.T @ A)
        return whitened

    def correction_factor(self, A: FloatArray) -> FloatArray:
        """F(A) (q, k) for A (n_y, k): A' inv(I + C C') B = A'B - F(A)' F(B)."""
        share: FloatArray = self._size / np.sqrt(1.0 + self._size**2)
        return share[:, None] * (self._U.T @ A)
