"""Vectors that change smoothly, without a model of what moves them.

Each component is an integrated random walk: its rate of change is a Wiener process. How strong
that is, is unknown and may change: a bank of strengths is weighed by the data, and each gives way
to another one at a constant rate.

Source: Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and
Navigation, sections 6.2.2 (the process) and 11.6 (the weights; the states are not mixed here, as
all of them follow the same data).
"""

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference import core
from mag_tracking.records import plain

STRENGTHS = np.logspace(-1.5, 4.5, 13)
"""[1/s^1.5] Root spectral densities of the bank, in units of a vector's scale."""

SWITCH_S = 0.75
"""[s] Mean time for which a strength holds."""


class GaussMarkovVectors:
    """Filters of vectors that change independently of each other, and begin at zero."""

    def __init__(self, n: int, scale: FloatArray, std: float) -> None:
        """
        Parameters
        ----------
        n : int
            Number of vectors.
        scale : (m,) array
            Unit of the `STRENGTHS`, of each component; those that do not change, with zero, come
            last.
        std : float
            Standard deviation of each component at the beginning.
        """
        m, n_moving, n_strengths = len(scale), np.count_nonzero(scale), len(STRENGTHS)
        if not scale[:n_moving].all():
            raise ValueError('a component that does not change stands before one that does')
        # [k, i]: of strength k and component i.
        self._densities = np.square(STRENGTHS[:, None] * scale)
        # Rates of those that do not change would be states that are known to be zero.
        self._x = np.zeros((n, n_strengths, m + n_moving))
        self._P = np.zeros((n, n_strengths, m + n_moving, m + n_moving))
        level, rate = np.arange(m), m + np.arange(n_moving)
        self._P[:, :, level, level] = std**2
        self._P[:, :, rate, rate] = self._densities[:, :n_moving]
        self._log_w = np.full((n, n_strengths), -np.log(n_strengths))

    def log_density(self, vector: IntArray, H: FloatArray, y: FloatArray, variance: FloatArray,
                    dt: float) -> float:
        """Log-density of scalar measurements given those before.

        Parameters
        ----------
        vector : (n_y,) int array, ascending
            Which vector each measurement is of.
        H : (n_y, m) array
            The measurement is H times the vector.
        y, variance : (n_y,) arrays
            Measurements without NaN, and the variance of their noise, which is positive.
        dt : float [s]
            Since the measurements before.
        """
        return core.step_vectors(self._x, self._P, self._log_w, self._densities,
                                 plain(vector, np.int64), plain(H), plain(y), plain(variance), dt,
                                 SWITCH_S)
