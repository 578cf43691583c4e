"""Simulated I2C bus with chips, multiplexers and faults, in place of `smbus2.SMBus`."""

import errno

from mag_tracking.drivers.transports.i2c import I2cDevice, I2cSettings
from mag_tracking.settings import replace
from support.i2c_chips import (
    MS,
    Clock,
    FakeChip,
    FakeHmc5883l,
    FakeLis3mdl,
    FakeMmc5603,
    FakeMmc5983ma,
    FakeRm3100,
)

B = (2e-5, -1e-5, 4e-5)
FAKES = {'mmc5983ma': (FakeMmc5983ma, 0x30), 'mmc5603': (FakeMmc5603, 0x30),
         'hmc5883l': (FakeHmc5883l, 0x1E), 'hmc5983': (FakeHmc5883l, 0x1E),
         'rm3100': (FakeRm3100, 0x20), 'lis3mdl': (FakeLis3mdl, 0x1C)}
"""{chip: (simulated chip, address)}."""


class FakeMultiplexer(FakeChip):
    """TCA9548A: a register with one bit per channel; `channels` is {number: {address: chip}}."""

    def __init__(self, clock, channels):
        self.channels, self.mask = channels, 0xFF
        super().__init__(clock)

    def write(self, data):
        self.mask = data[-1]
        self.written.append(self.mask)

    def behind(self, address):
        return [chips[address] for n, chips in self.channels.items()
                if self.mask >> n & 1 and address in chips]


class FakeBus:
    """Simulated bus, which the driver opens by `open_bus`."""

    def __init__(self, clock, chips, hz=400_000):
        self.clock, self.chips, self._hz = clock, chips, hz
        # Results of the next transactions: an OSError, or None for success.
        self.next_errors, self.hangs = [], False
        self.open, self.opened, self.closed = False, 0, 0

    def open_bus(self, number):
        self.open, self.number = True, number
        self.opened += 1
        return self

    def close(self):
        self.open = False
        self.closed += 1

    def _chip(self, address, n_bytes):
        """Advance the clock by a transaction, and return the chip that answers at an address."""
        assert self.open
        if self.hangs:
            self.clock.ns += 1000 * MS
            raise OSError(errno.ETIMEDOUT, 'Connection timed out')
        self.clock.ns += round(9e9 * (n_bytes + 1) / self._hz)
        error = self.next_errors.pop(0) if self.next_errors else None
        if error is not None:
            raise error
        answering = [self.chips[address]] if address in self.chips else []
        for chip in self.chips.values():
            if isinstance(chip, FakeMultiplexer):
                answering += chip.behind(address)
        answering = [chip for chip in answering if chip.answers]
        assert len(answering) < 2, f'two chips answer at {address:#04x}'
        if not answering:
            raise OSError(errno.EREMOTEIO, 'Remote I/O error')
        return answering[0]

    def write_byte(self, address, value):
        self._chip(address, 1).write(bytes([value]))

    def write_byte_data(self, address, register, value):
        self._chip(address, 2).write(bytes([register, value]))

    def read_byte_data(self, address, register):
        chip = self._chip(address, 3)
        chip.write(bytes([register]))
        return chip.read(1)[0]

    def read_i2c_block_data(self, address, register, length):
        assert 1 <= length <= 32
        chip = self._chip(address, 2 + length)
        chip.write(bytes([register]))
        return list(chip.read(length))

    def i2c_rdwr(self, *messages):
        for message in messages:
            assert message.len > 0, 'many adapters refuse a message without bytes'
            chip = self._chip(message.addr, message.len)
            if message.flags & 1:
                for i, byte in enumerate(chip.read(message.len)):
                    message.buf[i] = bytes([byte])
            else:
                chip.write(bytes(message))


def rig(entries, chips=None, clock=None, **changes):
    """Create (clock, bus, device); by default, each of `entries` ('name:chip:address') has a chip
    on the bus."""
    clock = clock or Clock()
    if chips is None:
        chips = {}
        for entry in entries:
            _, chip, address = entry.split(':')
            chips[int(address, 16)] = FAKES[chip][0](clock)
    bus = FakeBus(clock, chips)
    settings = replace(I2cSettings(), {'sensors': entries, **changes})
    return clock, bus, I2cDevice(settings, bus.open_bus, clock.monotonic_ns, clock.sleep)


def one(chip, **changes):
    """Create and open a device with one sensor A; return (clock, bus, device, simulated chip)."""
    address = FAKES[chip][1]
    clock, bus, device = rig([f'A:{chip}:{address:#04x}'], **changes)
    device.open()
    return clock, bus, device, bus.chips[address]
