"""Kalman filters for vectors that change smoothly due to an unknown cause.

Each component is an integrated random walk: its rate of change is a Wiener process. The strength of
the process is unknown and may change: a bank of strengths is weighted by the data, and the
strength switches at a constant mean rate. The states of different strengths are not mixed, because
all states follow the same data.
"""

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference import core
from mag_tracking.records import plain

STRENGTHS = np.logspace(-1.5, 4.5, 13)
"""[1/s^1.5] Root spectral densities of the bank, relative to the scale of a component."""
SWITCH_INTERVAL_S = 0.75
"""[s] Mean time between switches of the strength."""


class GaussMarkovVectors:
    """Kalman filters for `n` independent vectors that start at zero ([BarShalom01]_ 6.2.2, 11.6).

    Parameters
    ----------
    scale : (m,), factor of `STRENGTHS` for each component; zero for constant ones, which come last
    std : initial std of each component
    """

    def __init__(self, n: int, scale: FloatArray, std: float) -> None:
        m, n_moving, n_strengths = len(scale), np.count_nonzero(scale), len(STRENGTHS)
        # [k, i]: strength k, component i.
        self._densities = np.square(STRENGTHS[:, None] * scale)
        # Constant components have no rate state: it would be exactly zero.
        self._x = np.zeros((n, n_strengths, m + n_moving))
        self._P = np.zeros((n, n_strengths, m + n_moving, m + n_moving))
        level, rate = np.arange(m), m + np.arange(n_moving)
        self._P[:, :, level, level] = std**2
        self._P[:, :, rate, rate] = self._densities[:, :n_moving]
        self._log_w = np.full((n, n_strengths), -np.log(n_strengths))

    def log_density(self, vector: IntArray, H: FloatArray, y: FloatArray, variance: FloatArray,
                    dt: float) -> float:
        """Update with scalar measurements; return their log-density [nats] given the earlier ones.

        Measurement i is H[i] (m,) times vector[i], plus noise of variance[i]. `vector` ascends, and
        `y` has no NaN. `dt` [s] is the time since the previous measurements.
        """
        return core.step_vectors(self._x, self._P, self._log_w, self._densities,
                                 plain(vector, np.int64), plain(H), plain(y), plain(variance), dt,
                                 SWITCH_INTERVAL_S)
