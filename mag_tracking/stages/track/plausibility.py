"""Plausibility of the state of a vehicle: mounting, height, road and speed."""

import numpy as np
from scipy.special import chdtri, ndtri

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.initiation_vehicle import LATERAL_STD, VehicleSettings
from mag_tracking.stages.track.observation import Observation

P_MOUNTING = 0.05
"""Probability that the estimated mounting angles of correctly mounted sensors are flagged."""

P_HEIGHT = 1e-3
"""Probability that the height of a vehicle is flagged, although it follows the distribution of its
kind."""

LANE_STDS, LANE_STDS_LATER = 1.645, 3.0
"""Maximum distance of a vehicle from the outermost configured lane, in standard deviations: at its
closest point to any sensor, and at later times, when it may have turned off. One in twenty vehicles
on that lane exceeds the first limit."""

MAX_ONE_SIDED_WIDTH = 2.0
"""[m] Maximum lateral extent of sensors that are assumed to stand on one side of a road, because no
lane fits between them."""

MIN_SPEED = 1.0
"""[m/s] Minimum speed of a vehicle at which its heading is defined."""

MAX_RELATIVE_MOVE = 0.75
"""Maximum motion of a target within a frame, relative to its distance to the second nearest sensor.
Fields are averaged over the frame, with a relative error of about half the square of this ratio.
The nearest sensor is ignored, because the error of a single sensor does not mislead a track."""


class Plausibility:
    """Doubts about the states of a vehicle along its track."""

    def __init__(self) -> None:
        # For each origin of hypotheses: smallest distance to a sensor so far, and whether the
        # hypothesis was off the road at this point.
        self._min_distance: FloatArray = np.zeros(0)
        self._was_off_road: BoolArray = np.zeros(0, dtype=bool)

    def evaluate(self, observation: Observation, bank: FilterBank, best: int,
                 settings: VehicleSettings, mounting_std: float, dt: float) -> set[str]:
        """Update the closest approach of all hypotheses; return the doubts about the published
        hypothesis `best`, in a frame of duration `dt` [s].

        `mounting_std` [rad] is the minimum std of the mounting angles. It also applies to
        accurately mounted sensors, because a model error also rotates the field.
        """
        x, kind = bank.x[best], int(bank.kind[best])
        self._update_road_check(bank, settings, observation.positions)
        reasons = set()
        if _needs_rotated_sensors(observation, x, mounting_std):
            reasons.add(doubts.SENSORS_ROTATED)
        height_error = abs(float(x[2]) - settings.kinds[kind].height)
        if height_error > -ndtri(P_HEIGHT / 2.0) * settings.kinds[kind].height_std:
            reasons.add(doubts.HEIGHT)
        if x[2] < 0.0 < settings.kinds[kind].height:
            reasons.add(doubts.BELOW_SENSORS)
        if self._was_off_road[bank.origin[best]] or _is_off_road(
                x[None], settings, observation.positions, LANE_STDS_LATER)[0]:
            reasons.add(doubts.OFF_THE_ROAD)
        if moves_too_far(x[:3], x[3:6], dt, observation.positions):
            reasons.add(doubts.FRAMES_TOO_LONG)
        return reasons

    def _update_road_check(self, bank: FilterBank, settings: VehicleSettings,
                           positions: FloatArray) -> None:
        """Update the smallest distance of each hypothesis to a sensor, and its off-road flag."""
        n_added = max(int(bank.origin.max()) + 1 - len(self._min_distance), 0)
        self._min_distance = np.append(self._min_distance, np.full(n_added, np.inf))
        self._was_off_road = np.append(self._was_off_road, np.zeros(n_added, dtype=bool))
        distance = np.hypot(*(positions[:, :2, None] - bank.x[:, :2].T).transpose(1, 0, 2))
        min_distance = distance.min(axis=0)
        is_nearest = (min_distance <= self._min_distance[bank.origin]) & _is_moving(bank.x)
        is_off_road = _is_off_road(bank.x[is_nearest], settings, positions, LANE_STDS)
        origins = bank.origin[is_nearest]
        self._min_distance[origins] = min_distance[is_nearest]
        self._was_off_road[origins] = is_off_road


def _is_off_road(x: FloatArray, settings: VehicleSettings, positions: FloatArray,
                 n_stds: float) -> BoolArray:
    """Whether states (n, n_x) pass all sensors (n_sensors, 3) on one side, beyond the lanes.

    The distance of such a vehicle is hardly observable: a train on another line resembles a truck
    nearby, and a truck beyond a sensor resembles a car on the near side of a sensor with an
    inverted axis.

    Lanes are on both sides of the centre of the network. A network that extends beyond the road
    covers an area. A vehicle may then be as far outside the outermost sensors as a lane is from the
    centre.
    """
    speed = np.maximum(np.hypot(x[:, 3], x[:, 4]), MIN_SPEED)
    offsets = positions[:, :2, None] - x[:, :2].T
    lateral = (x[:, 3] * offsets[:, 1] - x[:, 4] * offsets[:, 0]) / speed
    outermost = max(map(abs, settings.lateral_offsets))
    half_width = np.ptp(lateral, axis=0) / 2.0
    edge = np.maximum(outermost + n_stds * LATERAL_STD,
                      half_width + np.minimum(outermost, half_width - outermost))
    on_one_side = (lateral > 0.0).all(axis=0) | (lateral < 0.0).all(axis=0)
    is_off_road: BoolArray = on_one_side & (np.abs(lateral.mean(axis=0)) > edge) & _is_moving(x)
    return is_off_road


def lane_note(settings: VehicleSettings, network: SensorNetwork) -> str | None:
    """Explanation of which lanes are covered if the sensors stand on one side of the road.

    None for one sensor, for a compact network, and unless the sensors are in a line along most of
    the arrival directions.
    """
    headings = np.deg2rad(settings.arrival_headings_deg)
    across = np.array([-np.sin(headings), np.cos(headings)])
    is_one_sided = np.ptp(network.positions[:, :2] @ across, axis=0) < MAX_ONE_SIDED_WIDTH
    if len(network) < 2 or network.is_compact or 2 * is_one_sided.sum() <= len(headings):
        return None
    edge = max(map(abs, settings.lateral_offsets)) + LANE_STDS * LATERAL_STD
    offsets = ', '.join(f'{offset:g}' for offset in settings.lateral_offsets)
    return (f'the sensors stand in a line along the road: vehicles up to {edge:.1f} m beside the '
            'line are expected. If a lane is farther away, add its distance to '
            f'track.vehicle.lateral_offsets ({offsets}; positive to the left of the heading)')


def _is_moving(x: FloatArray) -> BoolArray:
    """Whether states (n, n_x) are fast enough to have a heading."""
    is_moving: BoolArray = np.hypot(x[:, 3], x[:, 4]) >= MIN_SPEED
    return is_moving


def moves_too_far(position: FloatArray, velocity: FloatArray, dt: float, positions: FloatArray
                  ) -> bool:
    """Whether the motion of a target within a frame of duration `dt` [s] exceeds
    `MAX_RELATIVE_MOVE`; False if there is only one sensor."""
    distances = np.sort(np.linalg.norm(position - positions, axis=1))
    displacement = float(np.hypot(velocity[0], velocity[1])) * dt
    return len(distances) > 1 and bool(displacement > MAX_RELATIVE_MOVE * distances[1])


def _needs_rotated_sensors(observation: Observation, x: FloatArray, mounting_std: float) -> bool:
    """Whether the mounting angles of a state are too large for their standard deviations."""
    angles = observation.angles(x)
    if not angles.size:
        return False
    variance = np.einsum('jii->ji', observation.own_covariance[:, :3, :3])
    squared_norm = float((angles**2 / np.maximum(variance, mounting_std**2)).sum())
    return bool(squared_norm > chdtri(angles.size, P_MOUNTING))
