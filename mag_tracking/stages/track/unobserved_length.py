"""How far the middle of a vehicle may be from where its field seems to come from."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.stages.track.sensor_selection import from_nearest

CAR_ROW = 4.0
"""[m] A kind whose row is up to this long is a car: its iron is about in its middle."""

MOVES = 3.0
"""A vehicle has a heading while its speed is larger than so many of its deviations."""


class UnobservedLength:
    """For one track: the part of a vehicle that no sensor has felt yet, which moves its middle.

    Until its rear has come near a sensor a car may be the engine of a truck: a row of dipoles
    explains either, and the evidence of the two is that of models which are both wrong.

    The iron of a long vehicle is where its engine, axles and load are. By what it is longer than
    its row it reaches back as long as its rear has not been felt; then at either end: where its
    middle is, is uniform in between.
    """

    def __init__(self, lengths: Sequence[float], length_stds: Sequence[float]) -> None:
        """`lengths` and `length_stds` [m] of the kinds of vehicle, taken as equally frequent."""
        self._lengths, self._stds = np.array(lengths), np.array(length_stds)
        self._forward: FloatArray = np.zeros(2)
        self._beyond = -np.inf
        self._place: FloatArray = np.zeros(2)

    def look(self, x: FloatArray, P: FloatArray, positions: FloatArray, is_sure: bool) -> None:
        """Note which way a target goes and, if the place `is_sure`, how far it has come.

        Parameters
        ----------
        x, P : (n_t,), (n_t, n_t)
            A state that begins with position and velocity, and its covariance.
        positions : (n_sensors, 3) [m]
            The places of those sensors that measured.
        is_sure : bool
        """
        self._forward = self._forward_of(x, P)
        if not is_sure or not len(positions):
            return
        if self._beyond > 0.0:
            # From then on it is the way that counts: round a corner, too.
            self._beyond += float(np.linalg.norm(x[:2] - self._place))
        else:
            self._beyond = float(from_nearest(x[:2], positions) @ self._forward)
        self._place = x[:2].copy()

    def covariance(self, x: FloatArray, P: FloatArray, length: float, kind: int) -> FloatArray:
        """(2, 2) [m^2] to be added to that of the horizontal position.

        Parameters
        ----------
        x, P : (n_t,), (n_t, n_t)
            As for `look`.
        length : float [m]
            Length of the row of dipoles.
        kind : int
            Row of the kind of vehicle among the lengths.
        """
        behind = 0.5 * (self._lengths - length)
        square = np.maximum(behind, 0.0)**2 + 0.25 * self._stds**2
        # Once its middle would have passed a sensor, a longer vehicle has been felt.
        possible = ((self._lengths > self._lengths[kind]) & (behind > 0.0)
                    & (self._beyond < behind))
        variance = square[possible].sum() / len(self._lengths)
        if self._lengths[kind] > CAR_ROW:
            is_felt = self._beyond >= behind[kind]
            variance += square[kind] / (3.0 if is_felt else 1.0)
        forward = self._forward_of(x, P)
        covariance: FloatArray = variance * np.outer(forward, forward)
        return covariance

    def _forward_of(self, x: FloatArray, P: FloatArray) -> FloatArray:
        """(2,) unit vector: the way that a state goes; where it hardly moves, that of before."""
        speed = float(np.hypot(x[3], x[4]))
        moves = speed > MOVES * np.sqrt(max(0.0, P[3, 3] + P[4, 4]))
        return x[3:5] / speed if moves else self._forward
