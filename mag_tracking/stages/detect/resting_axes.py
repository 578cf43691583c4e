"""Axes whose steps are larger than their noise: how quiet they are without a target.

The covariance of a resting axis says how well it measures a field: within a step. Without a target
it does not move at all, so that two axes that move by one step each are no noise.
"""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.records import plain
from mag_tracking.stages.detect import core

MEMORY_FRAMES = 100
"""Frames without a target that the usual variance of each axis is of, about."""

RESTS = 25.0
"""An axis rests where its fields vary by less than their covariance states, by this factor."""

MOST = 20.0
"""The variance of a resting axis is taken to be smaller by this factor. One axis of two sensors
that moves by one step, as it does while its background drifts, stays below the threshold."""


class RestingAxes:
    """Usual variance of each axis of a network, in frames without a target."""

    def __init__(self, n_sensors: int) -> None:
        self._n: FloatArray = np.zeros((n_sensors, 3))
        self._square: FloatArray = np.zeros((n_sensors, 3))

    def learn(self, field: FloatArray) -> None:
        """Take the `field` (n_sensors, 3) [T] of a frame without a target; NaN = missing."""
        core.learn(plain(field), MEMORY_FRAMES, self._n, self._square)

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
        return core.scaled(plain(covariance), self._n, self._square, MEMORY_FRAMES / 4, RESTS, MOST,
                           allowance)
