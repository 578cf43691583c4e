"""Sensors whose rate is too low to show the passes of vehicles."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.initiation_vehicle import LATERAL_STD
from mag_tracking.stages.track.plausibility import MAX_RELATIVE_MOVE
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NEVER, NS

N_INTERVALS = 8
"""Number of latest intervals of a sensor that determine its rate. A sensor is slow if most of them
are too long, so that single lost readings do not matter."""

MIN_INTERVALS = 2
"""Minimum number of intervals that are too long for a sensor to be slow."""


N_PATHS = 41
"""Number of paths between the outermost lanes that are compared."""


def typical_speed(settings: TrackSettings) -> float:
    """Median of the initial speeds of a vehicle, m/s."""
    return float(np.median(settings.vehicle.speeds))


def required_rate(network: SensorNetwork, settings: TrackSettings) -> float:
    """Minimum rate of readings that shows the pass of a vehicle, Hz; 0 for a magnet, which may be
    at rest.

    Between two readings, a vehicle at `typical_speed` must not move further than
    `MAX_RELATIVE_MOVE` times its distance from the nearest sensor. The field of a pass at distance
    d and speed v has little content above the frequency v / (2 d), because its spectrum decreases
    like exp(-2 pi f d / v). The distance is that of the path between the outermost lanes that keeps
    furthest from all sensors, and includes `LATERAL_STD`: a lower rate is too low in every lane.
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
    """Message about a rate [Hz] that is too low for tracks; None if it suffices or is unknown
    (NaN)."""
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
