"""Plausibility of a vehicle: its approach, its states, and the rate of its readings."""

import numpy as np
from scipy.special import chdtri, ndtri

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.level_change import growth_of
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.initiation_vehicle import LATERAL_STD, VehicleSettings
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NEVER, NS

P_MOUNTING, P_HEIGHT = 0.05, 1e-3
"""Probabilities that correct mounting angles, and heights, are flagged."""
LANE_STDS, LANE_STDS_LATER = 1.645, 3.0
"""Maximum distance of a vehicle from the outermost lane, in standard deviations: at its closest
point to a sensor (exceeded by one in twenty), and later, when it may have turned off."""
MAX_ONE_SIDED_WIDTH = 2.0
"""[m] Maximum lateral extent of sensors on one side of a road: no lane fits between them."""
MIN_SPEED = 1.0
"""[m/s] Minimum speed of a vehicle at which its heading is defined."""
MAX_RELATIVE_MOVE = 0.75
"""Maximum motion within a frame, relative to the distance to the second nearest sensor, as one
sensor alone does not mislead a track; the relative error is about half its square."""
SENSED_LEVEL, GROWTH_RATIO = 2.5, 10.0
"""RMS of the whitened field of a sensed target, and range of levels in the approach test."""
MIN_LOG2_RATIO = -0.25
"""Minimum log2 ratio of the durations of both halves of the growth: in theory 0.55 for an approach
at constant speed, -0.83 for a start next to a sensor, near 0 for a sudden jump."""
FALL_FRACTION = 0.85
"""Fraction of the maximum below which the field falls after the pass of a first sensor."""
LEVEL_TIME_STD, MAX_FRAMES = 0.5, 1000
"""Uncertainty of the time of a level [frame periods], and maximum number of frames of the test."""
N_INTERVALS, MIN_INTERVALS = 8, 2
"""Number of latest intervals of a sensor, and minimum number of long ones if it is slow."""
N_PATHS = 41
"""Number of paths between the outermost lanes that are compared."""


class Plausibility:
    """Doubts about the states of a vehicle along its track."""

    def __init__(self) -> None:
        # For each origin of hypotheses: smallest distance to a sensor so far, and whether the
        # hypothesis was off the road at this point.
        self._min_distance: FloatArray = np.zeros(0)
        self._was_off_road: BoolArray = np.zeros(0, dtype=bool)

    def evaluate(self, observation: Observation, bank: FilterBank, best: int,
                 settings: VehicleSettings, mounting_std: float, dt: float) -> set[str]:
        """Update the closest approach of all hypotheses; return the doubts about hypothesis `best`,
        in a frame of duration `dt` [s], with mounting angles of at least `mounting_std` [rad]."""
        x, kind, positions = bank.x[best], settings.kinds[bank.kind[best]], observation.positions
        self._update_road_check(bank, settings, positions)
        return doubts.applying({
            doubts.SENSORS_ROTATED: _needs_rotated_sensors(observation, x, mounting_std),
            doubts.HEIGHT:
                abs(float(x[2]) - kind.height) > -ndtri(P_HEIGHT / 2.0) * kind.height_std,
            doubts.BELOW_SENSORS: x[2] < 0.0 < kind.height,
            doubts.OFF_THE_ROAD: self._was_off_road[bank.origin[best]]
            or _is_off_road(x[None], settings, positions, LANE_STDS_LATER)[0],
            doubts.FRAMES_TOO_LONG: moves_too_far(x[:3], x[3:6], dt, positions)})

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

    The distance is hardly observable: a train on another line resembles a truck nearby. In a
    network that extends beyond the road, a lane may be as far outside it as from its centre.
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
    """Explanation of the covered lanes if the sensors are in a line along the road, else None."""
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
    return np.hypot(x[:, 3], x[:, 4]) >= MIN_SPEED


def moves_too_far(position: FloatArray, velocity: FloatArray, dt: float, positions: FloatArray
                  ) -> bool:
    """Whether a target moves too far in `dt` [s]; False with only one sensor."""
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


class Approach:
    """Approach test on the first frames of a track, until the field has grown by `GROWTH_RATIO`."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._levels: list[float] = []
        self._is_open = True

    def add(self, frame: FieldFrame) -> bool:
        """Add a frame, and return whether it completes the test and the test fails."""
        if not self._is_open:
            return False
        self._times.append(frame.stamp_ns / NS)
        energy, n_axes = whitened_energy(frame.field, frame.covariance)
        # The RMS of pure noise is 1; smaller values carry no information.
        self._levels.append(float(np.sqrt(max(energy.sum() / max(n_axes.sum(), 1), 1.0))))
        self._is_open = self._levels[-1] <= GROWTH_RATIO * SENSED_LEVEL \
            and len(self._levels) < MAX_FRAMES
        if self._is_open:
            return False
        time, levels = np.array(self._times), np.array(self._levels)
        growth = growth_of(time, levels, SENSED_LEVEL, GROWTH_RATIO * SENSED_LEVEL)
        # If the field falls before it reaches the highest level, the target has passed its first
        # sensor.
        is_falling = levels < FALL_FRACTION * np.maximum.accumulate(levels)
        if growth is None or (is_falling & (levels > SENSED_LEVEL)).any():
            return False
        std = LEVEL_TIME_STD * float(np.median(np.diff(time)))
        early, late = growth.reshape(2, 2).sum(axis=1)
        return bool(np.log2((early + std) / (late + std)) < MIN_LOG2_RATIO)


def typical_speed(settings: TrackSettings) -> float:
    """Median of the initial speeds of a vehicle, m/s."""
    return float(np.median(settings.vehicle.speeds))


def required_rate(network: SensorNetwork, settings: TrackSettings) -> float:
    """Minimum rate of readings that shows the pass of a vehicle, Hz; 0 for a magnet.

    Between two readings, a vehicle at `typical_speed` must not move further than
    `MAX_RELATIVE_MOVE` times its distance d: the spectrum of its field decreases like exp(-2 pi f d
    / v). The path is that between the outermost lanes that keeps furthest from all sensors, plus
    `LATERAL_STD`.
    """
    if settings.target != 'vehicle':
        return 0.0
    vehicle = settings.vehicle
    offsets = np.linspace(min(vehicle.lateral_offsets), max(vehicle.lateral_offsets), N_PATHS)
    relative = network.positions - network.positions.mean(axis=0)
    z = network.positions[:, 2] - min(kind.height for kind in vehicle.kinds)
    distances = []
    for heading in np.deg2rad(vehicle.arrival_headings_deg):
        lateral = np.cos(heading) * relative[:, 1] - np.sin(heading) * relative[:, 0]
        nearest = np.hypot(lateral - offsets[:, None], z).min(axis=1)
        distances.append(np.hypot(nearest.max(), LATERAL_STD))
    return typical_speed(settings) / (MAX_RELATIVE_MOVE * float(np.median(distances)))


def low_rate_fault(rate: float, network: SensorNetwork, settings: TrackSettings) -> str | None:
    """Message about a rate [Hz] that is too low for tracks; None if sufficient or unknown (NaN)."""
    required = required_rate(network, settings)
    if not rate < required:
        return None
    speed = typical_speed(settings)
    return (f'{rate:.3g} Hz is too slow: a car moves {speed / rate:.3g} m between readings (at '
            f'{speed:g} m/s); at least {np.ceil(10.0 * required) / 10.0:g} Hz are needed for '
            'tracks')


class SampleRates:
    """Rates of the sensors, from the frames in which they have samples."""

    def __init__(self, network: SensorNetwork, settings: TrackSettings) -> None:
        required = required_rate(network, settings)
        self._max_interval_s = 1.0 / required if required else np.inf
        n = len(network)
        self._last_ns: IntArray = np.full(n, NEVER, dtype=np.int64)
        self._intervals_s: FloatArray = np.zeros((n, N_INTERVALS))
        self._next = np.zeros(n, dtype=np.int64)
        # Whether all stored intervals of all sensors are short; latest frame with all sensors.
        self._are_short, self._complete_ns = False, NEVER

    def add(self, frame: FieldFrame, first: int = 0) -> None:
        """Update the rates with a frame whose first sensor has the index `first` in the network."""
        is_complete = len(frame.n_samples) == len(self._last_ns) and bool(frame.n_samples.all())
        interval_ns, self._complete_ns = frame.stamp_ns - self._complete_ns, \
            frame.stamp_ns if is_complete else NEVER
        if self._are_short and is_complete and 0 < interval_ns <= self._max_interval_s * NS:
            # Another short interval of each sensor changes nothing.
            self._last_ns[:] = frame.stamp_ns
            return
        measuring = np.flatnonzero(frame.n_samples)
        rows = measuring + first
        interval_s = (frame.stamp_ns - self._last_ns[rows]) / NS / frame.n_samples[measuring]
        is_known = (self._last_ns[rows] != NEVER) & (interval_s > 0.0)
        self._last_ns[rows] = frame.stamp_ns
        rows, interval_s = rows[is_known], interval_s[is_known]
        self._intervals_s[rows, self._next[rows] % N_INTERVALS] = interval_s
        self._next[rows] += 1
        self._are_short = bool((self._next >= N_INTERVALS).all()
                               and (self._intervals_s <= self._max_interval_s).all())

    def are_slow(self) -> BoolArray:
        """Whether most of the latest intervals of each sensor are too long, (n_sensors,)."""
        n_long = np.count_nonzero(self._intervals_s > self._max_interval_s, axis=1)
        n_known = np.minimum(self._next, N_INTERVALS)
        are_slow: BoolArray = (n_long >= MIN_INTERVALS) & (2 * n_long > n_known)
        return are_slow
