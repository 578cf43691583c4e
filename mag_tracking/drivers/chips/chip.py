"""Interface of a magnetometer chip, and access to its registers.

To add a chip, write one file with a frozen dataclass of its settings and a class that implements
`Chip`, and add one line each to `_CLASSES` and `I2cSettings` in `transports/i2c.py`.
"""

import errno
import math
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar

from smbus2 import i2c_msg

from mag_tracking.drivers.reading import Axes
from mag_tracking.errors import DeviceError, SettingsError

CONVERSION_MARGIN = 1.1
"""Ratio of the waiting time to the typical conversion time of the data sheet."""
Identity: TypeAlias = tuple[tuple[int, int], ...]
"""((register, expected value), ...) by which a chip is identified."""
Value = TypeVar('Value', int, float)
Choice = TypeVar('Choice')


class SmBus(Protocol):
    """Subset of the interface of `smbus2.SMBus`. All methods raise OSError if they fail."""

    def write_byte(self, i2c_addr: int, value: int, /) -> object:
        """Write one byte without a register number.

        Parameters
        ----------
        i2c_addr : int
        value : int
        """

    def read_byte_data(self, i2c_addr: int, register: int, /) -> int:
        """Read one register.

        Parameters
        ----------
        i2c_addr : int
        register : int

        Returns
        -------
        int
        """

    def write_byte_data(self, i2c_addr: int, register: int, value: int, /) -> object:
        """Write one register.

        Parameters
        ----------
        i2c_addr : int
        register : int
        value : int
        """

    def read_i2c_block_data(self, i2c_addr: int, register: int, length: int, /) -> Sequence[int]:
        """Read successive registers.

        Parameters
        ----------
        i2c_addr : int
        register : int
            First register.
        length : int
            Number of registers.

        Returns
        -------
        sequence of int
        """

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> object:
        """Transfer several messages in one transaction.

        Parameters
        ----------
        *i2c_msgs : i2c_msg
        """

    def close(self) -> object:
        """Close the bus."""


class ChipLocation(NamedTuple):
    """Location of a chip on a bus."""

    address: int
    """Address of the chip."""
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
    sheet, SCPS207, section 8.5). Transfers raise OSError if `smbus` is None, a bus that is not
    open.
    """

    def __init__(self, smbus: SmBus | None, monotonic_ns: Callable[[], int],
                 sleep: Callable[[float], object], multiplexers: Collection[int] = ()) -> None:
        self._smbus = smbus
        self.monotonic_ns, self.sleep = monotonic_ns, sleep
        self._multiplexers = sorted(multiplexers)
        self._selected: tuple[int | None, int | None] | None = None

    @property
    def smbus(self) -> SmBus:
        """Interface to the open bus; raises OSError if none is open."""
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
        """Read up to 32 successive registers; raises OSError if the block is shorter than
        requested."""
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
    """[T] Field in the right-handed axes described by the chip's module; NaN for an axis that
    exceeds its range."""


Measurement: TypeAlias = Generator[float, None, Conversion | None]
"""Return type of `Chip.measure`: yields waiting times [s], returns a `Conversion` or None."""


class Identified(Protocol):
    """Interface of a chip, or of a chip class, that declares its identity registers."""

    @property
    def IDENTITY(self) -> Identity:
        """Registers and values that identify the chip; empty if the chip is not identified."""


class Chip(Identified, Protocol):
    """Interface of a magnetometer chip."""

    def set_up(self) -> None:
        """Configure the chip, regardless of its previous state.

        Raises
        ------
        OSError
            If the chip does not answer.
        DeviceError
            If the chip cannot be configured. The message gives the reason.
        """

    def measure(self) -> Measurement:
        """Measure the field once.

        The chips of a bus measure concurrently. While another chip uses the bus, the generator may
        be resumed later than requested.

        Returns
        -------
        Conversion or None
            None if no new conversion is available.

        Yields
        ------
        float, s
            Time to wait before the generator is resumed.

        Raises
        ------
        OSError
            If the chip fails.
        """


class ChipClass(Identified, Protocol):
    """Interface of a chip class, which creates instances of `Chip`.

    Creating an instance must not access the bus. The instance calls `count` for each loss, with the
    cause as a plural noun phrase.
    """

    NAME: str
    """Name of the chip in the settings, and name of its settings group."""

    def __call__(self, registers: Registers, settings: Any,
                 count: Callable[[str], None]) -> Chip:
        """Create a chip that is accessed through `registers`."""


def check_identity(chip: Identified, registers: Registers) -> None:
    """Raise DeviceError if another chip answers, OSError if none does."""
    for register, expected in chip.IDENTITY:
        value = registers.read(register)
        if value != expected:
            raise DeviceError(f'identity register {register:#04x} reads {value:#04x} instead of '
                              f'{expected:#04x}')


def look_up_choice(name: str, value: Value, choices: Mapping[Value, Choice]) -> Choice:
    """Look up the value of a setting in `choices`; raises SettingsError if it is not permitted."""
    if value not in choices:
        raise SettingsError(f'{name}: expected one of {", ".join(map(str, choices))}, got {value}')
    return choices[value]


def mask_overrange(values: Iterable[float], largest: float) -> Axes:
    """Replace values (3) whose magnitude exceeds `largest` by NaN."""
    x, y, z = (v if abs(v) <= largest else math.nan for v in values)
    return x, y, z
