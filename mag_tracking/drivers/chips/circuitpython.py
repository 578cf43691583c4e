"""Adapter for CircuitPython drivers, which exist for nearly every magnetometer.

The chip name `adafruit_lis3mdl.LIS3MDL` selects the class `LIS3MDL` of the module
`adafruit_lis3mdl`, which must be installed (`pip install adafruit-circuitpython-lis3mdl`). The
adapter creates an instance with a bus, the address (if a parameter is named after it; otherwise the
class uses one address only, which must be the configured one) and default arguments, and reads its
property `magnetic` or `magnetometer`.

A module of `chips/` is preferable: the adapter neither distinguishes an old conversion from a new
one nor detects an axis over its range, and some drivers block while they wait. Axes and scale are
those of the driver; the fields of the MMC5603 driver 1.0.16 are 2.4 % larger than with the scale of
the data sheet, 16384 counts per gauss. The timestamp of a reading is the middle of the call, 0.5 to
1.5 periods late for a chip that measures continuously.

Sources: the CircuitPython API reference, `busio.I2C`. The CircuitPython design guide, "sensor
properties and units", demands microtesla of `magnetic`, which not all classes return: `UNITS` was
measured with the packages in constraints.txt and simulated chips.
"""

import errno
import importlib
import inspect
from typing import Any

from smbus2 import i2c_msg

from mag_tracking.drivers.chips.chip import Chip, Conversion, Measurement, Registers
from mag_tracking.errors import DeviceError

TIMEOUT_NS = 250_000_000
"""[ns] Timeout of one measurement. Creating the driver instance may take ten times as long."""
UNITS = {
    'adafruit_bno055.BNO055_I2C': 'uT', 'adafruit_bno08x.i2c.BNO08X_I2C': 'uT',
    'adafruit_fxos8700.FXOS8700': 'uT', 'adafruit_icm20x.ICM20948': 'uT',
    'adafruit_lis2mdl.LIS2MDL': 'uT', 'adafruit_lis3mdl.LIS3MDL': 'uT',
    'adafruit_lsm303agr_mag.LSM303AGR_Mag': 'uT', 'adafruit_lsm303dlh_mag.LSM303DLH_Mag': 'uT',
    'adafruit_lsm9ds0.LSM9DS0_I2C': 'G', 'adafruit_lsm9ds1.LSM9DS1_I2C': 'G',
    'adafruit_mlx90393.MLX90393': 'uT', 'adafruit_mlx90395.MLX90395': 'uT',
    'adafruit_mmc56x3.MMC5603': 'uT', 'adafruit_qmc5883p.QMC5883P': 'G',
    'adafruit_tlv493d.TLV493D': 'uT', 'adafruit_tmag5273.TMAG5273': 'uT', 'qmc5883l.QMC5883L': 'G',
    'rm3100.RM3100_I2C': 'uT'}
"""{module.Class: unit of its field}."""
PROPERTIES = ('magnetic', 'magnetometer')
REPORTS = {'adafruit_bno08x.i2c.BNO08X_I2C': 0x03}
"""{module.Class: number of the report of the field, which is disabled after a reset}."""


class BusioI2c:
    """Subset of the interface of `busio.I2C` that CircuitPython drivers use.

    After the deadline, `try_lock` and every transaction raise DeviceError, because drivers wait for
    their chip in unbounded loops, of which some ignore OSError. `addresses` are those of all chips
    that a driver has accessed.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self.addresses: set[int] = set()
        self._locked = False
        self._deadline_ns = 0

    def begin(self, timeout_ns: int) -> None:
        """Unlock the bus and set the deadline."""
        self._locked = False
        self._deadline_ns = self._registers.monotonic_ns() + timeout_ns

    def try_lock(self) -> bool:
        """Lock the bus; return whether it was free."""
        self._check_deadline()
        free, self._locked = not self._locked, True
        return free

    def unlock(self) -> None:
        """Unlock the bus."""
        self._locked = False

    def writeto(self, address: int, buffer: bytes | bytearray, *, start: int = 0,
                end: int | None = None) -> None:
        """Write `buffer[start:end]`; an empty write checks whether the chip answers."""
        data = bytes(buffer[start:end])
        # Many adapters refuse a message of zero length.
        self._transfer(i2c_msg.write(address, data) if data else i2c_msg.read(address, 1))

    def readfrom_into(self, address: int, buffer: bytearray, *, start: int = 0,
                      end: int | None = None) -> None:
        """Read into `buffer[start:end]`."""
        message = i2c_msg.read(address, len(buffer[start:end]))
        self._transfer(message)
        buffer[start:end] = bytes(message)

    def writeto_then_readfrom(self, address: int, out_buffer: bytes | bytearray,
                              in_buffer: bytearray, *, out_start: int = 0,
                              out_end: int | None = None, in_start: int = 0,
                              in_end: int | None = None) -> None:
        """Write and read in one transaction."""
        message = i2c_msg.read(address, len(in_buffer[in_start:in_end]))
        self._transfer(i2c_msg.write(address, bytes(out_buffer[out_start:out_end])), message)
        in_buffer[in_start:in_end] = bytes(message)

    def _transfer(self, *messages: i2c_msg) -> None:
        self._check_deadline()
        self.addresses.update(message.addr for message in messages)
        self._registers.transfer(*messages)

    def _check_deadline(self) -> None:
        if self._registers.monotonic_ns() > self._deadline_ns:
            raise DeviceError('timeout while the driver waited for its chip')


class CircuitpythonChip(Chip):
    """Chip read through a CircuitPython driver `module.Class` in units of `scale` [T]."""

    def __init__(self, registers: Registers, name: str, address: int, scale: float) -> None:
        self._registers, self._name, self._address = registers, name, address
        self._scale = scale
        self._i2c = BusioI2c(registers)
        # Instance of a third-party class, and the name of the property that reads its field.
        self._driver: Any = None
        self._property = ''

    def set_up(self) -> None:
        """Load the driver and create its instance."""
        cls = load(self._name)
        self._i2c.addresses.clear()
        self._i2c.begin(10 * TIMEOUT_NS)
        try:
            argument = _address_argument(cls, self._address)
            self._driver = cls(self._i2c, **argument)
            self._property = self._property_name()
            if self._name in REPORTS:
                self._enable_report(REPORTS[self._name])
        except OSError:
            raise
        # A third-party class may raise any error.
        except Exception as error:
            raise DeviceError(f'{self._name}: {_text(error)}') from error
        if not argument and self._i2c.addresses and self._address not in self._i2c.addresses:
            used = ', '.join(f'{address:#04x}' for address in sorted(self._i2c.addresses))
            raise DeviceError(f'{self._name}: the class does not use this address, but {used}; '
                              'correct the address')

    def _property_name(self) -> str:
        # A look at the property of the instance would start a measurement.
        members = {*dir(type(self._driver)), *getattr(self._driver, '__dict__', ())}
        if found := [name for name in PROPERTIES if name in members]:
            return found[0]
        raise DeviceError(f'the class has none of the properties {", ".join(PROPERTIES)}')

    def _enable_report(self, report: int) -> None:
        """Enable a report and wait until it arrives; before that, the field is exactly 0."""
        self._driver.enable_feature(report)
        self._i2c.begin(10 * TIMEOUT_NS)
        while not any(getattr(self._driver, self._property)):
            self._registers.sleep(0.01)

    def measure(self) -> Measurement:
        """Read the property of the driver, which waits for the chip; nothing is yielded."""
        yield from ()
        self._i2c.begin(TIMEOUT_NS)
        start_ns = self._registers.monotonic_ns()
        try:
            x, y, z = (self._scale * value for value in getattr(self._driver, self._property))
        except OSError:
            raise
        # A third-party class may raise any error.
        except Exception as error:
            raise OSError(errno.EIO, f'{self._name}: {_text(error)}') from error
        middle_ns = (start_ns + self._registers.monotonic_ns()) // 2
        return Conversion(middle_ns, (x, y, z))


def _address_argument(cls: Any, address: int) -> dict[str, int]:
    names = list(inspect.signature(cls).parameters)[1:]
    candidates = ['address'] * ('address' in names) + [name for name in names if 'addr' in name]
    return dict.fromkeys(candidates[:1], address)


def _text(error: Exception) -> str:
    """Describe an error; the text of many built-in errors does not say what happened."""
    return str(error) if isinstance(error, DeviceError) else f'{type(error).__name__}: {error}'


def load(name: str) -> Any:
    """Load a driver class `module.Class`."""
    module_name, _, class_name = name.rpartition('.')
    try:
        module = importlib.import_module(module_name)
    # Blinka, which CircuitPython drivers import, raises various errors on unsupported boards.
    except Exception as error:
        package = module_name.partition('.')[0]
        if package.startswith('adafruit_'):
            package = package.replace('adafruit_', 'adafruit-circuitpython-')
        elif name in UNITS:
            package = f'circuitpython-{package}'
        raise DeviceError(f'{name}: cannot be loaded ({error}); is {package} installed?') from error
    if not hasattr(module, class_name):
        raise DeviceError(f'{name}: the module {module_name} has no class {class_name}')
    return getattr(module, class_name)
