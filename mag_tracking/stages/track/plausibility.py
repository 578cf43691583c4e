"""Whether the state of a vehicle is one that a vehicle on this road can have."""

import numpy as np
from scipy.special import chdtri, ndtri

from mag_tracking.arrays import FloatArray
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.initiation_vehicle import VehicleSettings
from mag_tracking.stages.track.observation import Observation

MOUNTED = 0.05
"""Probability that sensors mounted as stated are turned by as much as a track may need."""

LEVEL = 1e-3
"""Probability that the iron of a vehicle is as far from its kind's height as it may be."""

LANE, LANE_NOW = 1.645, 3.0
"""Deviations by which a vehicle may be beside the outermost lane of the settings: one vehicle in
twenty of that lane is farther beside it where it passes. Once it has passed it may turn off."""

LEAST_SPEED = 1.0
"""[m/s] A slower vehicle has no direction."""

LONGEST_WAY = 0.75
"""A target may move so far within a frame, in units of its distance to the second nearest sensor:
fields are averaged over the frame, with a relative error of about half of the square. One sensor
that errs more, as it is passed closely, does not mislead a track."""


class Plausibility:
    """Doubts about the states of a vehicle on its way past some sensors."""

    def __init__(self) -> None:
        self._nearest = np.inf
        self._passes_off_the_road = False

    def doubts(self, observation: Observation, x: FloatArray, kind: int,
               settings: VehicleSettings, mounting_std: float, dt: float) -> set[str]:
        """Doubts about the next state.

        Parameters
        ----------
        observation : Observation
        x : (n_x,) array
            The state of the published hypothesis.
        kind : int
        settings : VehicleSettings
        mounting_std : float [rad]
            Sensors may be turned by as much, also those that are known better: what the model
            leaves out of a field rotates it, too.
        dt : float [s]
            Length of the frame.
        """
        found = set()
        if _needs_rotated_sensors(observation, x, mounting_std):
            found.add(doubts.SENSORS_ROTATED)
        off = abs(float(x[2]) - settings.heights[kind])
        if off > -ndtri(LEVEL / 2.0) * settings.height_stds[kind]:
            found.add(doubts.HEIGHT)
        if self._goes_off_the_road(x[:3], x[3:6], settings, observation.positions):
            found.add(doubts.OFF_THE_ROAD)
        if moves_too_far(x[:3], x[3:6], dt, observation.positions):
            found.add(doubts.FRAMES_TOO_LONG)
        return found

    def _goes_off_the_road(self, position: FloatArray, velocity: FloatArray,
                           settings: VehicleSettings, positions: FloatArray) -> bool:
        """Whether the path is beside the road, now or where it was nearest to a sensor so far."""
        if np.hypot(velocity[0], velocity[1]) < LEAST_SPEED:
            return self._passes_off_the_road
        nearest = float(np.hypot(*(positions - position)[:, :2].T).min())
        if nearest <= self._nearest:
            self._nearest = nearest
            self._passes_off_the_road = _is_off_the_road(position, velocity, settings, positions,
                                                         LANE)
        return self._passes_off_the_road or _is_off_the_road(position, velocity, settings,
                                                             positions, LANE_NOW)


def _is_off_the_road(position: FloatArray, velocity: FloatArray, settings: VehicleSettings,
                     positions: FloatArray, deviations: float) -> bool:
    """Whether a vehicle passes all sensors, at `positions` (n, 3), on one side, beyond the lanes.

    There its distance is hardly measured: a train on another line looks like a truck nearby, and a
    truck beyond a sensor like a car before one that has an axis the wrong way round. Lanes are on
    both sides of the centre of the network. One that is wider than the road covers an area: a
    vehicle may then be as near to the outermost sensors.
    """
    speed = float(np.hypot(velocity[0], velocity[1]))
    away = positions - position
    aside = (velocity[0] * away[:, 1] - velocity[1] * away[:, 0]) / speed
    outermost = max(map(abs, settings.lateral_offsets))
    edge = outermost + deviations * settings.lateral_std
    half_width = float(np.ptp(aside)) / 2.0
    if half_width > edge:
        edge = half_width + outermost
    return bool((aside > 0.0).all() or (aside < 0.0).all()) and abs(aside.mean()) > edge


def moves_too_far(position: FloatArray, velocity: FloatArray, dt: float, positions: FloatArray
                  ) -> bool:
    """Whether a target (3,) moves too far within a frame of `dt` [s].

    `positions` (n, 3) are those of the sensors.
    """
    away = np.sort(np.linalg.norm(position - positions, axis=1))
    way = float(np.hypot(velocity[0], velocity[1])) * dt
    return len(away) > 1 and bool(way > LONGEST_WAY * away[1])


def _needs_rotated_sensors(observation: Observation, x: FloatArray, mounting_std: float) -> bool:
    """Whether the mounting angles of a state are larger than stated."""
    angles = observation.angles(x)
    if not angles.size:
        return False
    variance = np.einsum('jii->ji', observation.own_covariance[:, :3, :3])
    square = float((angles**2 / np.maximum(variance, mounting_std**2)).sum())
    return bool(square > chdtri(angles.size, MOUNTED))
