"""Whether the state of a vehicle is one that a vehicle on this road can have."""

import numpy as np
from scipy.special import chdtri, ndtri

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.initiation_vehicle import VehicleSettings
from mag_tracking.stages.track.observation import Observation

MOUNTED = 0.05
"""Probability that sensors mounted as stated are turned by as much as a track may need."""

LEVEL = 1e-3
"""Probability that the iron of a vehicle is as far from its kind's height as it may be."""

LANE, LANE_LATER = 1.645, 3.0
"""Deviations by which a vehicle may be beside the outermost lane of the settings: where it is
nearest to a sensor so far (one in twenty of that lane is farther beside it), and at any later time,
when it may have turned off."""

MIN_SPEED = 1.0
"""[m/s] A slower vehicle has no direction."""

MAX_DISTANCE = 0.75
"""A target may move so far within a frame, in units of its distance to the second nearest sensor:
fields are averaged over the frame, with a relative error of about half of the square. One sensor
that errs more, as it is passed closely, does not mislead a track."""


class Plausibility:
    """Doubts about the states of a vehicle on its way past the sensors."""

    def __init__(self) -> None:
        # Each hypothesis, by its origin, has been so near to a sensor, and its path was or was not
        # beside the road there.
        self._nearest: FloatArray = np.zeros(0)
        self._was_beside: BoolArray = np.zeros(0, dtype=bool)

    def judge(self, observation: Observation, bank: FilterBank, best: int,
              settings: VehicleSettings, mounting_std: float, dt: float) -> set[str]:
        """Doubts about the state of hypothesis `best`; to be asked once a frame, in order.

        Parameters
        ----------
        observation : Observation
        bank : FilterBank
        best : int
            Row of the hypothesis that is published.
        settings : VehicleSettings
        mounting_std : float [rad]
            Standard deviation of the angles by which any sensor may be turned, also one that is
            known better: what the model leaves out of a field rotates it, too.
        dt : float [s]
            Length of the frame.
        """
        x, kind = bank.x[best], int(bank.kind[best])
        self._look(bank, settings, observation.positions)
        found = set()
        if _needs_rotated_sensors(observation, x, mounting_std):
            found.add(doubts.SENSORS_ROTATED)
        off = abs(float(x[2]) - settings.heights[kind])
        if off > -ndtri(LEVEL / 2.0) * settings.height_stds[kind]:
            found.add(doubts.HEIGHT)
        if self._was_beside[bank.origin[best]] or _passes_beside(
                x[None], settings, observation.positions, LANE_LATER)[0]:
            found.add(doubts.OFF_THE_ROAD)
        if moves_too_far(x[:3], x[3:6], dt, observation.positions):
            found.add(doubts.FRAMES_TOO_LONG)
        return found

    def _look(self, bank: FilterBank, settings: VehicleSettings, positions: FloatArray) -> None:
        """Remember how near to a sensor each hypothesis has been, and if it was off the road."""
        more = max(int(bank.origin.max()) + 1 - len(self._nearest), 0)
        self._nearest = np.append(self._nearest, np.full(more, np.inf))
        self._was_beside = np.append(self._was_beside, np.zeros(more, dtype=bool))
        distance = np.hypot(*(positions[:, :2, None] - bank.x[:, :2].T).transpose(1, 0, 2))
        nearest = distance.min(axis=0)
        is_nearest = (nearest <= self._nearest[bank.origin]) & _moves(bank.x)
        beside = _passes_beside(bank.x[is_nearest], settings, positions, LANE)
        of_those = bank.origin[is_nearest]
        self._nearest[of_those], self._was_beside[of_those] = nearest[is_nearest], beside


def _passes_beside(x: FloatArray, settings: VehicleSettings, positions: FloatArray,
                   deviations: float) -> BoolArray:
    """Which of the states `x` (n, n_x) pass all sensors on one side, beyond the lanes.

    There the distance is hardly measured: a train on another line looks like a truck nearby, and a
    truck beyond a sensor like a car before one that has an axis the wrong way round. Lanes are on
    both sides of the centre of the network. The wider a network is than the road, the more it
    covers an area, and a vehicle may be as near to its outermost sensors as a lane to the centre.
    The sensors are at `positions` (n_sensors, 3).
    """
    speed = np.maximum(np.hypot(x[:, 3], x[:, 4]), MIN_SPEED)
    away = positions[:, :2, None] - x[:, :2].T
    aside = (x[:, 3] * away[:, 1] - x[:, 4] * away[:, 0]) / speed
    outermost = max(map(abs, settings.lateral_offsets))
    half_width = np.ptp(aside, axis=0) / 2.0
    edge = np.maximum(outermost + deviations * settings.lateral_std,
                      half_width + np.minimum(outermost, half_width - outermost))
    on_one_side = (aside > 0.0).all(axis=0) | (aside < 0.0).all(axis=0)
    beside: BoolArray = on_one_side & (np.abs(aside.mean(axis=0)) > edge) & _moves(x)
    return beside


def _moves(x: FloatArray) -> BoolArray:
    """Which of the states `x` (n, n_x) are fast enough to have a direction."""
    moves: BoolArray = np.hypot(x[:, 3], x[:, 4]) >= MIN_SPEED
    return moves


def moves_too_far(position: FloatArray, velocity: FloatArray, dt: float, positions: FloatArray
                  ) -> bool:
    """Whether a target (3,) moves too far within a frame of `dt` [s].

    `positions` (n, 3) are those of the sensors.
    """
    away = np.sort(np.linalg.norm(position - positions, axis=1))
    way = float(np.hypot(velocity[0], velocity[1])) * dt
    return len(away) > 1 and bool(way > MAX_DISTANCE * away[1])


def _needs_rotated_sensors(observation: Observation, x: FloatArray, mounting_std: float) -> bool:
    """Whether the mounting angles of a state are larger than stated."""
    angles = observation.angles(x)
    if not angles.size:
        return False
    variance = np.einsum('jii->ji', observation.own_covariance[:, :3, :3])
    square = float((angles**2 / np.maximum(variance, mounting_std**2)).sum())
    return bool(square > chdtri(angles.size, MOUNTED))
