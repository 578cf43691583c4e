"""Base class of a magnetometer chip, and access to its registers.

To add a chip, write one file with a frozen dataclass of its settings and a subclass of `Chip`, and
add one line each to `_CLASSES` and `I2cSettings` in `transports/i2c.py`.
"""

import errno
import math
from collections.abc import Callable, Collection, Generator, Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias, TypeVar

from smbus2 import SMBus, i2c_msg

from mag_tracking.drivers.reading import Axes
from mag_tracking.errors import DeviceError, SettingsError

CONVERSION_MARGIN = 1.1
"""Ratio of the waiting time to the typical conversion time of the data sheet."""
Value = TypeVar('Value', int, float)
Choice = TypeVar('Choice')


class ChipLocation(NamedTuple):
    """Location of a chip on a bus."""

    address: int
    multiplexer: int | None = None
    """Address of the TCA9548A multiplexer; None if the chip is directly on the bus."""
    channel: int | None = None
    """Channel of the multiplexer, 0 to 7; None if there is no multiplexer."""

    def __str__(self) -> str:
        channel = ('' if self.multiplexer is None else
                   f', on channel {self.channel} of the multiplexer at {self.multiplexer:#04x}')
        return f'address {self.address:#04x}{channel}'


class Bus:
    """I2C bus with its multiplexers, of which at most one channel is open at any time.

    No channel is open during a transfer to a chip directly on the bus. The only register of a
    multiplexer has one bit for each channel and is written without a register number (TCA9548A data
    sheet, SCPS207, section 8.5). `smbus` is None for a bus that is not open.
    """

    def __init__(self, smbus: SMBus | None, monotonic_ns: Callable[[], int],
                 sleep: Callable[[float], object], multiplexers: Collection[int] = ()) -> None:
        self._smbus = smbus
        self.monotonic_ns, self.sleep = monotonic_ns, sleep
        self._multiplexers = sorted(multiplexers)
        self._selected: tuple[int | None, int | None] | None = None

    @property
    def smbus(self) -> SMBus:
        """Interface to the open bus."""
        if self._smbus is None:
            raise OSError(errno.ENODEV, 'the bus is not open')
        return self._smbus

    def select(self, location: ChipLocation) -> None:
        """Open the multiplexer channel of a chip and close all other channels."""
        selection = (location.multiplexer, location.channel)
        if not self._multiplexers or selection == self._selected:
            return
        open_multiplexer = None if self._selected is None else self._selected[0]
        # Multiplexers in an unknown state may have an open channel.
        to_close = self._multiplexers if self._selected is None else [open_multiplexer]
        for address in to_close:
            if address is not None and address != location.multiplexer:
                self.smbus.write_byte(address, 0)
        if location.multiplexer is not None and location.channel is not None:
            self.smbus.write_byte(location.multiplexer, 1 << location.channel)
        self._selected = selection

    def invalidate_selection(self) -> None:
        """Discard the stored selection; a failure may have changed the state of a multiplexer."""
        self._selected = None


class Registers:
    """Access to the registers of one chip; all methods raise OSError if it does not answer."""

    def __init__(self, bus: Bus, location: ChipLocation) -> None:
        self._bus, self._location = bus, location
        self.monotonic_ns, self.sleep = bus.monotonic_ns, bus.sleep

    def read(self, register: int) -> int:
        """Read one register."""
        self._bus.select(self._location)
        return self._bus.smbus.read_byte_data(self._location.address, register)

    def read_block(self, register: int, length: int) -> bytes:
        """Read up to 32 successive registers."""
        self._bus.select(self._location)
        block = bytes(self._bus.smbus.read_i2c_block_data(self._location.address, register, length))
        if len(block) != length:
            raise OSError(errno.EIO, f'received {len(block)} of {length} bytes')
        return block

    def write(self, register: int, value: int) -> None:
        """Write one register."""
        self._bus.select(self._location)
        self._bus.smbus.write_byte_data(self._location.address, register, value)

    def transfer(self, *messages: i2c_msg) -> None:
        """Transfer messages in one transaction."""
        self._bus.select(self._location)
        self._bus.smbus.i2c_rdwr(*messages)


class Conversion(NamedTuple):
    """Measured field and time of one conversion."""

    middle_ns: int
    """Estimated `time.monotonic_ns()` at the middle of the conversion."""
    field: Axes
    """[T] Field in the axes described by the chip's module; NaN for an axis over its range."""


Measurement: TypeAlias = Generator[float, None, Conversion | None]
"""Return type of `Chip.measure`: yields waiting times [s], returns a `Conversion` or None."""


class Chip:
    """Magnetometer chip.

    Creating one does not access the bus. `count` is called with the plural cause of each loss.
    """

    NAME = ''
    """Name of the chip in the settings, and name of its settings group."""
    IDENTITY: tuple[tuple[int, int], ...] = ()
    """((register, expected value), ...); empty if the chip is not identified."""

    def __init__(self, registers: Registers, settings: Any, count: Callable[[str], None]) -> None:
        self._registers, self._count = registers, count

    @classmethod
    def check_identity(cls, registers: Registers) -> None:
        """Raise DeviceError if another chip answers, OSError if none does."""
        for register, expected in cls.IDENTITY:
            value = registers.read(register)
            if value != expected:
                raise DeviceError(f'identity register {register:#04x} reads {value:#04x} instead '
                                  f'of {expected:#04x}')

    def set_up(self) -> None:
        """Configure the chip, regardless of its previous state; raises OSError if it does not
        answer, or DeviceError, with the reason, if it cannot be configured."""
        raise NotImplementedError

    def measure(self) -> Measurement:
        """Measure the field once, None without a new conversion; yield the times to wait [s].

        The chips of a bus measure concurrently. While another chip uses the bus, the generator may
        be resumed later than requested. Raises OSError if the chip fails.
        """
        raise NotImplementedError


def look_up_choice(name: str, value: Value, choices: Mapping[Value, Choice]) -> Choice:
    """Look up the value of a setting in `choices`."""
    if value not in choices:
        raise SettingsError(f'{name}: expected one of {", ".join(map(str, choices))}, got {value}')
    return choices[value]


def mask_overrange(values: Iterable[float], largest: float) -> Axes:
    """Replace values (3) whose magnitude exceeds `largest` by NaN."""
    x, y, z = (v if abs(v) <= largest else math.nan for v in values)
    return x, y, z
