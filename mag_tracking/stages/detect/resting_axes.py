"""Reduction of the variance of axes with coarse resolution while no target is present.

The covariance of such an axis includes the quantisation error of one step. Without a target the
readings of the axis do not change, so simultaneous steps of two axes are not noise.
"""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.records import plain
from mag_tracking.stages.detect import core

MEMORY_FRAMES = 100
"""Approximate number of frames without a target over which the square of each axis is averaged."""

RESTING_RATIO = 25.0
"""Minimum ratio of the nominal to the measured variance of an axis at rest."""

VARIANCE_REDUCTION = 20.0
"""Factor by which the variance of an axis at rest is reduced. In a network of two sensors, a single
step of one axis, which background drift can cause, remains below the threshold."""


class RestingAxes:
    """Finds axes at rest by the mean square of their field in frames without a target."""

    def __init__(self, n_sensors: int) -> None:
        self._n: FloatArray = np.zeros((n_sensors, 3))
        self._mean_square: FloatArray = np.zeros((n_sensors, 3))

    def learn(self, field: FloatArray) -> None:
        """Update the averages with the field (n_sensors, 3) of a frame without a target."""
        core.learn(plain(field), MEMORY_FRAMES, self._n, self._mean_square)

    def covariance(self, covariance: FloatArray, background_variance: float) -> FloatArray:
        """Covariance of a frame, with smaller variances of the axes at rest and
        `background_variance` [T²] added to each axis."""
        return core.scaled(plain(covariance), self._n, self._mean_square, MEMORY_FRAMES / 4,
                           RESTING_RATIO, VARIANCE_REDUCTION, background_variance)
