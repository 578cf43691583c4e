"""Magnetometer chips on an I2C bus of this machine, polled cyclically.

Polling cycles begin at multiples of 1 / rate_hz after opening, so timing errors do not accumulate.
Every chip is read once per cycle, and chips that measure on request measure at the same time. The
arrival time of a reading is the estimated middle of the chip's conversion; the modules of `chips/`
give the accuracy. The field is in tesla.

If the bus hangs, `read` blocks for the timeout of the bus adapter's driver, usually one second. A
cycle is aborted at the first such failure.

Sources: i2c-dev of Linux (Documentation/i2c/dev-interface.rst) and its error codes
(Documentation/i2c/fault-codes.rst).
"""

import errno
import math
import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from smbus2 import SMBus

from mag_tracking.drivers.chips.chip import Bus, Chip, ChipLocation, Conversion, Registers
from mag_tracking.drivers.chips.circuitpython import UNITS, CircuitpythonChip
from mag_tracking.drivers.chips.continuous import Lis3mdl, Lis3mdlSettings, Rm3100, Rm3100Settings
from mag_tracking.drivers.chips.honeywell import Hmc5883l, Hmc5883lSettings, Hmc5983
from mag_tracking.drivers.chips.memsic import Mmc5603, Mmc5603Settings, Mmc5983ma, Mmc5983maSettings
from mag_tracking.drivers.reading import Arrival, Reading
from mag_tracking.drivers.transports.polled import CLOSE_WAIT_S, Closable
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.settings import param
from mag_tracking.units import field_scale

_CLASSES: tuple[type[Chip], ...] = (Mmc5983ma, Mmc5603, Hmc5883l, Hmc5983, Rm3100, Lis3mdl)
CHIPS = {cls.NAME: cls for cls in _CLASSES}
NO_ANSWER_ERRNOS = (errno.EREMOTEIO, errno.ENXIO)
ENTRY = re.compile(r'(?P<name>[^:]+):(?P<chip>[^:]+):0x(?P<address>[0-9a-fA-F]{2})'
                   r'(@0x(?P<multiplexer>[0-9a-fA-F]{2})\.(?P<channel>[0-7]))?(:(?P<unit>[^:]+))?')


class Sensor(NamedTuple):
    """Name, chip and location of a sensor on a bus."""

    name: str
    chip: str
    location: ChipLocation
    scale: float = 1.0
    """[T] Unit of the driver of the chip."""


def _parse_sensors(entries: Sequence[str]) -> list[Sensor]:
    sensors = [_parse_sensor(entry) for entry in entries]
    multiplexers = {s.location.multiplexer for s in sensors} - {None}
    for i, sensor in enumerate(sensors):
        if sensor.location.address in multiplexers:
            raise SettingsError(f'sensors: {sensor.name}: address {sensor.location.address:#04x} '
                                'is used by a multiplexer')
        for other in sensors[:i]:
            if other.name == sensor.name:
                raise SettingsError(f'sensors: {sensor.name} appears twice')
            # A chip directly on the bus always answers.
            if sensor.location == other.location or (
                    sensor.location.address == other.location.address
                    and None in (sensor.location.multiplexer, other.location.multiplexer)):
                raise SettingsError(f'sensors: {other.name} and {sensor.name} both answer at '
                                    f'{sensor.location}')
    return sensors


def _parse_sensor(entry: str) -> Sensor:
    match = ENTRY.fullmatch(entry)
    if match is None:
        raise SettingsError('sensors: expected name:chip:0xNN or name:chip:0xNN@0xNN.channel, '
                            f'followed by :unit for a CircuitPython driver, got {entry!r}')
    name, chip = match['name'], match['chip']
    if chip not in CHIPS and '.' not in chip:
        raise SettingsError(f'sensors: {name}: chip {chip} is neither one of '
                            f'{", ".join(CHIPS)} nor a module.Class')
    address = _parse_address(name, 'address', match['address'], 0x08)
    location = ChipLocation(address)
    if match['multiplexer'] is not None:
        location = ChipLocation(address, _parse_address(
            name, 'multiplexer', match['multiplexer'], 0x70), int(match['channel']))
    if chip in CHIPS:
        if match['unit'] is not None:
            raise SettingsError(f'sensors: {name}: the unit of {chip} is known; remove '
                                f':{match["unit"]}')
        return Sensor(name, chip, location)
    unit = match['unit'] or UNITS.get(chip)
    if unit is None:
        raise SettingsError(f'sensors: {name}: the unit of {chip} is not known; add it to the '
                            f'entry, as in {entry}:uT')
    return Sensor(name, chip, location, field_scale(unit, f'sensors: {name}: unit'))


def _parse_address(name: str, role: str, digits: str, lowest: int) -> int:
    address = int(digits, 16)
    if not lowest <= address <= 0x77:
        raise SettingsError(f'sensors: {name}: {role} {address:#04x} is outside '
                            f'{lowest:#04x} .. 0x77')
    return address


@dataclass(frozen=True)
class I2cSettings:
    """Settings of the chips on an I2C bus."""

    bus: int = param(1, 'Number N of the bus /dev/i2c-N.', '', (0, 255))
    sensors: tuple[str, ...] = param(
        ('',), 'Sensors as name:chip:address, such as A:lis3mdl:0x1c, or A:lis3mdl:0x1c@0x70.3 on '
        'channel 3 of a TCA9548A at 0x70. Chips: mmc5983ma, mmc5603, hmc5883l, hmc5983, rm3100, '
        'lis3mdl, or the module.Class of a CircuitPython driver. If the guide does not list the '
        'class, its unit follows, as in A:my_driver.Sensor:0x1c:uT.')
    rate_hz: float = param(
        50.0, 'Polling rate. Each sensor is read once per polling cycle.', 'Hz', (0.01, 1000.0))
    max_failures: int = param(
        10, 'Number of consecutive polling cycles with a failed reading of the same chip after '
        'which the device is reopened.', '', (1, 1_000_000))
    silence_timeout_s: float = param(
        2.0, 'Interval without a new conversion of a chip, at least three polling cycles, after '
        'which the device is reopened. A chip whose supply was interrupted does not measure until '
        'it is configured again.', 's', (0.0, 3600.0))
    mmc5983ma: Mmc5983maSettings = Mmc5983maSettings()
    mmc5603: Mmc5603Settings = Mmc5603Settings()
    hmc5883l: Hmc5883lSettings = Hmc5883lSettings()
    hmc5983: Hmc5883lSettings = Hmc5883lSettings()
    rm3100: Rm3100Settings = Rm3100Settings()
    lis3mdl: Lis3mdlSettings = Lis3mdlSettings()


class I2cDevice(Closable):
    """Chips on one I2C bus, read in tesla, a `reading.Device`."""

    SETTINGS = I2cSettings

    def __init__(self, settings: I2cSettings, open_bus: Callable[[int], SMBus] = SMBus,
                 monotonic_ns: Callable[[], int] = time.monotonic_ns,
                 sleep: Callable[[float], object] = time.sleep) -> None:
        if settings.sensors == ('',):
            raise SettingsError('sensors: at least one is required, such as A:lis3mdl:0x1c')
        self._sensors = {s.name: s for s in _parse_sensors(settings.sensors)}
        self.counts: Counter[str] = Counter()
        self._settings, self._open_bus = settings, open_bus
        self._name = f'/dev/i2c-{settings.bus}'
        self._monotonic_ns, self._sleep = monotonic_ns, sleep
        self._period_ns = round(1e9 / settings.rate_hz)
        super().__init__()
        self._bus: Bus | None = None
        self._loss, self._due_ns = '', 0
        self._n_failed: Counter[str] = Counter()
        self._n_silent: Counter[str] = Counter()
        self._max_silent = max(3, math.ceil(settings.silence_timeout_s * settings.rate_hz))
        # Creating the chips checks their settings.
        self._chips = self._create_chips(Bus(None, monotonic_ns, sleep))

    def open(self) -> None:
        """Open the bus, identify the chips and configure them."""
        with self._lock:
            self._release()
            try:
                opened = self._open_bus(self._settings.bus)
            except OSError as error:
                raise DeviceError(f'{self._name}: {_open_error(error)}') from error
            multiplexers = {s.location.multiplexer for s in self._sensors.values()
                            if s.location.multiplexer is not None}
            self._bus = bus = Bus(opened, self._monotonic_ns, self._sleep, multiplexers)
            try:
                self._chips = self._create_chips(bus)
                for name, chip in self._chips.items():
                    self._set_up(name, chip, bus)
            except DeviceError:
                self._release()
                raise
            self._due_ns = self._monotonic_ns()
            self._n_failed.clear()
            self._n_silent.clear()

    def _create_chips(self, bus: Bus) -> dict[str, Chip]:
        chips: dict[str, Chip] = {}
        for name, sensor in self._sensors.items():
            registers = Registers(bus, sensor.location)
            if sensor.chip in CHIPS:
                chips[name] = CHIPS[sensor.chip](registers, getattr(self._settings, sensor.chip),
                                                 partial(self._count, name=name))
            else:
                chips[name] = CircuitpythonChip(registers, sensor.chip, sensor.location.address,
                                                sensor.scale)
        return chips

    def _count(self, cause: str, name: str) -> None:
        self.counts[f'{cause}: {name}'] += 1

    def _set_up(self, name: str, chip: Chip, bus: Bus) -> None:
        sensor = self._sensors[name]
        label = f'{self._name}: {name} ({sensor.chip}, {sensor.location})'
        registers = Registers(bus, sensor.location)
        try:
            chip.check_identity(registers)
            chip.set_up()
        except DeviceError as error:
            hint = _identity_hint(registers) if sensor.chip in CHIPS else ''
            raise DeviceError(f'{label}: {error}{hint}') from error
        except OSError as error:
            raise DeviceError(f'{label}: {self._fault(error)}') from error

    def _fault(self, error: OSError) -> str:
        if error.errno in NO_ANSWER_ERRNOS:
            return ('no answer; check wiring, power supply, and the address with i2cdetect -y '
                    f'{self._settings.bus}')
        if isinstance(error, TimeoutError):
            return 'the bus hangs; check for a chip or wire that holds a line low'
        if error.errno == errno.EBUSY:
            return 'the address is in use by a kernel driver; unload it'
        return f'cannot be read: {error.strerror or error}'

    def read(self, timeout_s: float) -> list[Arrival]:
        """Readings of the next polling cycle with at least one reading; none after `close`."""
        with self._lock:
            end_ns = self._monotonic_ns() + round(timeout_s * 1e9)
            while True:
                if self._bus is None:
                    raise DeviceError(f'{self._name}: not open')
                if self._loss:
                    raise DeviceError(self._loss)
                if not self._wait(end_ns):
                    return []
                arrivals = self._run_cycle(self._bus)
                # A cycle may last longer than the timeout.
                if arrivals or self._monotonic_ns() >= end_ns:
                    return sorted(arrivals, key=lambda a: a.arrival_ns)

    def _wait(self, end_ns: int) -> bool:
        """Wait for the next polling cycle, at most until `end_ns`; return whether it is due."""
        while not self._closing:
            now_ns = self._monotonic_ns()
            n_missed = (now_ns - self._due_ns) // self._period_ns
            if n_missed > 0:
                self.counts['polling cycles missed'] += n_missed
                self._due_ns += n_missed * self._period_ns
            if now_ns >= self._due_ns:
                self._due_ns += self._period_ns
                return True
            if now_ns >= end_ns:
                break
            until_ns = min(self._due_ns, end_ns)
            self._sleep(min((until_ns - now_ns) * 1e-9, CLOSE_WAIT_S))
        return False

    def _run_cycle(self, bus: Bus) -> list[Arrival]:
        """Measure once with all chips concurrently; return the arrivals."""
        arrivals: list[Arrival] = []
        measurements = {name: chip.measure() for name, chip in self._chips.items()}
        wake_ns = dict.fromkeys(measurements, self._monotonic_ns())
        while wake_ns:
            name = min(wake_ns, key=wake_ns.__getitem__)
            wait_ns = wake_ns[name] - self._monotonic_ns()
            if wait_ns > 0:
                self._sleep(wait_ns * 1e-9)
            try:
                wait_s = next(measurements[name])
                wake_ns[name] = self._monotonic_ns() + math.ceil(wait_s * 1e9)
                continue
            except StopIteration as stop:
                arrivals += self._arrivals(name, stop.value)
            except TimeoutError as error:
                # Every further attempt would block for the same time.
                for other in wake_ns:
                    self._fail(bus, other, error)
                return arrivals
            except OSError as error:
                self._fail(bus, name, error)
            del wake_ns[name]
        return arrivals

    def _arrivals(self, name: str, conversion: Conversion | None) -> list[Arrival]:
        """List with the arrival of a conversion; too many missing ones mark the device as lost."""
        self._n_failed[name] = 0
        if conversion is None:
            self._count('polling cycles without a new conversion', name)
            self._n_silent[name] += 1
            if self._n_silent[name] >= self._max_silent:
                self._loss = (f'{self._name}: {name}: no new conversion in {self._n_silent[name]} '
                              'polling cycles; check its power supply')
            return []
        self._n_silent[name] = 0
        return [Arrival(conversion.middle_ns, Reading(name, conversion.field))]

    def _fail(self, bus: Bus, name: str, error: OSError) -> None:
        """Count a failure; mark the device as lost after `max_failures` consecutive failures."""
        bus.invalidate_selection()
        self._count('failed readings', name)
        self._n_failed[name] += 1
        n = self._n_failed[name]
        if n >= self._settings.max_failures:
            cycles = '1 polling cycle' if n == 1 else f'{n} consecutive polling cycles'
            self._loss = f'{self._name}: {name} failed in {cycles}: {self._fault(error)}'

    def _release(self) -> None:
        self._loss = ''
        if self._bus is not None:
            self._bus.smbus.close()
            self._bus = None


def _identity_hint(registers: Registers) -> str:
    for name, chip in CHIPS.items():
        try:
            chip.check_identity(registers)
        except (DeviceError, OSError):
            continue
        return f'; it is identified as {name}'
    return ''


def _open_error(error: OSError) -> str:
    if error.errno == errno.ENOENT:
        return ('not found; enable I2C (on a Raspberry Pi: raspi-config), load the module with '
                'sudo modprobe i2c-dev, and list the buses with i2cdetect -l')
    if error.errno in (errno.EACCES, errno.EPERM):
        return ('no permission; add your user to the group i2c (sudo usermod -aG i2c $USER) and '
                'log in again')
    return f'cannot be opened: {error.strerror or error}'
