"""Uncertainty of the middle of a vehicle due to the length that has not been observed."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.stages.track.sensor_selection import offset_from_nearest

MAX_CAR_ROW = 4.0
"""[m] Maximum length of the row of dipoles of a car. The iron of longer vehicles extends beyond the
row."""

MIN_SPEED_STDS = 3.0
"""A vehicle has a heading if its speed exceeds this number of standard deviations."""


class UnobservedLength:
    """Uncertainty of the middle of a vehicle due to the part that no sensor has observed yet; use
    one instance for each target.

    Until its rear has passed a sensor, an apparent car may be the engine of a truck. A row of
    dipoles explains both, and both models are too inaccurate for a reliable comparison.

    The iron of a long vehicle is at its engine, axles and load, so the row of dipoles is shorter
    than the vehicle. Until the rear has been observed, the rest of the vehicle is assumed to be
    behind the row. Afterwards, it may be at either end, and the middle is uniformly distributed
    between these two cases.

    All kinds of vehicle, with `lengths` and `length_stds` in m, are equally frequent.
    """

    def __init__(self, lengths: Sequence[float], length_stds: Sequence[float]) -> None:
        self._lengths, self._stds = np.array(lengths), np.array(length_stds)
        self._forward: FloatArray = np.zeros(2)
        self._distance_travelled = -np.inf
        self._last_position: FloatArray = np.zeros(2)

    def update(self, x: FloatArray, P: FloatArray, positions: FloatArray, is_certain: bool) -> None:
        """Update the direction of travel and, if the position is certain (unambiguous), the
        distance travelled.

        The state `x` (n_t,) begins with position and velocity. `positions` (n_sensors, 3) are those
        of the sensors that measured.
        """
        self._forward = self._direction(x, P)
        if not is_certain or not len(positions):
            return
        if self._distance_travelled > 0.0:
            # After the first sensor the distance along the path is used, which is also valid in a
            # turn.
            self._distance_travelled += float(np.linalg.norm(x[:2] - self._last_position))
        else:
            self._distance_travelled = float(offset_from_nearest(x[:2], positions) @ self._forward)
        self._last_position = x[:2].copy()

    def covariance(self, x: FloatArray, P: FloatArray, length: float, kind: int) -> FloatArray:
        """Covariance (2, 2) of the middle, to be added to that of the horizontal position, m², for
        a row of dipoles of a given length [m]."""
        half_hidden = 0.5 * (self._lengths - length)
        second_moment = np.maximum(half_hidden, 0.0)**2 + 0.25 * self._stds**2
        # A longer vehicle would have been observed once its middle has passed a sensor.
        is_possible = ((self._lengths > self._lengths[kind]) & (half_hidden > 0.0)
                       & (self._distance_travelled < half_hidden))
        variance = second_moment[is_possible].sum() / len(self._lengths)
        if self._lengths[kind] > MAX_CAR_ROW:
            is_sensed = self._distance_travelled >= half_hidden[kind]
            variance += second_moment[kind] / (3.0 if is_sensed else 1.0)
        forward = self._direction(x, P)
        covariance: FloatArray = variance * np.outer(forward, forward)
        return covariance

    def _direction(self, x: FloatArray, P: FloatArray) -> FloatArray:
        """Unit vector (2,) of the motion; the previous one if the target hardly moves."""
        speed = float(np.hypot(x[3], x[4]))
        is_moving = speed > MIN_SPEED_STDS * np.sqrt(max(0.0, P[3, 3] + P[4, 4]))
        return x[3:5] / speed if is_moving else self._forward
