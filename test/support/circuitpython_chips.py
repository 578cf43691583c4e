"""Simulated chips that are read through CircuitPython drivers, by their data sheets.

`CASES` lists the classes of drivers with their addresses and simulated chips.
"""

import struct
from dataclasses import dataclass

from support.i2c_chips import (
    MS,
    FakeChip,
    FakeLis3mdl,
    FakeMmc5603,
    FakeRm3100,
)

UT = 1e-6


def packed(layout, values, divisors):
    """Pack fields [T] in units of `divisors` [T]."""
    return struct.pack(layout, *(round(v / d) for v, d in zip(values, divisors, strict=True)))


class RegisterChip(FakeChip):
    """Chip with constant identity registers, whose output registers always hold a new conversion.

    `order` lists the axes in the order of the registers, `unit` the field of one count [T].
    `cleared` masks the bits that the chip clears when a reset is finished; `increment` is the
    mask of the register number that enables auto-increment.
    """

    def __init__(self, clock, field, identity, output, layout, unit, order='xyz', cleared=None,
                 status=None, register_mask=0xFF):
        self.identity, self.output, self.layout, self.order = identity, output, layout, order
        self.units = [unit] * 3 if isinstance(unit, float) else unit
        self.cleared, self.status, self.register_mask = cleared or {}, status, register_mask
        super().__init__(clock, field)

    def reset(self):
        for register, value in self.identity.items():
            self.memory[register] = value

    def write(self, data):
        super().write(bytes([data[0] & self.register_mask]) + data[1:] if data else data)

    def store(self, register, value):
        if register not in self.identity:
            self.memory[register] = value & ~self.cleared.get(register, 0)

    def fetch(self, register):
        if register == self.output:
            axes = dict(zip('xyz', self.field(self.clock.ns), strict=True))
            counts = packed(self.layout, [axes[a] for a in self.order], self.units)
            self.memory[register:register + len(counts)] = counts
        return self.memory[register] | (self.status or {}).get(register, 0)


class FakeBno055(RegisterChip):
    """BNO055: two pages of registers; the field is in units of 1/16 uT."""

    def __init__(self, clock, field):
        self.pages = [bytearray(256), bytearray(256)]
        super().__init__(clock, field, {0x00: 0xA0}, 0x0E, '<hhh', UT / 16)

    def store(self, register, value):
        if register == 0x07:
            self.memory = self.pages[value & 1]
            self.memory[0x00] = 0xA0
        self.memory[register] = value


class FakeIcm20948(RegisterChip):
    """ICM-20948: four banks, and an AK09916 (0.15 uT per count) on its own bus."""

    def __init__(self, clock, field, has_magnetometer=True):
        self.banks = [bytearray(256) for _ in range(4)]
        self.bank = 0
        self.has_magnetometer = has_magnetometer
        super().__init__(clock, field, {0x00: 0xEA}, 0x3B, '<hhh', 0.15 * UT)

    def power_up(self):
        self.pointer = 0
        self.banks[0][0x00], self.banks[0][0x06] = 0xEA, 0x41

    @property
    def memory(self):
        return self.banks[self.bank]

    def store(self, register, value):
        if register == 0x7F:
            self.bank = value >> 4 & 3
            return
        if (self.bank, register) == (0, 0x06):
            value &= 0x7F
        self.memory[register] = value
        if (self.bank, register) == (3, 0x15) and value & 0x80 and self.has_magnetometer:
            self.banks[3][0x17] = {0x00: 0x48, 0x01: 0x09}.get(self.memory[0x14], 0)
            self.banks[0][0x17] |= 0x40

    def fetch(self, register):
        if self.bank or register != self.output or not (
                self.has_magnetometer and self.banks[3][0x05] & 0x80):
            return self.memory[register]
        assert self.banks[3][0x03] == 0x8C and self.banks[3][0x04] == 0x11
        return super().fetch(register)


class FakeMlx90393(FakeChip):
    """MLX90393: commands instead of registers; 0.150 and 0.242 uT per count at gain 7."""

    def power_up(self):
        self.words = dict.fromkeys(range(64), 0)
        self.words[0x24] = 0xB668
        self.response = b'\x00'

    def write(self, data):
        command, self.response = data[0] & 0xF0, b'\x02'
        if command == 0x60:
            self.words[data[3] >> 2] = data[1] << 8 | data[2]
        elif command == 0x50:
            self.response = b'\x02' + self.words[data[1] >> 2].to_bytes(2, 'big')
        elif command == 0x30:
            self.response = b'\x20'
            self.measured = packed('>hhh', self.field(self.clock.ns),
                                   [0.150 * UT, 0.150 * UT, 0.242 * UT])
        elif command == 0x40:
            assert self.words[0x00] >> 4 & 7 == 7, 'only gain 7 is simulated'
            self.response = b'\x00' + self.measured

    def read(self, length):
        return self.response.ljust(length, b'\x00')[:length]


class FakeMlx90395(FakeChip):
    """MLX90395, medium field, gain code 9: 2.5 uT * 0.125 per count."""

    def power_up(self):
        self.response = b'\x00'

    def write(self, data):
        if data[0] == 0x80 and len(data) == 2:
            self.response = {0xF0: b'\x02', 0x3F: b'\x20'}.get(data[1], b'\x00')
        elif data[0] == 0x80:
            self.response = b'\x01\x00' + packed('>hhh', self.field(self.clock.ns),
                                                 [2.5 * UT * 0.125] * 3) + bytes(4)
        else:
            self.response = b'\x00\x90'

    def read(self, length):
        return self.response.ljust(length, b'\x00')[:length]


class FakeQmc5883l(RegisterChip):
    """QMC5883L in its range of 2 gauss: 12000 counts per gauss at 200 Hz.

    Bit 0 of the status register means a new conversion, bit 2 that one was overwritten.
    """

    def __init__(self, clock, field):
        super().__init__(clock, field, {0x0D: 0xFF}, 0x00, '<hhh', 1e-4 / 12000)
        self.read_ns = clock.ns

    def fetch(self, register):
        n_new = (self.clock.ns - self.read_ns) // (5 * MS)
        if register == 0x06:
            return min(n_new, 1) | (n_new > 1) << 2
        if register == 0x05:
            self.read_ns = self.clock.ns
        return super().fetch(register)


class FakeTlv493d(FakeChip):
    """TLV493D-A1B6: no register numbers, 12 bits, 98 uT per count."""

    def write(self, data):
        self.written.append(bytes(data))

    def read(self, length):
        counts = [round(b / (98 * UT)) & 0xFFF for b in self.field(self.clock.ns)]
        x, y, z = counts
        return bytes([x >> 4, y >> 4, z >> 4, 0, (x & 15) << 4 | y & 15, z & 15, 0, 0, 0, 0]
                     )[:length]


class FakeBno08x(FakeChip):
    """BNO085: packets of the sensor hub transport protocol; the field is in units of 1/16 uT.

    A report of the field arrives every 50 ms after it was enabled.
    """

    def power_up(self):
        self.packets = [(0, bytes(20)), (1, b'\x01'), (2, b'\xf1' + bytes(15))]
        self.sequence, self.due_ns = 0, None

    def write(self, data):
        channel, content = data[2], data[4:]
        if channel == 2 and content[0] == 0xF9:
            self.packets.append((2, b'\xf8' + bytes((1, 3, 2)) + bytes((1, 2, 3, 4)) + bytes(8)))
        elif channel == 2 and content[0] == 0xFD:
            assert content[1] == 0x03, 'only the field is simulated'
            self.packets.append((2, b'\xfc' + bytes(content[1:17])))
            self.due_ns = self.clock.ns + 50 * MS

    def read(self, length):
        while self.due_ns is not None and self.clock.ns >= self.due_ns:
            report = bytes((0x03, 0, 3, 0)) + packed('<hhh', self.field(self.due_ns), [UT / 16] * 3)
            self.packets.append((3, bytes((0xFB, 0, 0, 0, 0)) + report))
            self.due_ns += 50 * MS
        if not self.packets:
            return bytes(length)
        channel, content = self.packets[0]
        packet = struct.pack('<HBB', len(content) + 4, channel, self.sequence) + content
        # The header alone is read first, and then the whole packet again.
        if length > 4:
            self.packets.pop(0)
            self.sequence = (self.sequence + 1) % 256
        return packet.ljust(length, b'\x00')[:length]


def loose_lis3mdl(clock, field):
    """LIS3MDL that increments its register pointer as the CircuitPython driver assumes."""
    chip = FakeLis3mdl(clock, field)
    chip.strict = False
    return chip


def st_chip(clock, field):
    """LIS2MDL or magnetometer of an LSM303AGR: 1.5 mG per count."""
    return RegisterChip(clock, field, {0x4F: 0x40}, 0x68, '<hhh', 0.15 * UT, cleared={0x60: 0x60})


@dataclass
class Case:
    """Class of a driver, its address, and functions that create the chips by address."""

    name: str
    address: int
    make: object
    others: dict = None
    scale: float = 1.0
    """Ratio of the field that the driver returns to the true field."""
    count: float = 0.3 * UT
    identifies: bool = True
    """Whether the driver checks that the chip is the right one."""

    def chips(self, clock, field):
        """Return {address: simulated chip}."""
        return {self.address: self.make(clock, field),
                **{a: make(clock, field) for a, make in (self.others or {}).items()}}


def registers(*args, **options):
    """Return a function that creates a `RegisterChip`."""
    return lambda clock, field: RegisterChip(clock, field, *args, **options)


CASES = [
    Case('adafruit_bno055.BNO055_I2C', 0x28, FakeBno055),
    Case('adafruit_bno08x.i2c.BNO08X_I2C', 0x4A, FakeBno08x),
    Case('adafruit_fxos8700.FXOS8700', 0x1F, registers({0x0D: 0xC7}, 0x33, '>hhh', 0.1 * UT)),
    Case('adafruit_icm20x.ICM20948', 0x69, FakeIcm20948),
    Case('adafruit_lis2mdl.LIS2MDL', 0x1E, st_chip),
    Case('adafruit_lis3mdl.LIS3MDL', 0x1C, loose_lis3mdl),
    Case('adafruit_lsm303agr_mag.LSM303AGR_Mag', 0x1E, st_chip),
    # The gain after power-up: 1100 counts per gauss on x and y, 980 on z.
    Case('adafruit_lsm303dlh_mag.LSM303DLH_Mag', 0x1E, registers(
        {}, 0x03, '>hhh', [1e-4 / 1100, 1e-4 / 980, 1e-4 / 1100], order='xzy'),
        identifies=False),
    Case('adafruit_lsm9ds0.LSM9DS0_I2C', 0x1D, registers(
        {0x0F: 0x49}, 0x08, '<hhh', 8e-9, register_mask=0x7F), {0x6B: registers(
            {0x0F: 0xD4}, 0x28, '<hhh', 1.0, register_mask=0x7F)}),
    Case('adafruit_lsm9ds1.LSM9DS1_I2C', 0x1E, registers(
        {0x0F: 0x3D}, 0x28, '<hhh', 14e-9, register_mask=0x7F), {0x6B: registers(
            {0x0F: 0x68}, 0x18, '<hhh', 1.0)}),
    Case('adafruit_mlx90393.MLX90393', 0x0C, FakeMlx90393, identifies=False),
    Case('adafruit_mlx90395.MLX90395', 0x0C, FakeMlx90395, count=0.4 * UT),
    # The driver scales a count of 1 / 16384 G as 0.0625 mG, and accepts 0 as identity.
    Case('adafruit_mmc56x3.MMC5603', 0x30, FakeMmc5603, scale=0.0625e-3 * 16384,
         identifies=False),
    # The range of 8 gauss.
    Case('adafruit_qmc5883p.QMC5883P', 0x2C, registers(
        {0x00: 0x80}, 0x01, '<hhh', 1e-4 / 3750, status={0x09: 0x01})),
    Case('adafruit_tlv493d.TLV493D', 0x5E, FakeTlv493d, count=98 * UT, identifies=False),
    # The range of 80 mT.
    Case('adafruit_tmag5273.TMAG5273', 0x35, registers(
        {0x0D: 0x01, 0x0E: 0x49, 0x0F: 0x54}, 0x12, '>hhh', 80e-3 / 32768), count=3 * UT),
    Case('qmc5883l.QMC5883L', 0x0D, FakeQmc5883l),
    # The driver takes the gain as proportional to the number of cycles: 80 instead of 75 counts
    # per microtesla at 200.
    Case('rm3100.RM3100_I2C', 0x20, FakeRm3100, scale=75 / 80, identifies=False)]
