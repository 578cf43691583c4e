"""Adapter for CircuitPython drivers, which exist for nearly every magnetometer.

The chip name `adafruit_lis3mdl.LIS3MDL` selects the class `LIS3MDL` of the module
`adafruit_lis3mdl`, which must be installed (`pip install adafruit-circuitpython-lis3mdl`). The
adapter creates an instance with a bus, an address and the default arguments of the class, and reads
its property `magnetic`.

If `chips/` has a module for the chip, that module is preferable, because the adapter has several
limitations. The adapter does not distinguish an old conversion from a new one, and does not detect
an axis over its range. Some drivers block while they wait for a conversion. The driver defines axes
and scale; for example, the fields of the MMC5603 driver 1.0.16 are 2.4 % larger than with the scale
of the data sheet, 16384 counts per gauss. The timestamp of a reading is the middle of the call,
which is 0.5 to 1.5 periods late for a chip that measures continuously.

Source: the CircuitPython API reference, `busio.I2C`, and "CircuitPython design guide, sensor
properties and units": `magnetic` is in microtesla.
"""

import errno
import importlib
from typing import Any

from smbus2 import i2c_msg

from mag_tracking.drivers.chips.chip import Conversion, Measurement, Registers
from mag_tracking.errors import DeviceError

TIMEOUT_NS = 250_000_000
"""[ns] Timeout of one measurement. Creating the driver instance may take ten times as long."""


class BusioI2c:
    """Subset of the interface of `busio.I2C` that CircuitPython drivers use.

    After the deadline, `try_lock` and every transaction raise OSError, because drivers wait for
    their chip in unbounded loops.

    Parameters
    ----------
    registers : Registers
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._locked = False
        self._deadline_ns = 0

    def begin(self, timeout_ns: int) -> None:
        """Unlock the bus and set the deadline.

        Parameters
        ----------
        timeout_ns : int, ns
            Time until the deadline.
        """
        self._locked = False
        self._deadline_ns = self._registers.monotonic_ns() + timeout_ns

    def try_lock(self) -> bool:
        """Lock the bus if it is free.

        Returns
        -------
        bool
            Whether the bus was free.
        """
        self._check_deadline()
        free, self._locked = not self._locked, True
        return free

    def unlock(self) -> None:
        """Unlock the bus."""
        self._locked = False

    def writeto(self, address: int, buffer: bytes | bytearray, *, start: int = 0,
                end: int | None = None) -> None:
        """Write `buffer[start:end]`; an empty write checks whether the chip answers.

        Parameters
        ----------
        address : int
        buffer : bytes or bytearray
        start : int, optional
        end : int, optional
        """
        data = bytes(buffer[start:end])
        # Many adapters refuse a message of zero length.
        self._transfer(i2c_msg.write(address, data) if data else i2c_msg.read(address, 1))

    def readfrom_into(self, address: int, buffer: bytearray, *, start: int = 0,
                      end: int | None = None) -> None:
        """Read into `buffer[start:end]`.

        Parameters
        ----------
        address : int
        buffer : bytearray
        start : int, optional
        end : int, optional
        """
        message = i2c_msg.read(address, len(buffer[start:end]))
        self._transfer(message)
        buffer[start:end] = bytes(message)

    def writeto_then_readfrom(self, address: int, out_buffer: bytes | bytearray,
                              in_buffer: bytearray, *, out_start: int = 0,
                              out_end: int | None = None, in_start: int = 0,
                              in_end: int | None = None) -> None:
        """Write and read in one transaction.

        Parameters
        ----------
        address : int
        out_buffer : bytes or bytearray
        in_buffer : bytearray
        out_start : int, optional
        out_end : int, optional
        in_start : int, optional
        in_end : int, optional
        """
        message = i2c_msg.read(address, len(in_buffer[in_start:in_end]))
        self._transfer(i2c_msg.write(address, bytes(out_buffer[out_start:out_end])), message)
        in_buffer[in_start:in_end] = bytes(message)

    def _transfer(self, *messages: i2c_msg) -> None:
        """Make one transaction; raise OSError if the deadline has passed."""
        self._check_deadline()
        self._registers.transfer(*messages)

    def _check_deadline(self) -> None:
        """Raise OSError if the deadline has passed."""
        if self._registers.monotonic_ns() > self._deadline_ns:
            raise OSError(errno.EIO, 'timeout while the driver waited for its chip')


class CircuitpythonChip:
    """Chip read through a CircuitPython driver. Implements `Chip`.

    Parameters
    ----------
    registers : Registers
    name : str
        `module.Class` of the driver.
    address : int
    """

    IDENTITY = ()

    def __init__(self, registers: Registers, name: str, address: int) -> None:
        self._registers, self._name, self._address = registers, name, address
        self._i2c = BusioI2c(registers)
        # Instance of a third-party class.
        self._driver: Any = None

    def set_up(self) -> None:
        """Load the driver and create its instance.

        Raises
        ------
        DeviceError
            If the driver is not installed or does not find the chip.
        """
        cls = load(self._name)
        self._i2c.begin(10 * TIMEOUT_NS)
        try:
            self._driver = cls(self._i2c, self._address)
        except (RuntimeError, ValueError) as error:
            raise DeviceError(f'{self._name}: {error}') from error

    def measure(self) -> Measurement:
        """Read the property `magnetic` of the driver.

        Returns
        -------
        Conversion

        Yields
        ------
        float, s
            Nothing is yielded: the driver itself waits for the chip.

        Raises
        ------
        OSError
            If the driver fails.
        """
        yield from ()
        self._i2c.begin(TIMEOUT_NS)
        start_ns = self._registers.monotonic_ns()
        try:
            x, y, z = self._driver.magnetic
        except (RuntimeError, ValueError, TypeError) as error:
            raise OSError(errno.EIO, f'{self._name}: {error}') from error
        middle_ns = (start_ns + self._registers.monotonic_ns()) // 2
        return Conversion(middle_ns, (x * 1e-6, y * 1e-6, z * 1e-6))


def load(name: str) -> Any:
    """Load a driver class.

    Parameters
    ----------
    name : str
        `module.Class`.

    Returns
    -------
    type

    Raises
    ------
    DeviceError
        If the class cannot be loaded. If the import fails, the message names the package to
        install.
    """
    module_name, _, class_name = name.rpartition('.')
    try:
        module = importlib.import_module(module_name)
    # Blinka, which CircuitPython drivers import, raises various errors on unsupported boards.
    except (ImportError, NotImplementedError, RuntimeError, OSError) as error:
        package = module_name.partition('.')[0].replace('adafruit_', 'adafruit-circuitpython-')
        raise DeviceError(f'{name}: cannot be loaded ({error}); is {package} installed?') from error
    if not hasattr(module, class_name):
        raise DeviceError(f'{name}: the module {module_name} has no class {class_name}')
    return getattr(module, class_name)
