"""What a chip is to the polling, and how it reaches its registers.

A new sensor is one file with a frozen dataclass of settings and a class with the
methods of `Chip`, and one line each in `i2c_device.CHIPS` and `I2cSettings`.
"""

import errno
import math
from typing import NamedTuple, Protocol

from mag_tracking.errors import DeviceError, SettingsError

MARGIN = 1.1
"""By how much longer than the data sheet's typical value a conversion is waited for."""


class Place(NamedTuple):
    """Where on a bus a chip is."""

    address: int
    multiplexer: int | None = None
    """Address of a TCA9548A; None = the chip is on the bus itself."""
    channel: int | None = None

    def __str__(self):
        behind = ('' if self.multiplexer is None else
                  f', behind channel {self.channel} of the multiplexer at {self.multiplexer:#04x}')
        return f'address {self.address:#04x}{behind}'


class Bus:
    """An open bus, its multiplexers, and the time.

    Parameters
    ----------
    smbus : smbus2.SMBus, or what has its methods
    monotonic_ns, sleep : functions
    multiplexers : set of int
        Addresses of every TCA9548A. One channel of one of them is open at a time, and
        none while a chip on the bus itself is spoken to.

    Source: TCA9548A data sheet (SCPS207), section 8.5: its only register takes one
    bit for each channel, without a register's number before it.
    """

    def __init__(self, smbus, monotonic_ns, sleep, multiplexers=()):
        self.smbus = smbus
        self.monotonic_ns, self.sleep = monotonic_ns, sleep
        self._multiplexers = sorted(multiplexers)
        self._selected = None

    def select(self, place):
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
        if place.multiplexer is not None:
            self.smbus.write_byte(place.multiplexer, 1 << place.channel)
        self._selected = wanted

    def forget(self):
        """After a failure: what is open is not known any more."""
        self._selected = None


class Registers:
    """The registers of one chip; all methods raise OSError where it does not answer."""

    def __init__(self, bus, place):
        self._bus, self._place = bus, place
        self.monotonic_ns, self.sleep = bus.monotonic_ns, bus.sleep

    def read(self, register):
        """One register, as an int."""
        self._bus.select(self._place)
        return self._bus.smbus.read_byte_data(self._place.address, register)

    def read_block(self, register, length):
        """(length,) bytes of successive registers, 32 at most."""
        self._bus.select(self._place)
        block = bytes(self._bus.smbus.read_i2c_block_data(self._place.address, register, length))
        if len(block) != length:
            raise OSError(errno.EIO, f'{len(block)} of {length} bytes came')
        return block

    def write(self, register, value):
        """Write one register."""
        self._bus.select(self._place)
        self._bus.smbus.write_byte_data(self._place.address, register, value)

    def transfer(self, *messages):
        """`smbus2.i2c_msg`s as one transaction."""
        self._bus.select(self._place)
        self._bus.smbus.i2c_rdwr(*messages)


class Conversion(NamedTuple):
    """What a chip measured."""

    middle_ns: int
    """`time.monotonic_ns()` at the middle of its conversion, as nearly as is known."""
    field: tuple[float, float, float]
    """[T] in the right-handed axes that its class describes; NaN where over the range."""


class Chip(Protocol):
    """A magnetometer. `Class(registers, settings, count)` must not touch the bus.

    `count`, a function, takes the cause of what is lost, in the plural.
    """

    IDENTITY: tuple
    """((register, value), ...) by which the chip is known."""

    def set_up(self):
        """Make it ready, whatever its state; raises OSError, or DeviceError that says why."""

    def measure(self):
        """A generator of one measurement: yields seconds to wait, returns a `Conversion`.

        Returns None where there is no conversion that was not returned before. Raises
        OSError where the chip fails. The chips of a bus measure at the same time, so it
        may be asked to go on later than that, when another keeps the bus.
        """


def check_identity(chip, registers):
    """Raises DeviceError where another chip answers, OSError where none does."""
    for register, expected in chip.IDENTITY:
        found = registers.read(register)
        if found != expected:
            raise DeviceError(f'identity register {register:#04x} reads {found:#04x} instead of '
                              f'{expected:#04x}')


def one_of(name, value, choices):
    """`choices[value]` of a setting that has but a few values; raises SettingsError."""
    if value not in choices:
        raise SettingsError(f'{name}: expected one of {", ".join(map(str, choices))}, got {value}')
    return choices[value]


def in_range(values, largest):
    """`values`, with NaN for those whose size is above `largest`."""
    return tuple(v if abs(v) <= largest else math.nan for v in values)
