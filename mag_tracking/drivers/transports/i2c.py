"""Magnetometer chips on an I2C bus of this machine, read in turns.

A turn begins every 1 / rate_hz, by absolute deadlines, so its errors do not add up. In it every
chip is asked once, and those that can be told when to measure do so at the same time. An arrival is
the middle of the chip's conversion as nearly as is known; the modules of `chips/` say
how nearly. The field is in tesla.

A bus that hangs keeps a `read` for as long as the bus adapter's driver waits, mostly a second; a
turn ends with the first such failure.

Sources: i2c-dev of Linux (Documentation/i2c/dev-interface.rst), and its error codes
(Documentation/i2c/fault-codes.rst).
"""

import errno
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import smbus2

from mag_tracking.drivers.chips.chip import (
    Bus,
    Chip,
    ChipClass,
    Conversion,
    Registers,
    SmBus,
    check_identity,
)
from mag_tracking.drivers.chips.circuitpython import CircuitpythonChip
from mag_tracking.drivers.chips.entry import sensors_of
from mag_tracking.drivers.chips.honeywell import Hmc5883l, Hmc5883lSettings, Hmc5983
from mag_tracking.drivers.chips.lis3mdl import Lis3mdl, Lis3mdlSettings
from mag_tracking.drivers.chips.memsic import (
    Mmc5603,
    Mmc5603Settings,
    Mmc5983ma,
    Mmc5983maSettings,
)
from mag_tracking.drivers.chips.rm3100 import Rm3100, Rm3100Settings
from mag_tracking.drivers.reading import Arrival, Reading
from mag_tracking.drivers.transports.polled import Closable
from mag_tracking.errors import DeviceError, SettingsError
from mag_tracking.settings import param

CLOSE_WAIT_S = 0.1
"""How long `close` may have to wait for a `read` in another thread, besides a turn."""
_CLASSES: tuple[ChipClass, ...] = (Mmc5983ma, Mmc5603, Hmc5883l, Hmc5983, Rm3100, Lis3mdl)
CHIPS = {cls.NAME: cls for cls in _CLASSES}
NO_ANSWER = (errno.EREMOTEIO, errno.ENXIO)


@dataclass(frozen=True)
class I2cSettings:
    """Settings of the chips on an I2C bus."""

    bus: int = param(1, 'Number N of the bus /dev/i2c-N.', '', (0, 255))
    sensors: tuple[str, ...] = param(
        ('',), 'Each sensor as name:chip:address, such as A:lis3mdl:0x1c, or '
        'A:lis3mdl:0x1c@0x70.3 behind channel 3 of a TCA9548A at 0x70. A chip is one of '
        'mmc5983ma, mmc5603, hmc5883l, hmc5983, rm3100, lis3mdl, or the module.Class of a driver '
        'for CircuitPython.')
    rate_hz: float = param(50.0, 'Turns a second; each sensor is read once in a turn.', 'Hz',
                           (0.01, 1000.0))
    max_failures: int = param(
        10, 'A chip that cannot be read so many turns in a row is lost.', '', (1, 1_000_000))
    silence_timeout_s: float = param(
        2.0, 'A chip that gives no new conversion for so long, and for three turns, is lost: after '
        'a cut of its supply it does not measure until it is set up again.', 's', (0.0, 3600.0))
    mmc5983ma: Mmc5983maSettings = Mmc5983maSettings()
    mmc5603: Mmc5603Settings = Mmc5603Settings()
    hmc5883l: Hmc5883lSettings = Hmc5883lSettings()
    hmc5983: Hmc5883lSettings = Hmc5883lSettings()
    rm3100: Rm3100Settings = Rm3100Settings()
    lis3mdl: Lis3mdlSettings = Lis3mdlSettings()


class I2cDevice(Closable):
    """The chips of one bus; see `reading.Device`. The field is in tesla.

    Parameters
    ----------
    settings : I2cSettings
    open_bus : function
        From the number of a bus to what has the methods of `smbus2.SMBus`.
    monotonic_ns, sleep : functions

    Raises SettingsError where no sensor is named, or one wrongly.
    `counts` has, each with the name of the sensor: readings that failed, turns without a new
    conversion, conversions overwritten before they were read; and turns missed.
    """

    SETTINGS = I2cSettings

    def __init__(self, settings: I2cSettings, open_bus: Callable[[int], SmBus] = smbus2.SMBus,
                 monotonic_ns: Callable[[], int] = time.monotonic_ns,
                 sleep: Callable[[float], object] = time.sleep) -> None:
        if settings.sensors == ('',):
            raise SettingsError('sensors: at least one, such as A:lis3mdl:0x1c, is needed')
        self._sensors = {s.name: s for s in sensors_of(settings.sensors, CHIPS)}
        self.counts: Counter[str] = Counter()
        self._settings, self._open_bus = settings, open_bus
        self._monotonic_ns, self._sleep = monotonic_ns, sleep
        self._period_ns = round(1e9 / settings.rate_hz)
        super().__init__()
        self._bus: Bus | None = None
        self._lost, self._due_ns = '', 0
        self._failed: Counter[str] = Counter()
        self._silent: Counter[str] = Counter()
        self._most_silent = max(3, math.ceil(settings.silence_timeout_s * settings.rate_hz))
        # To make the chips tells what is wrong with their settings.
        self._chips = self._made_on(Bus(None, monotonic_ns, sleep))

    def open(self) -> None:
        """Open the bus, find the chips and set them up; raises DeviceError."""
        with self._lock:
            self._release()
            try:
                opened = self._open_bus(self._settings.bus)
            except OSError as error:
                raise DeviceError(f'{self._name}: {_obstacle(error)}') from error
            multiplexers = {s.place.multiplexer for s in self._sensors.values()
                            if s.place.multiplexer is not None}
            self._bus = bus = Bus(opened, self._monotonic_ns, self._sleep, multiplexers)
            try:
                self._chips = self._made_on(bus)
                for name, chip in self._chips.items():
                    self._set_up(name, chip, bus)
            except DeviceError:
                self._release()
                raise
            self._due_ns = self._monotonic_ns()
            self._failed.clear()
            self._silent.clear()

    @property
    def _name(self) -> str:
        """Of the bus, for messages."""
        return f'/dev/i2c-{self._settings.bus}'

    def _made_on(self, bus: Bus) -> dict[str, Chip]:
        """{name of the sensor: its chip}; nothing is said to the chips yet."""
        chips: dict[str, Chip] = {}
        for name, sensor in self._sensors.items():
            registers = Registers(bus, sensor.place)
            if sensor.chip in CHIPS:
                chips[name] = CHIPS[sensor.chip](registers, getattr(self._settings, sensor.chip),
                                                 partial(self._count, name=name))
            else:
                chips[name] = CircuitpythonChip(registers, sensor.chip, sensor.place.address)
        return chips

    def _count(self, cause: str, name: str) -> None:
        """Count what is lost of a sensor."""
        self.counts[f'{cause}: {name}'] += 1

    def _set_up(self, name: str, chip: Chip, bus: Bus) -> None:
        """Make sure it is the right chip, and set it up; raises DeviceError."""
        sensor = self._sensors[name]
        where = f'{self._name}: {name} ({sensor.chip}, {sensor.place})'
        registers = Registers(bus, sensor.place)
        try:
            check_identity(chip, registers)
            chip.set_up()
        except DeviceError as error:
            known = [] if sensor.chip not in CHIPS else self._answers_as(registers)
            hint = f'; it answers as {known[0]}' if known else ''
            raise DeviceError(f'{where}: {error}{hint}') from error
        except OSError as error:
            raise DeviceError(f'{where}: {self._fault(error)}') from error

    def _answers_as(self, registers: Registers) -> list[str]:
        """Names of the chips whose identity a place has."""
        found = []
        for name, cls in CHIPS.items():
            try:
                check_identity(cls, registers)
            except (DeviceError, OSError):
                continue
            found.append(name)
        return found

    def _fault(self, error: OSError) -> str:
        """What an error of the bus means, and what to do."""
        if error.errno in NO_ANSWER:
            return ('nothing answers; check its wiring, supply and address with i2cdetect -y '
                    f'{self._settings.bus}')
        if isinstance(error, TimeoutError):
            return 'the bus hangs; a chip or a wire holds a line low'
        if error.errno == errno.EBUSY:
            return 'a driver of the kernel has taken the address; unload it'
        return f'cannot be read: {error.strerror or error}'

    def read(self, timeout_s: float) -> list[Arrival]:
        """What the next turn gives, as soon as a turn gives something.

        Returns [] where no turn in time does, or where `close` is called meanwhile.
        Raises DeviceError where it is not open, or a chip is lost.
        """
        with self._lock:
            end_ns = self._monotonic_ns() + round(timeout_s * 1e9)
            while True:
                if self._bus is None:
                    raise DeviceError(f'{self._name}: is not open')
                if self._lost:
                    raise DeviceError(self._lost)
                if not self._wait(end_ns):
                    return []
                arrivals = self._turn(self._bus)
                # A turn may take longer than there is time.
                if arrivals or self._monotonic_ns() >= end_ns:
                    return sorted(arrivals, key=lambda a: a.arrival_ns)

    def _wait(self, end_ns: int) -> bool:
        """Whether the next turn is due before `end_ns`; waits for the one or the other."""
        while not self._closing:
            now_ns = self._monotonic_ns()
            late = (now_ns - self._due_ns) // self._period_ns
            if late > 0:
                self.counts['turns missed'] += late
                self._due_ns += late * self._period_ns
            if now_ns >= self._due_ns:
                self._due_ns += self._period_ns
                return True
            if now_ns >= end_ns:
                break
            until_ns = min(self._due_ns, end_ns)
            self._sleep(min((until_ns - now_ns) * 1e-9, CLOSE_WAIT_S))
        return False

    def _turn(self, bus: Bus) -> list[Arrival]:
        """Let every chip measure once, all at the same time; a list of `Arrival`."""
        arrivals: list[Arrival] = []
        running = {name: chip.measure() for name, chip in self._chips.items()}
        wake_ns = dict.fromkeys(running, self._monotonic_ns())
        while wake_ns:
            name = min(wake_ns, key=wake_ns.__getitem__)
            wait_ns = wake_ns[name] - self._monotonic_ns()
            if wait_ns > 0:
                self._sleep(wait_ns * 1e-9)
            try:
                wait_s = next(running[name])
                wake_ns[name] = self._monotonic_ns() + math.ceil(wait_s * 1e9)
                continue
            except StopIteration as done:
                arrivals += self._arrivals(name, done.value)
            except TimeoutError as error:
                # Each further try would wait as long.
                for other in wake_ns:
                    self._fail(bus, other, error)
                return arrivals
            except OSError as error:
                self._fail(bus, name, error)
            del wake_ns[name]
        return arrivals

    def _arrivals(self, name: str, conversion: Conversion | None) -> list[Arrival]:
        """A list of one `Arrival`, or of none."""
        self._failed[name] = 0
        if conversion is None:
            self._count('turns without a new conversion', name)
            self._silent[name] += 1
            if self._silent[name] >= self._most_silent:
                self._lost = (f'{self._name}: {name} has given no new conversion in '
                              f'{self._silent[name]} turns; perhaps its supply was cut')
            return []
        self._silent[name] = 0
        return [Arrival(conversion.middle_ns, Reading(name, conversion.field))]

    def _fail(self, bus: Bus, name: str, error: OSError) -> None:
        """Count a failure; too many in a row and the device is lost."""
        bus.forget()
        self._count('readings that failed', name)
        self._failed[name] += 1
        if self._failed[name] >= self._settings.max_failures:
            self._lost = (f'{self._name}: {name} failed {self._failed[name]} times in a row: '
                          f'{self._fault(error)}')

    def _release(self) -> None:
        """Let go of the bus, if it is held."""
        self._lost = ''
        if self._bus is not None:
            self._bus.smbus.close()
            self._bus = None


def _obstacle(error: OSError) -> str:
    """Why a bus cannot be opened, and what to do."""
    if error.errno == errno.ENOENT:
        return ('is not there; enable I2C (on a Raspberry Pi: raspi-config), load the module with '
                'sudo modprobe i2c-dev, and see i2cdetect -l')
    if error.errno in (errno.EACCES, errno.EPERM):
        return ('no permission; buses belong to the group i2c: sudo usermod -aG i2c $USER, and '
                'log in again')
    return f'cannot be opened: {error.strerror or error}'
