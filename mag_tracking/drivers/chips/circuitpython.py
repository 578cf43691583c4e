"""Drivers written for CircuitPython, of which there is one for nearly every magnetometer.

A chip `adafruit_lis3mdl.LIS3MDL` is that class of that module, which has to be
installed (`pip install adafruit-circuitpython-lis3mdl`). It is made with a bus and an
address and its own defaults, and its property `magnetic` is read.

It is not so good as a chip of `chips/`: the property does not tell an old conversion
from a new one, some drivers wait inside of it, NaN for an axis over its range is not
known, and the axes and the scale are the driver's (that of the MMC5603, 1.0.16, is 2.4 %
above its data sheet's 16384 counts per gauss). The reading's time is the middle of the call, so
a chip that measures by itself is late by half to one and a half of its periods.

Source: the CircuitPython API reference, `busio.I2C`, and "CircuitPython design guide,
sensor properties and units": `magnetic` is in microtesla.
"""

import errno
import importlib
from typing import Any

from smbus2 import i2c_msg

from mag_tracking.drivers.chips.chip import Conversion, Measurement, Registers
from mag_tracking.errors import DeviceError

MAX_NS = 250_000_000
"""A driver that goes on asking its chip for longer is stopped."""


class BusioI2c:
    """What such a driver needs of `busio.I2C`.

    Once `until_ns` has passed every transaction raises OSError: drivers wait for their
    chip in loops without an end.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._locked = False
        self._until_ns = 0

    def begin(self, longest_ns: int) -> None:
        """Unlocked, and good for so long."""
        self._locked = False
        self._until_ns = self._registers.monotonic_ns() + longest_ns

    def try_lock(self) -> bool:
        """Whether it was free, and is locked now."""
        self._check_time()
        free, self._locked = not self._locked, True
        return free

    def unlock(self) -> None:
        """Free it."""
        self._locked = False

    def writeto(self, address: int, buffer: bytes | bytearray, *, start: int = 0,
                end: int | None = None) -> None:
        """Write `buffer[start:end]`; nothing to write asks whether the chip is there."""
        data = bytes(buffer[start:end])
        # Many adapters refuse a message without bytes.
        self._transfer(i2c_msg.write(address, data) if data else i2c_msg.read(address, 1))

    def readfrom_into(self, address: int, buffer: bytearray, *, start: int = 0,
                      end: int | None = None) -> None:
        """Read as many bytes as `buffer[start:end]` has, into it."""
        message = i2c_msg.read(address, len(buffer[start:end]))
        self._transfer(message)
        buffer[start:end] = bytes(message)

    def writeto_then_readfrom(self, address: int, out_buffer: bytes | bytearray,
                              in_buffer: bytearray, *, out_start: int = 0,
                              out_end: int | None = None, in_start: int = 0,
                              in_end: int | None = None) -> None:
        """Both, as one transaction."""
        message = i2c_msg.read(address, len(in_buffer[in_start:in_end]))
        self._transfer(i2c_msg.write(address, bytes(out_buffer[out_start:out_end])), message)
        in_buffer[in_start:in_end] = bytes(message)

    def _transfer(self, *messages: i2c_msg) -> None:
        """One transaction, while there is time."""
        self._check_time()
        self._registers.transfer(*messages)

    def _check_time(self) -> None:
        """Raises OSError where the driver has taken too long."""
        if self._registers.monotonic_ns() > self._until_ns:
            raise OSError(errno.EIO, 'the driver waited too long for its chip')


class CircuitpythonChip:
    """See `Chip`.

    Parameters
    ----------
    registers : Registers
    name : str
        `module.Class`.
    address : int
    """

    IDENTITY = ()

    def __init__(self, registers: Registers, name: str, address: int) -> None:
        self._registers, self._name, self._address = registers, name, address
        self._i2c = BusioI2c(registers)
        # Of somebody else's class.
        self._driver: Any = None

    def set_up(self) -> None:
        """See `Chip`; loads the module."""
        cls = load(self._name)
        self._i2c.begin(10 * MAX_NS)
        try:
            self._driver = cls(self._i2c, self._address)
        except (RuntimeError, ValueError) as error:
            raise DeviceError(f'{self._name}: {error}') from error

    def measure(self) -> Measurement:
        """See `Chip`."""
        yield from ()
        self._i2c.begin(MAX_NS)
        start_ns = self._registers.monotonic_ns()
        try:
            x, y, z = self._driver.magnetic
        except (RuntimeError, ValueError, TypeError) as error:
            raise OSError(errno.EIO, f'{self._name}: {error}') from error
        middle_ns = (start_ns + self._registers.monotonic_ns()) // 2
        return Conversion(middle_ns, (x * 1e-6, y * 1e-6, z * 1e-6))


def load(name: str) -> Any:
    """The class `module.Class`; raises DeviceError that says what to install."""
    module_name, _, class_name = name.rpartition('.')
    try:
        module = importlib.import_module(module_name)
    # Blinka, which such drivers import, knows only some boards and says so in its own ways.
    except (ImportError, NotImplementedError, RuntimeError, OSError) as error:
        package = module_name.partition('.')[0].replace('adafruit_', 'adafruit-circuitpython-')
        raise DeviceError(f'{name}: cannot be loaded ({error}); is {package} installed?') from error
    if not hasattr(module, class_name):
        raise DeviceError(f'{name}: the module {module_name} has no {class_name}')
    return getattr(module, class_name)
