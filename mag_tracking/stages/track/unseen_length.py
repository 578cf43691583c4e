"""How far the middle of a vehicle may be from where its field seems to come from."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.arrays import FloatArray

CAR_ROW = 4.0
"""[m] A row of dipoles up to this length is that of a car, whose iron is about in its middle."""

OFF_MIDDLE = 0.2
"""The iron of a long vehicle is where its engine, axles and load are. What a row is longer than
that of a car, times this, is the deviation of the vehicle's middle from that of the row, along the
heading: the load may be at either end. No field tells it."""


class UnseenLength:
    """The part of a vehicle that no sensor has felt yet, and how it moves the middle.

    Until its rear has come near a sensor a car may be the engine of a truck: a row of dipoles
    explains either, and the evidence of the two is that of models which are both wrong.
    """

    def __init__(self, lengths: Sequence[float], length_stds: Sequence[float],
                 positions: FloatArray) -> None:
        """`lengths` and `length_stds` [m] of the kinds of vehicle, which are equally frequent, and
        the `positions` (n_sensors, 3) [m] of the sensors."""
        self._lengths, self._stds = np.array(lengths), np.array(length_stds)
        self._positions = positions

    def covariance(self, x: FloatArray, length: float, complete: bool = False) -> FloatArray:
        """(2, 2) [m^2] to be added to that of the horizontal position.

        Parameters
        ----------
        x : (n_t,)
            A state that begins with position and velocity.
        length : float [m]
            Of the row of dipoles that it says.
        complete : bool
            The whole pass is known, and with it the length.
        """
        speed = np.hypot(x[3], x[4])
        if speed <= 0.0:
            return np.zeros((2, 2))
        forward = x[3:5] / speed
        variance = (OFF_MIDDLE * max(0.0, length - CAR_ROW))**2
        if not complete:
            variance += self._of_longer_kinds(float(((x[:2] - self._positions[:, :2])
                                                     @ forward).max()), length)
        return variance * np.outer(forward, forward)

    def _of_longer_kinds(self, beyond: float, length: float) -> float:
        """[m^2] of the middle along the heading, `beyond` [m] the first sensor on its way."""
        behind = 0.5 * (self._lengths - length)
        # Once its middle would have passed a sensor, a longer vehicle has been felt.
        possible = (behind > 0.0) & (beyond < behind)
        return float((behind**2 + 0.25 * self._stds**2)[possible].sum() / len(self._lengths))
