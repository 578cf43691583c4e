"""Axes whose steps are larger than their noise: how quiet they are without a target.

The covariance of a resting axis says how well it measures a field: within a step. Without a target
it does not move at all, so that two axes that move by one step each are no noise.
"""

import numpy as np
from numba import float64, void

from mag_tracking.arrays import FloatArray
from mag_tracking.compiled import compiled_when_used
from mag_tracking.records import plain

MEMORY_FRAMES = 100
"""Frames without a target that the usual variance of each axis is of, about."""

RESTS = 25.0
"""An axis rests where its fields vary by less than their covariance states, by this factor."""

MOST = 20.0
"""The variance of a resting axis is taken to be smaller by this factor. One axis of two sensors
that moves by one step, as it does while its background drifts, stays below the threshold."""

_V, _M = float64[:, ::1], float64[:, :, ::1]


class RestingAxes:
    """Usual variance of each axis of a network, in frames without a target."""

    def __init__(self, n_sensors: int) -> None:
        self._n: FloatArray = np.zeros((n_sensors, 3))
        self._square: FloatArray = np.zeros((n_sensors, 3))

    def learn(self, field: FloatArray) -> None:
        """Take the `field` (n_sensors, 3) [T] of a frame without a target; NaN = missing."""
        _learn(plain(field), self._n, self._square)

    def covariance(self, covariance: FloatArray, allowance: float) -> FloatArray:
        """Covariance of the fields of a frame without a target.

        Parameters
        ----------
        covariance : (n_sensors, 3, 3) array, T^2
            Of the frame.
        allowance : float, T^2
            Variance of what each background may be off by.

        Returns
        -------
        (n_sensors, 3, 3) array, T^2
        """
        out = np.empty_like(covariance)
        _scale(plain(covariance), self._n, self._square, allowance, out)
        return out


@compiled_when_used(void(_V, _V, _V))
def _learn(field: FloatArray, n: FloatArray, square: FloatArray) -> None:
    """`RestingAxes.learn`."""
    for j in range(len(field)):
        for a in range(3):
            if not np.isnan(field[j, a]):
                n[j, a] = min(n[j, a] + 1.0, MEMORY_FRAMES)
                square[j, a] += (field[j, a]**2 - square[j, a]) / n[j, a]


@compiled_when_used(void(_M, _V, _V, float64, _M))
def _scale(covariance: FloatArray, n: FloatArray, square: FloatArray, allowance: float,
           out: FloatArray) -> None:
    """`RestingAxes.covariance`."""
    std = np.ones(3)
    for j in range(len(covariance)):
        for a in range(3):
            # A comparison with NaN is false: a missing axis does not rest.
            rests = n[j, a] >= MEMORY_FRAMES / 4 and RESTS * square[j, a] < covariance[j, a, a]
            std[a] = np.sqrt(1.0 / MOST) if rests else 1.0
        for a in range(3):
            for b in range(3):
                out[j, a, b] = covariance[j, a, b] * std[a] * std[b]
            out[j, a, a] += allowance
