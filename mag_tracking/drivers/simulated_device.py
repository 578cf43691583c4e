"""Device that simulates vehicles passing the sensors of a network in real time."""

import bisect
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.drivers.reading import Arrival, Reading
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.network.file import read_network
from mag_tracking.network.sensor_network import SensorNetwork
from mag_tracking.settings import param
from mag_tracking.simulation.scenario import Path, random_vehicle

TICK_S = 1e-6
"""[s] Resolution of the simulated device clock."""
MIN_WAIT_S = 1e-3
"""[s] Minimum waiting time, so that several readings arrive together, as from a polled port."""
MAX_BACKLOG_S = 5.0
"""[s] Maximum age of a reading. Older readings are dropped, as in the buffer of a real device."""


@dataclass(frozen=True)
class SimulatorSettings:
    """Settings of the simulated sensors and vehicles."""

    network: str = param('', 'Path of the network file that lists the sensors to simulate.')
    rate_hz: float = param(100.0, 'Sampling rate of each sensor.', 'Hz', (0.1, 10_000.0))
    noise: float = param(1.2e-8, 'Standard deviation of the measurement noise.', 'T', (0.0, 1e-3))
    speed: float = param(10.0, 'Speed of the vehicles.', 'm/s', (0.01, 100.0))
    heading_deg: float = param(
        0.0, 'Heading of the vehicles, anticlockwise from x.', 'deg', (-360.0, 360.0))
    offset: float = param(
        0.0, 'Lateral offset of the vehicles from the centre of the network, positive to the '
        'left.', 'm', (-1e4, 1e4))
    lead: float = param(
        60.0, 'Distance before the first and after the last sensor at which a pass begins and '
        'ends.', 'm', (0.0, 1e4))
    period_s: float = param(
        30.0, 'Interval between vehicles. It is extended if a pass takes longer.', 's',
        (0.1, 86400.0))
    moment: float = param(400.0, 'Magnetic moment of a vehicle.', 'A m^2', (0.0, 1e6))
    length: float = param(4.3, 'Length of a vehicle.', 'm', (0.1, 50.0))
    sequential: bool = param(
        False, 'Whether the sensors measure one after the other, evenly spread over the sampling '
        'interval, as free-running sensors do. Otherwise all measure at the same time.')
    seed: int = param(1, 'Random seed of the vehicle and of the noise.', '', (0, 2**31 - 1))


class SimulatedDevice:
    """Simulates all sensors of a network, in tesla, as a `reading.Device`."""

    SETTINGS = SimulatorSettings
    CLOCK = {'tick_s': TICK_S}

    def __init__(self, settings: SimulatorSettings,
                 monotonic_ns: Callable[[], int] = time.monotonic_ns,
                 sleep: Callable[[float], object] = time.sleep) -> None:
        if not settings.network:
            raise SettingsError('simulator: network: the path of a network.yaml is required')
        self._network = read_network(settings.network)
        if self._network.earth_field is None:
            raise SettingsError(f'{settings.network}: earth_field is missing; the simulator '
                                'requires it')
        self._earth_field: FloatArray = self._network.earth_field
        self.counts: Counter[str] = Counter()
        self._settings = settings
        self._monotonic_ns, self._sleep = monotonic_ns, sleep
        self._path, self._passing_s = _path_along(self._network, settings)
        self._rng = np.random.default_rng(settings.seed)
        self._table: FloatArray | None = None
        self._start_ns = self._next_index = 0
        self._shift_s: list[float] = (np.arange(len(self._network)) * settings.sequential
                                      / (len(self._network) * settings.rate_hz)).tolist()

    def open(self) -> None:
        """Compute the pass at the first call; at every call, skip the readings already due."""
        if self._table is None:
            self._table = self._field_of_pass()
            self._start_ns = self._monotonic_ns()
        self._next_index = math.ceil(self._elapsed() * self._settings.rate_hz) * len(self._network)

    def read(self, timeout_s: float) -> list[Arrival]:
        """Return the readings that are due; wait for the next reading if no reading is due."""
        if self._table is None:
            raise DeviceError('the simulator is not open; call open() first')
        wait = self._due(self._next_index) - self._elapsed()
        if wait > 0.0:
            # Waiting for each of a thousand readings separately would be too slow.
            self._sleep(min(max(wait, MIN_WAIT_S), timeout_s))
        elapsed, n = self._elapsed(), len(self._network)
        oldest = math.ceil((elapsed - MAX_BACKLOG_S) * self._settings.rate_hz) * n
        if oldest > self._next_index:
            self.counts['readings dropped, not read in time'] += oldest - self._next_index
            self._next_index = oldest
        first, self._next_index = self._next_index, max(self._next_index, self._n_due(elapsed))
        while self._due(self._next_index) <= elapsed:
            self._next_index += 1
        return self._readings(self._table, first, self._next_index)

    def close(self) -> None:
        """Do nothing; the simulated time continues."""

    def _elapsed(self) -> float:
        """Time since the first `open` [s]."""
        return (self._monotonic_ns() - self._start_ns) / 1e9

    def _due(self, i: int) -> float:
        """Measurement time of reading `i` [s], relative to the first `open`."""
        index, j = divmod(i, len(self._network))
        return index / self._settings.rate_hz + self._shift_s[j]

    def _n_due(self, elapsed: float) -> int:
        """Number of readings due by `elapsed` [s]; rounding may omit some of the latest period."""
        n_cycles = math.floor(elapsed * self._settings.rate_hz)
        return n_cycles * len(self._network) + bisect.bisect_right(
            self._shift_s, elapsed - n_cycles / self._settings.rate_hz)

    def _readings(self, table: FloatArray, first: int, end: int) -> list[Arrival]:
        """Arrivals of readings `first` .. `end` - 1; `table` is the result of `_field_of_pass`."""
        index, j = np.divmod(np.arange(first, end), len(self._network))
        due_s = index / self._settings.rate_hz + np.array(self._shift_s)[j]
        # The table covers one pass; its last row, without a vehicle, is used until the next pass.
        period_s = max(self._settings.period_s, self._passing_s)
        row = index % round(period_s * self._settings.rate_hz)
        B = table[np.minimum(row, len(table) - 1), j]
        B = B + self._settings.noise * self._rng.standard_normal(B.shape)
        now, names = self._monotonic_ns(), self._network.names
        return [Arrival(now, Reading(names[j], tuple(b), ticks=t, sequence=k))
                for t, k, j, b in zip(np.round(due_s / TICK_S).astype(int).tolist(),
                                      index.tolist(), j.tolist(), B.tolist(), strict=True)]

    def _field_of_pass(self) -> FloatArray:
        """Field during a pass, (n, n_sensors, 3) T, sensor frames; the last row has no vehicle."""
        s, network = self._settings, self._network
        t = np.arange(0.0, self._passing_s, 1.0 / s.rate_hz)
        body = random_vehicle(np.random.default_rng(s.seed), length=s.length, moment=s.moment)
        B = np.zeros((len(t) + 1, len(network), 3))
        for j, shift_s in enumerate(self._shift_s):
            position, heading = self._path.at(t + shift_s)
            B[:-1, j] = body.field(self._earth_field, position, heading,
                                   network.positions[j:j + 1])[:, 0]
        B_s: FloatArray = np.einsum('njw,jws->njs', B + self._earth_field, network.R_ws)
        return B_s


def _path_along(network: SensorNetwork, settings: SimulatorSettings) -> tuple[Path, float]:
    """Return (straight path past all sensors, duration of a pass [s])."""
    heading = math.radians(settings.heading_deg)
    forward = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-forward[1], forward[0]])
    along, across = network.positions[:, :2] @ forward, network.positions[:, :2] @ left
    middle = (across.min() + across.max()) / 2.0 + settings.offset
    start = (along.min() - settings.lead) * forward + middle * left
    length = along.max() - along.min() + 2.0 * settings.lead
    if length <= 0.0:
        raise SettingsError('simulator: lead: the path past the sensors has length 0; increase '
                            'lead')
    return Path(start, heading, settings.speed), length / settings.speed
