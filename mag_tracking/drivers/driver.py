"""Driver that keeps one device open and converts its readings to samples.

A driver opens its device and reopens it, with back-off, when the connection is lost. It assigns
network names to the sensors, converts units to SI, timestamps every reading with its time of
measurement on the host clock, and counts losses.
"""

import struct
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import BoolArray
from mag_tracking.drivers.device_clock import ArrivalClock, ClockSettings, DeviceClock
from mag_tracking.drivers.reading import Arrival, Axes, Device, DeviceDate, Reading
from mag_tracking.drivers.sensor_checks import FieldStrength, SequenceCheck, SingleSource, contest
from mag_tracking.drivers.settings import STAMPED_BY, DriverSettings, acceleration_scale
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.records import AccelerationSample, Readings
from mag_tracking.units import NS, TIME_UNITS, field_scale, unit_since_1970

POLL_S = 0.2
"""[s] Interval at which `serve` checks whether to stop."""
IGNORED = '-'
"""Network name assigned to a sensor whose readings are discarded."""
MAX_NAMES = 20
"""Maximum number of unknown sensors, and of errors of one type, that are counted individually."""
MAX_CACHED = 4096
"""Maximum number of (name, source) pairs whose sensor is cached."""
CONTEST_INTERVAL_NS = NS
"""[ns] Interval at which sensors with several sources are searched."""
_AXES_STRUCT = struct.Struct('3d')
PollResult: TypeAlias = tuple[Readings, Sequence[AccelerationSample]]
"""Fields and accelerations received by one poll."""
EMPTY_RESULT: PollResult = Readings.joined([]), ()
MIN_CLOCK_STEP_NS = 10_000_000
"""[ns] A larger change of wall clock minus monotonic clock is counted as a clock step."""


class Driver:
    """Keeps one device open and converts its readings to samples.

    Keys of `sensors` are the sensor's name at the device, the source of its readings, or '' for the
    only sensor; values are names in the network. `driver_counts` are samples by sensor, and losses
    and faults that the driver itself detects, by cause.
    """

    def __init__(self, name: str, device: Device, settings: DriverSettings,
                 clock_settings: ClockSettings, sensors: Mapping[str, str],
                 monotonic_ns: Callable[[], int] = time.monotonic_ns,
                 wall_ns: Callable[[], int] = time.time_ns,
                 sleep: Callable[[float], object] = time.sleep) -> None:
        self.name, self.sensors = name, dict(sensors)
        self.device, self.settings, self.clock_settings = device, settings, clock_settings
        self.driver_counts: Counter[str] = Counter()
        self._scale = field_scale(settings.unit)
        self._acceleration_scale = acceleration_scale(settings.acceleration_unit)
        if settings.stamp_by not in STAMPED_BY:
            raise SettingsError(f'stamp_by: expected one of {", ".join(STAMPED_BY)}, got '
                                f'{settings.stamp_by!r}')
        self._monotonic_ns, self._wall_ns, self._sleep = monotonic_ns, wall_ns, sleep
        self._sequences = {s: SequenceCheck(settings.sequence_wrap) for s in sensors.values()
                           if s != IGNORED}
        self._clocks: dict[str, ArrivalClock | DeviceClock] = {}
        self.is_open, self._failure, self._contest = False, '', ''
        self._retry_s, self._last_receipt_ns = settings.retry_s, 0
        self._retry_ns: int | None = None
        self._offset_ns: int | None = None
        # One selection for each sensor and kind of reading (with a field, or acceleration only).
        self._claims: defaultdict[tuple[str, bool], SingleSource] = defaultdict(SingleSource)
        self._contest_ns = 0
        self._unknown_names: set[str] = set()
        # (clock, ticks, arrival) of the previous reading. Readings with the same ticks and arrival
        # were measured together and have the same timestamp.
        self._measurement: tuple[ArrivalClock | DeviceClock, float | None, int] | None = None
        self._measured_ns: int | None = None
        self._strength = FieldStrength()
        self._known_sensors: dict[tuple[str, str], str] = {}
        self._sample_counts = {s: f'samples: {s}' for s in sensors.values()}

    @property
    def fault(self) -> str:
        """Latest failure, or, if data have arrived since, the sensors with several sources."""
        return self._failure or self._contest

    def clocks(self) -> dict[str, ArrivalClock | DeviceClock]:
        """Clock of each source whose readings were accepted."""
        return dict(self._clocks)

    def counts(self) -> Counter[str]:
        """Numbers of samples, losses, faults and suspect readings, such as 'samples: mag_1'."""
        # Each counter is copied in one step, because the polling thread may add a cause meanwhile.
        total = self.driver_counts.copy()
        n_changes = sum(claim.changes for claim in list(self._claims.values()))
        total.update({'source changes': n_changes} if n_changes else {})
        total.update(self.device.counts.copy())
        for sensor, check in self._sequences.items():
            total.update({f'{cause}: {sensor}': n for cause, n in check.counts.copy().items() if n})
        for clock in self.clocks().values():
            total.update(clock.counts.copy())
            total.update(clock.restarts.copy())
        return total

    def examples(self) -> dict[str, str]:
        """First rejected line or device time and the remedy, by cause in `counts`."""
        found = dict(getattr(self.device, 'examples', {}))
        for clock in self.clocks().values():
            found.update(clock.examples)
        return found

    def poll(self, timeout_s: float) -> PollResult:
        """Return the samples received since the last call; wait for data for at most `timeout_s`.

        Device errors are stored in `fault`. Raises ValueError if a field is not three numbers.
        """
        if not self.is_open and not self._try_to_open(timeout_s):
            return EMPTY_RESULT
        try:
            arrivals = self._read(timeout_s)
        except DeviceError as error:
            self.driver_counts['connections lost'] += 1
            self._schedule_retry(error)
            return EMPTY_RESULT
        now = self._monotonic_ns()
        if now - self._contest_ns >= CONTEST_INTERVAL_NS:
            self._contest_ns = now
            self._contest = '; '.join(dict.fromkeys(
                text for (sensor, _), claim in self._claims.items()
                if (text := contest(sensor, claim.selected, claim.rates_hz(now)))))
        if not arrivals:
            timeout_s = self.settings.silence_timeout_s
            if timeout_s and now - self._last_receipt_ns > timeout_s * 1e9:
                self.driver_counts['reopened after silence'] += 1
                self._schedule_retry(f'open, but no data received for {timeout_s:g} s')
            return EMPTY_RESULT
        self._last_receipt_ns, self._retry_s, self._failure = now, self.settings.retry_s, ''
        return self._samples(arrivals, self._wall_offset(now))

    def _read(self, timeout_s: float) -> list[Arrival]:
        """Read the available readings and, if there are any, those that follow within `batch_s`."""
        arrivals = self.device.read(timeout_s)
        if not arrivals or not self.settings.batch_s:
            return arrivals
        end = self._monotonic_ns() + round(self.settings.batch_s * 1e9)
        while (left_ns := end - self._monotonic_ns()) > 0:
            try:
                arrivals += self.device.read(left_ns / 1e9)
            except DeviceError:
                # Readings received so far are kept; the next read raises the error again.
                break
        return arrivals

    def close(self) -> None:
        """Close the device; the next `poll` opens it again."""
        # Readings that the device measures while it is closed are not lost.
        for check in self._sequences.values():
            check.pause()
        self.device.close()
        self.is_open, self._retry_ns = False, None

    def fail(self, error: Exception) -> None:
        """Close the device after an unexpected error and schedule its reopening."""
        self.driver_counts['errors'] += 1
        self._schedule_retry(f'{type(error).__name__}: {error}')

    def _try_to_open(self, timeout_s: float) -> bool:
        if self._retry_ns is not None:
            wait_s = (self._retry_ns - self._monotonic_ns()) / 1e9
            if wait_s > 0.0:
                self._sleep(min(timeout_s, wait_s))
                return False
        try:
            self.device.open()
        except DeviceError as error:
            self.driver_counts['failed attempts to open'] += 1
            self._schedule_retry(error)
            return False
        # The previous fault remains until data arrive.
        self.is_open, self._last_receipt_ns = True, self._monotonic_ns()
        return True

    def _schedule_retry(self, reason: object) -> None:
        """Close the device, schedule its reopening, and double the delay for the next failure."""
        self.is_open, self._failure = False, str(reason)
        try:
            self.device.close()
        # A third-party device or a removed port may raise any error; the device is reopened anyway.
        except Exception as error:
            self.driver_counts['failed attempts to close'] += 1
            self._failure += f'; closing failed as well: {type(error).__name__}: {error}'
        self._retry_ns = self._monotonic_ns() + round(self._retry_s * 1e9)
        self._retry_s = min(2.0 * self._retry_s, self.settings.max_retry_s)

    def _wall_offset(self, monotonic_ns: int) -> int:
        """Return wall clock minus monotonic clock [ns]; count steps of the wall clock."""
        offset = self._wall_ns() - monotonic_ns
        if self._offset_ns is not None and abs(offset - self._offset_ns) > MIN_CLOCK_STEP_NS:
            self.driver_counts['steps of the host clock'] += 1
        self._offset_ns = offset
        return offset

    def _samples(self, arrivals: Sequence[Arrival], offset_ns: int) -> PollResult:
        sensors: list[str] = []
        stamps: list[int] = []
        fields: list[Axes] = []
        accelerations: list[AccelerationSample] = []
        for arrival in arrivals:
            reading = arrival.reading
            sensor, stamp_ns = self._resolve(reading, arrival)
            if sensor is None or stamp_ns is None:
                continue
            if reading.field is not None:
                sensors.append(sensor)
                stamps.append(stamp_ns + offset_ns)
                fields.append(reading.field)
            if reading.acceleration is not None:
                accelerations.append(AccelerationSample(
                    stamp_ns + offset_ns, sensor,
                    self._acceleration_scale * np.array(reading.acceleration)))
        # A field that overflows is discarded; the acceleration of the same reading is kept.
        try:
            with np.errstate(over='ignore'):
                field = self._scale * np.array(fields, dtype=float).reshape(len(fields), 3)
        except OverflowError as error:
            raise ValueError('a field exceeds the range of float64') from error
        readings = Readings.by_name(sensors, stamps, field)
        infinite: BoolArray = np.any(np.isinf(readings.field), axis=1)
        if infinite.any():
            self.driver_counts['readings that overflow in tesla'] += int(infinite.sum())
            readings = readings.part(~infinite)
        for sensor in self._strength.add(readings):
            self.driver_counts[f"sensors below 10 uT, weaker than the Earth's field; check the "
                               f'unit: {sensor}'] += 1
        self.driver_counts.update([self._sample_counts[readings.names[j]]
                                   for j in readings.sensor.tolist()])
        return readings, accelerations

    def _resolve(self, reading: Reading, arrival: Arrival) -> tuple[str | None, int | None]:
        """Network name of a reading, None if unknown or ignored, and its monotonic time [ns], None
        for a duplicate or if no clock provides it."""
        key = reading.sensor, arrival.source
        sensor = self._known_sensors.get(key) or self._sensor_of(*key)
        if sensor is None:
            return None, None
        if not self._claims[sensor, reading.field is not None].accepts(key, arrival.arrival_ns):
            self._count_unknown(*key)
            return None, None
        if reading.sequence is not None and not self._sequences[sensor].is_new(
                reading.sequence, _bytes_of(reading.field) + _bytes_of(reading.acceleration)):
            return sensor, None
        return sensor, self._stamp(reading, arrival)

    def _sensor_of(self, reported_name: str, source: str) -> str | None:
        sensor = next((self.sensors[name] for name in (reported_name, source)
                       if name and name in self.sensors), self.sensors.get(''))
        if sensor is None:
            self._count_unknown(reported_name, source)
        if sensor is None or sensor == IGNORED:
            return None
        if len(self._known_sensors) >= MAX_CACHED:
            self._known_sensors.clear()
        self._known_sensors[reported_name, source] = sensor
        return sensor

    def _count_unknown(self, reported_name: str, source: str) -> None:
        """Count a reading of no sensor, or from another source than the selected one."""
        is_known = reported_name in self.sensors and reported_name
        cause = 'readings from other sources' if is_known else 'readings of unknown sensors'
        name = ((source if is_known else reported_name) or source)[:80]
        if len(self._unknown_names) < MAX_NAMES:
            self._unknown_names.add(name)
        self.driver_counts[cause + (
            f': {name}' if name in self._unknown_names else ' (and others)')] += 1

    def _stamp(self, reading: Reading, arrival: Arrival) -> int | None:
        """Return the monotonic time of the measurement [ns], or None if no clock provides it."""
        stamp_by = self.settings.stamp_by
        ticks = reading.sequence if stamp_by == 'sequence' else reading.ticks
        clock = self._clocks.get(arrival.source)
        if clock is None:
            if len(self._clocks) > len(self._claims):
                self._drop_clocks()
            uses_arrivals = stamp_by == 'arrival' or stamp_by == 'auto' and ticks is None
            clock = (ArrivalClock if uses_arrivals else DeviceClock)(
                _clock_settings_for(ticks, self.clock_settings))
            self._clocks[arrival.source] = clock
        measurement = clock, ticks, arrival.arrival_ns
        if self._measurement != measurement or self._measured_ns is None:
            # The clock counts every reading without a time, so it is called for each of them.
            self._measured_ns = clock.stamp(ticks, arrival.arrival_ns)
            self._measurement = measurement
        return self._measured_ns

    def _drop_clocks(self) -> None:
        selected = {claim.selected[1] for claim in self._claims.values() if claim.selected}
        for source in self._clocks.keys() - selected:
            clock = self._clocks.pop(source)
            self.driver_counts.update(clock.counts)
            self.driver_counts.update(clock.restarts)


def _clock_settings_for(ticks: float | None, settings: ClockSettings) -> ClockSettings:
    """Adapt clock settings to a date, or to a number that only a time since 1970 can be."""
    unit = 'us' if isinstance(ticks, DeviceDate) else None
    # A counter of microseconds has no decimals.
    if unit is None and ticks is not None and (
            0 < settings.wrap <= ticks or settings.tick_s == 1e-6 and ticks % 1.0):
        unit = unit_since_1970(ticks)
    return settings if unit is None else replace(settings, tick_s=TIME_UNITS[unit] / NS, wrap=0)


def _bytes_of(axes: Axes | None) -> bytes:
    """Pack three numbers, or None, into bytes; raises ValueError for any other value."""
    # Thousands of readings are stored as bytes. Tuples would be tracked by the garbage collector,
    # whose full collections would scan all of them.
    try:
        return b'-' if axes is None else _AXES_STRUCT.pack(*axes)
    except (struct.error, OverflowError) as error:
        raise ValueError(f'expected three numbers, got {axes}'[:100]) from error


def serve(driver: Driver, take: Callable[[Readings, Sequence[AccelerationSample]], object],
          stopping: Callable[[], bool]) -> None:
    """Poll a driver and pass its samples to `take` until `stopping()` is true; then close it.

    No error is raised, because `serve` may run in its own thread.
    """
    while not stopping():
        try:
            readings, accelerations = driver.poll(POLL_S)
        except Exception as error:
            driver.fail(error)
            continue
        try:
            if len(readings) or len(accelerations):
                take(readings, accelerations)
        except Exception as error:
            # The device is not affected and stays open.
            prefix = f'errors while processing readings: {type(error).__name__}'
            cause = f'{prefix}: {error}'[:100]
            n_causes = sum(key.startswith(prefix) for key in driver.driver_counts)
            driver.driver_counts[cause if cause in driver.driver_counts or n_causes < MAX_NAMES
                                 else f'{prefix} (and others)'] += 1
    driver.close()
