"""A driver: one device, kept open, and its readings as samples.

It opens the device and opens it again, with back-off, whenever it is lost; names
the sensors, turns units into SI, stamps every reading with the time of its
measurement on this machine's clock, and counts what is missing.
"""

import struct
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import BoolArray
from mag_tracking.drivers.device_clock import ArrivalClock, ClockSettings, DeviceClock
from mag_tracking.drivers.reading import Arrival, Axes, Device, Reading
from mag_tracking.drivers.sequence import SequenceCheck
from mag_tracking.drivers.settings import (
    ACCELERATION_UNITS,
    FIELD_UNITS,
    STAMPED_BY,
    DriverSettings,
    scale_of,
)
from mag_tracking.drivers.single_source import SingleSource
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.records import AccelerationSample, Readings

POLL_S = 0.2
"""[s] A driver that is served is asked to stop so often."""
IGNORED = '-'
"""In place of a sensor's name: what comes of it is not used."""
MAX_NAMES = 20
"""Unknown sensors that are counted by name."""
MAX_SOURCES = 4096
"""Clocks that are kept."""
_AXES = struct.Struct('3d')
DoctorResult: TypeAlias = tuple[Readings, Sequence[AccelerationSample]]
"""What has come."""
NOTHING: DoctorResult = Readings.joined([]), ()
"""That has come."""
STEP_NS = 10_000_000
"""[ns] The clock of this machine was set when it differs by more from one moment to the next."""


class Driver:
    """Samples of one device.

    Parameters
    ----------
    name : str
        Of the device, for people.
    device : reading.Device
    settings : DriverSettings
    clock_settings : ClockSettings
    sensors : {str: str}
        The device's name of each sensor, or the source that it sends from: the
        network's name of it. `{'': name}`: all is of the one sensor there is.
    monotonic_ns, wall_ns, sleep : functions
        The clocks of this machine; tests have their own.
    """

    def __init__(self, name: str, device: Device, settings: DriverSettings,
                 clock_settings: ClockSettings, sensors: Mapping[str, str],
                 monotonic_ns: Callable[[], int] = time.monotonic_ns,
                 wall_ns: Callable[[], int] = time.time_ns,
                 sleep: Callable[[float], object] = time.sleep) -> None:
        self.name = name
        self.sensors = dict(sensors)
        self.own_counts: Counter[str] = Counter()
        self._device, self._settings = device, settings
        self._clock_settings = clock_settings
        self._scale = scale_of(settings.unit, FIELD_UNITS, f'{name}: unit')
        self._acceleration_scale = scale_of(
            settings.acceleration_unit, ACCELERATION_UNITS, f'{name}: acceleration_unit')
        if settings.stamp_by not in STAMPED_BY:
            raise SettingsError(f'{name}: stamp_by: expected {", ".join(STAMPED_BY)}, got '
                                f'{settings.stamp_by!r}')
        self._monotonic_ns, self._wall_ns, self._sleep = monotonic_ns, wall_ns, sleep
        self._sequences = {s: SequenceCheck(settings.sequence_wrap) for s in sensors.values()
                           if s != IGNORED}
        self._clocks: dict[str, ArrivalClock | DeviceClock] = {}
        self._open, self.trouble = False, ''
        self._retry_s, self._heard_ns = settings.retry_s, 0
        self._retry_ns: int | None = None
        self._offset_ns: int | None = None
        self._sole_source = SingleSource()
        self._unknown: set[str] = set()
        # Of the reading before: those that a device gives together were measured together.
        self._measurement: tuple[ArrivalClock | DeviceClock, float | None, int] | None = None
        self._measured_ns: int | None = None
        self._named: dict[tuple[str, str], str] = {}
        self._sample_counts = {s: f'samples: {s}' for s in sensors.values()}

    @property
    def device(self) -> Device:
        """What it keeps open."""
        return self._device

    @property
    def settings(self) -> DriverSettings:
        """As they were given."""
        return self._settings

    @property
    def clock_settings(self) -> ClockSettings:
        """Of the clock of each source."""
        return self._clock_settings

    @property
    def is_open(self) -> bool:
        """Whether the device is open."""
        return self._open

    def clocks(self) -> dict[str, ArrivalClock | DeviceClock]:
        """{source: DeviceClock or ArrivalClock} of those that something has come from."""
        return dict(self._clocks)

    def counts(self) -> Counter[str]:
        """{what: number} of all that was lost, refused or found odd, and of the samples."""
        # Copied as wholes: the thread that polls may count something new in the meantime.
        total = self.own_counts.copy()
        total.update({'sources changed': n} if (n := self._sole_source.changes) else {})
        total.update(self._device.counts.copy())
        for sensor, check in self._sequences.items():
            total.update({f'{what}: {sensor}': n for what, n in check.counts.copy().items() if n})
        for clock in self.clocks().values():
            total.update(clock.counts.copy())
            total.update(clock.restarts.copy())
        return total

    def poll(self, timeout_s: float) -> DoctorResult:
        """What has come: (`Readings`, sequence of `AccelerationSample`), empty after `timeout_s`.

        Opens the device where it is not open and it is time to try. Never raises for
        the device's sake: what is wrong stands in `trouble`.
        """
        if not self._open and not self._try_to_open(timeout_s):
            return NOTHING
        try:
            arrivals = self._read(timeout_s)
        except DeviceError as error:
            self.own_counts['connections lost'] += 1
            self._give_up(error)
            return NOTHING
        now = self._monotonic_ns()
        if not arrivals:
            timeout_s = self._settings.silence_timeout_s
            if timeout_s and now - self._heard_ns > timeout_s * 1e9:
                self.own_counts['silent, so opened again'] += 1
                self._give_up(f'open, but nothing has come for {timeout_s:g} s')
            return NOTHING
        self._heard_ns, self._retry_s, self.trouble = now, self._settings.retry_s, ''
        return self._samples(arrivals, self._wall_offset(now))

    def _read(self, timeout_s: float) -> list[Arrival]:
        """What the device has, and what comes within `batch_s` after the first of it."""
        arrivals = self._device.read(timeout_s)
        if not arrivals or not self._settings.batch_s:
            return arrivals
        end = self._monotonic_ns() + round(self._settings.batch_s * 1e9)
        while (left_ns := end - self._monotonic_ns()) > 0:
            try:
                arrivals += self._device.read(left_ns / 1e9)
            except DeviceError:
                # What has come goes on; the next read says so again.
                break
        return arrivals

    def close(self) -> None:
        """Close the device; the next `poll` opens it again.

        What the device measures until then is not lost.
        """
        for check in self._sequences.values():
            check.pause()
        self._device.close()
        self._open, self._retry_ns = False, None

    def fail(self, error: Exception) -> None:
        """Something else went wrong with the device: close it, and open it again after a while."""
        self.own_counts['errors'] += 1
        self._give_up(f'{type(error).__name__}: {error}')

    def _try_to_open(self, timeout_s: float) -> bool:
        """Open the device if it is time to; whether it is open. Waits at most `timeout_s`."""
        if self._retry_ns is not None:
            wait_s = (self._retry_ns - self._monotonic_ns()) / 1e9
            if wait_s > 0.0:
                self._sleep(min(timeout_s, wait_s))
                return False
        try:
            self._device.open()
        except DeviceError as error:
            self.own_counts['openings that failed'] += 1
            self._give_up(error)
            return False
        # What was wrong before stays said until something has come.
        self._open, self._heard_ns = True, self._monotonic_ns()
        return True

    def _give_up(self, why: object) -> None:
        """Close the device, and wait longer than the last time before it is opened again."""
        self._open, self.trouble = False, str(why)
        try:
            self._device.close()
        # Of somebody else's device, or of a port that has vanished: it is given up all the same.
        except Exception as error:
            self.own_counts['closings that failed'] += 1
            self.trouble += f' (and it does not close: {type(error).__name__}: {error})'
        self._retry_ns = self._monotonic_ns() + round(self._retry_s * 1e9)
        self._retry_s = min(2.0 * self._retry_s, self._settings.max_retry_s)

    def _wall_offset(self, monotonic_ns: int) -> int:
        """[ns] Time of day minus monotonic time; stamps follow where somebody sets the clock."""
        offset = self._wall_ns() - monotonic_ns
        if self._offset_ns is not None and abs(offset - self._offset_ns) > STEP_NS:
            self.own_counts["steps of this machine's clock"] += 1
        self._offset_ns = offset
        return offset

    def _samples(self, arrivals: Sequence[Arrival], offset_ns: int) -> DoctorResult:
        """(`Readings`, [`AccelerationSample`]) of what has come.

        A field that is infinite in tesla is none; an acceleration that came with it is one.
        Raises ValueError for other than three axes.
        """
        sensors: list[str] = []
        stamps: list[int] = []
        fields: list[Axes] = []
        accelerations: list[AccelerationSample] = []
        for arrival in arrivals:
            reading = arrival.reading
            sensor, stamp_ns = self._measured(reading, arrival)
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
        with np.errstate(over='ignore'):
            field = self._scale * np.array(fields, dtype=float).reshape(len(fields), 3)
        readings = Readings.by_name(sensors, stamps, field)
        infinite: BoolArray = np.any(np.isinf(readings.field), axis=1)
        if infinite.any():
            self.own_counts['readings that are infinite in tesla'] += int(infinite.sum())
            readings = readings.part(~infinite)
        self.own_counts.update([self._sample_counts[readings.names[j]]
                                for j in readings.sensor.tolist()])
        return readings, accelerations

    def _measured(self, reading: Reading, arrival: Arrival) -> tuple[str | None, int | None]:
        """(the network's name of the sensor, monotonic ns) of a reading; None for what is not."""
        sensor = self._named.get((reading.sensor, arrival.source)) \
            or self._sensor_of(reading.sensor, arrival.source)
        if sensor is None or reading.sequence is not None and not self._sequences[sensor].is_new(
                reading.sequence, _bytes_of(reading.field) + _bytes_of(reading.acceleration)):
            return sensor, None
        return sensor, self._stamp(reading, arrival)

    def _sensor_of(self, at_device: str, source: str) -> str | None:
        """The network's name of a sensor; None for one that nobody has named."""
        sensor = next((self.sensors[name] for name in (at_device, source)
                       if name and name in self.sensors), None)
        if sensor is None and '' in self.sensors and self._sole_source.is_this(
                (at_device, source), self._monotonic_ns()):
            return self.sensors['']
        if sensor is None:
            name = (at_device or source)[:80]
            if len(self._unknown) < MAX_NAMES:
                self._unknown.add(name)
            self.own_counts['of unknown sensors' + (
                f': {name}' if name in self._unknown else ' (and others)')] += 1
        if sensor is None or sensor == IGNORED:
            return None
        if len(self._named) < MAX_SOURCES:
            self._named[at_device, source] = sensor
        return sensor

    def _stamp(self, reading: Reading, arrival: Arrival) -> int | None:
        """Monotonic ns of the measurement; None where no clock can tell."""
        by = self._settings.stamp_by
        ticks = reading.sequence if by == 'sequence' else reading.ticks
        clock = self._clocks.get(arrival.source)
        if clock is None:
            if len(self._clocks) >= MAX_SOURCES:
                self.own_counts['of more sources than there can be'] += 1
                return None
            without = by == 'arrival' or by == 'auto' and ticks is None
            clock = (ArrivalClock if without else DeviceClock)(self._clock_settings)
            self._clocks[arrival.source] = clock
        if ticks is None and isinstance(clock, DeviceClock):
            self.own_counts['readings without the time of the device'] += 1
            return None
        measurement = clock, ticks, arrival.arrival_ns
        if self._measurement != measurement or self._measured_ns is None:
            # Each that has no time is counted.
            self._measured_ns = clock.stamp(ticks, arrival.arrival_ns)
            self._measurement = measurement
        return self._measured_ns


def _bytes_of(axes: Axes | None) -> bytes:
    """Three numbers, or None, as bytes; ValueError for anything else.

    They are kept by the thousand. As tuples they would be looked through for garbage, all of them
    at once: as many as come go, and that is what Python counts before it looks.
    """
    try:
        return b'-' if axes is None else _AXES.pack(*axes)
    except struct.error as error:
        raise ValueError(f'expected three numbers, got {axes}'[:100]) from error


def serve(driver: Driver, take: Callable[[Readings, Sequence[AccelerationSample]], object],
          stopping: Callable[[], bool]) -> None:
    """Hand what `driver` says to `take`, a function as of `poll`'s result, until `stopping()`.

    For a thread of its own, which nobody would see die: what the device raises stands in
    `driver.trouble`, what `take` raises in `driver.own_counts`.
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
            # Not the device's fault, which goes on.
            what = f'errors behind the driver: {type(error).__name__}'
            text = f'{what}: {error}'[:100]
            known = sum(key.startswith(what) for key in driver.own_counts)
            driver.own_counts[text if text in driver.own_counts or known < MAX_NAMES
                              else f'{what} (and others)'] += 1
    driver.close()
