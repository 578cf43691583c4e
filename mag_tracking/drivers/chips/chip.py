"""What a chip is to the polling, and how it reaches its registers.

A new sensor is one file with a frozen dataclass of settings and a class with the
methods of `Chip`, and one line each in `CHIPS` and `I2cSettings` of
`transports/i2c.py`.
"""

import errno
import math
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar

from smbus2 import i2c_msg

from mag_tracking.drivers.reading import Axes
from mag_tracking.errors import DeviceError, SettingsError

MARGIN = 1.1
"""By how much longer than the data sheet's typical value a conversion is waited for."""
Identity: TypeAlias = tuple[tuple[int, int], ...]
"""((register, value), ...) by which a chip is known."""
Value = TypeVar('Value', int, float)
Choice = TypeVar('Choice')


class SmBus(Protocol):
    """What is used of `smbus2.SMBus`; all methods raise OSError."""

    def write_byte(self, i2c_addr: int, value: int, /) -> object:
        """Send one byte without a register's number."""

    def read_byte_data(self, i2c_addr: int, register: int, /) -> int:
        """One register."""

    def write_byte_data(self, i2c_addr: int, register: int, value: int, /) -> object:
        """Write one register."""

    def read_i2c_block_data(self, i2c_addr: int, register: int, length: int, /) -> Sequence[int]:
        """Successive registers."""

    def i2c_rdwr(self, *i2c_msgs: i2c_msg) -> object:
        """Several messages as one transaction."""

    def close(self) -> object:
        """Close the bus."""


class Place(NamedTuple):
    """Where on a bus a chip is."""

    address: int
    multiplexer: int | None = None
    """Address of a TCA9548A; None = the chip is on the bus itself."""
    channel: int | None = None

    def __str__(self) -> str:
        behind = ('' if self.multiplexer is None else
                  f', behind channel {self.channel} of the multiplexer at {self.multiplexer:#04x}')
        return f'address {self.address:#04x}{behind}'


class Bus:
    """An open bus, its multiplexers, and the time.

    Parameters
    ----------
    smbus : smbus2.SMBus, or what has its methods
        None where nothing is said to the chips.
    monotonic_ns, sleep : functions
    multiplexers : set of int
        Addresses of every TCA9548A. One channel of one of them is open at a time, and
        none while a chip on the bus itself is spoken to.

    Source: TCA9548A data sheet (SCPS207), section 8.5: its only register takes one
    bit for each channel, without a register's number before it.
    """

    def __init__(self, smbus: SmBus | None, monotonic_ns: Callable[[], int],
                 sleep: Callable[[float], object], multiplexers: Collection[int] = ()) -> None:
        self._smbus = smbus
        self.monotonic_ns, self.sleep = monotonic_ns, sleep
        self._multiplexers = sorted(multiplexers)
        self._selected: tuple[int | None, int | None] | None = None

    @property
    def smbus(self) -> SmBus:
        """What it was made with; raises OSError where that was None."""
        if self._smbus is None:
            raise OSError(errno.ENODEV, 'there is no bus')
        return self._smbus

    def select(self, place: Place) -> None:
        """Open the way to a place and close all others; raises OSError."""
        wanted = (place.multiplexer, place.channel)
        if not self._multiplexers or wanted == self._selected:
            return
        open_now = None if self._selected is None else self._selected[0]
        # What is not known to be shut may be open.
        others = self._multiplexers if self._selected is None else [open_now]
        for address in others:
            if address is not None and address != place.multiplexer:
                self.smbus.write_byte(address, 0)
        if place.multiplexer is not None and place.channel is not None:
            self.smbus.write_byte(place.multiplexer, 1 << place.channel)
        self._selected = wanted

    def forget(self) -> None:
        """After a failure: what is open is not known any more."""
        self._selected = None


class Registers:
    """The registers of one chip; all methods raise OSError where it does not answer."""

    def __init__(self, bus: Bus, place: Place) -> None:
        self._bus, self._place = bus, place
        self.monotonic_ns, self.sleep = bus.monotonic_ns, bus.sleep

    def read(self, register: int) -> int:
        """One register, as an int."""
        self._bus.select(self._place)
        return self._bus.smbus.read_byte_data(self._place.address, register)

    def read_block(self, register: int, length: int) -> bytes:
        """(length,) bytes of successive registers, 32 at most."""
        self._bus.select(self._place)
        block = bytes(self._bus.smbus.read_i2c_block_data(self._place.address, register, length))
        if len(block) != length:
            raise OSError(errno.EIO, f'{len(block)} of {length} bytes came')
        return block

    def write(self, register: int, value: int) -> None:
        """Write one register."""
        self._bus.select(self._place)
        self._bus.smbus.write_byte_data(self._place.address, register, value)

    def transfer(self, *messages: i2c_msg) -> None:
        """`smbus2.i2c_msg`s as one transaction."""
        self._bus.select(self._place)
        self._bus.smbus.i2c_rdwr(*messages)


class Conversion(NamedTuple):
    """What a chip measured."""

    middle_ns: int
    """`time.monotonic_ns()` at the middle of its conversion, as nearly as is known."""
    field: Axes
    """[T] in the right-handed axes that its class describes; NaN where over the range."""


Measurement: TypeAlias = Generator[float, None, Conversion | None]
"""Of `Chip.measure`."""


class Identified(Protocol):
    """A chip, or the class of one."""

    @property
    def IDENTITY(self) -> Identity:
        """By which it is known."""


class Chip(Identified, Protocol):
    """A magnetometer."""

    def set_up(self) -> None:
        """Make it ready, whatever its state; raises OSError, or DeviceError that says why."""

    def measure(self) -> Measurement:
        """A generator of one measurement: yields seconds to wait, returns a `Conversion`.

        Returns None where there is no conversion that was not returned before. Raises
        OSError where the chip fails. The chips of a bus measure at the same time, so it
        may be asked to go on later than that, when another keeps the bus.
        """


class ChipClass(Identified, Protocol):
    """A class of `Chip`s. Making one must not touch the bus.

    `count` takes the cause of what is lost, in the plural.
    """

    NAME: str
    """In the settings; theirs are under the same name."""

    def __call__(self, registers: Registers, settings: Any,
                 count: Callable[[str], None]) -> Chip:
        """A chip with these registers."""


def check_identity(chip: Identified, registers: Registers) -> None:
    """Raises DeviceError where another chip answers, OSError where none does."""
    for register, expected in chip.IDENTITY:
        found = registers.read(register)
        if found != expected:
            raise DeviceError(f'identity register {register:#04x} reads {found:#04x} instead of '
                              f'{expected:#04x}')


def one_of(name: str, value: Value, choices: Mapping[Value, Choice]) -> Choice:
    """`choices[value]` of a setting that has but a few values; raises SettingsError."""
    if value not in choices:
        raise SettingsError(f'{name}: expected one of {", ".join(map(str, choices))}, got {value}')
    return choices[value]


def in_range(values: Iterable[float], largest: float) -> Axes:
    """Three `values`, with NaN for those whose size is above `largest`."""
    x, y, z = (v if abs(v) <= largest else math.nan for v in values)
    return x, y, z
