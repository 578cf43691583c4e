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

LANE = 3.0
"""Deviations by which a vehicle may be beside the outermost lane of the settings."""

LEAST_SPEED = 1.0
"""[m/s] A slower vehicle has no direction."""

LONGEST_WAY = 0.75
"""A target may move so far within a frame, in units of its distance to the second nearest sensor:
fields are averaged over the frame, with a relative error of about half of the square. One sensor
that errs more, as it is passed closely, does not mislead a track."""


def implausible(observation: Observation, x: FloatArray, kind: int, settings: VehicleSettings,
                mounting_std: float, dt: float) -> set[str]:
    """Doubts about a state of a vehicle.

    Parameters
    ----------
    observation : Observation
    x : (n_x,) array
        That of the published hypothesis.
    kind : int
    settings : VehicleSettings
    mounting_std : float [rad]
        Sensors may be turned by as much, also those that are known better: what the model leaves
        out of a field rotates it, too.
    dt : float [s]
        Length of the frame.
    """
    found = set()
    if _needs_rotated_sensors(observation, x, mounting_std):
        found.add(doubts.SENSORS_ROTATED)
    off = abs(float(x[2]) - settings.heights[kind])
    if off > -ndtri(LEVEL / 2.0) * settings.height_stds[kind]:
        found.add(doubts.HEIGHT)
    if _is_off_the_road(x[:3], x[3:6], settings, observation.positions):
        found.add(doubts.OFF_THE_ROAD)
    if moves_too_far(x[:3], x[3:6], dt, observation.positions):
        found.add(doubts.FRAMES_TOO_LONG)
    return found


def _is_off_the_road(position: FloatArray, velocity: FloatArray, settings: VehicleSettings,
                     positions: FloatArray) -> bool:
    """Whether a vehicle passes all sensors, at `positions` (n, 3), on one side, beyond the lanes.

    There its distance is hardly measured: a train on another line looks like a truck nearby. Lanes
    are on both sides of the centre of the network; past a network that covers an area a vehicle
    may be as near to the outermost sensors.
    """
    speed = float(np.hypot(velocity[0], velocity[1]))
    if speed < LEAST_SPEED:
        return False
    away = positions - position
    aside = (velocity[0] * away[:, 1] - velocity[1] * away[:, 0]) / speed
    outermost = max(map(abs, settings.lateral_offsets))
    return bool((aside > outermost).all() or (aside < -outermost).all()) \
        and abs(aside.mean()) > outermost + LANE * settings.lateral_std


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
