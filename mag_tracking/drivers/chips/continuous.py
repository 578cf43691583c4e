"""ST LIS3MDL and PNI RM3100: chips that measure continuously.

The timestamp of a reading is the time of the read access minus one period: half a period for the
conversion and half a period for its mean age. The uncertainty is half a period.

LIS3MDL: magnetoresistive sensor, 16 bits. It measures at 155 Hz, with a period of 6.5 ms, in
ultra-high-performance mode. Axes as drawn in the data sheet, right-handed. 14.6, 29.2, 43.8, 58.4
nT per count for full scales of 400, 800, 1200, 1600 µT, beyond which an axis is NaN. The noise is
320 nT (X, Y) and 410 nT (Z) rms, measured by ST at 1200 µT. The offset is up to 100 µT.

RM3100: three magneto-inductive coils and a counter, 24 bits. It measures X, Y and Z in sequence, as
fast as its cycle count permits: the period is 1.9, 3.5, 6.8 ms for 50, 100, 200 cycles. The axes
are determined by the board on which the coils are mounted. If the coils are placed and connected as
in the manual, the axes are right-handed (north, east, down). 50, 26, 13 nT per count; range ±800
µT, beyond which an axis is NaN; noise of 30, 20, 15 nT rms.

Sources: LIS3MDL data sheet, ST DocID024204 Rev 4 (2015), tables 3, 16 and sections 5, 7; RM3100 &
RM2100 Sensor Suite User Manual, PNI doc 1017252, table 3-1 (scale, rate, noise), tables 5-1 to 5-4
and 5-8.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass

from mag_tracking.drivers.chips import chip
from mag_tracking.settings import param


@dataclass(frozen=True)
class Lis3mdlSettings:
    """Settings of a LIS3MDL on I2C."""

    range_ut: float = param(
        400.0, 'Measurement range of an axis: 400, 800, 1200 or 1600.', 'uT', (400.0, 1600.0))


class Lis3mdl(chip.Chip):
    """LIS3MDL magnetometer; the module describes its timing, axes and scale."""

    NAME = 'lis3mdl'
    IDENTITY = ((0x0F, 0x3D),)
    CONTROL_1, STATUS, OUT = 0x20, 0x27, 0x28
    AUTO_INCREMENT = 0x80
    """Bit of a register number that makes the chip increment it with every byte read."""
    SOFT_RESET, ULTRA_155_HZ, CONTINUOUS, ULTRA_Z, BLOCK_DATA_UPDATE = 0x04, 0x62, 0x00, 0x0C, 0x40
    NEW_DATA, OVERRUN = 0x08, 0x80
    SOFT_RESET_S = 0.01
    PERIOD_NS = round(1e9 / 155.0)
    FULL_SCALES = {400.0: (0x00, 6842), 800.0: (0x20, 3421), 1200.0: (0x40, 2281),
                   1600.0: (0x60, 1711)}
    """{full scale [µT]: (bits of control register 2, counts per gauss)}."""

    def __init__(self, registers: chip.Registers, settings: Lis3mdlSettings,
                 count: Callable[[str], None]) -> None:
        super().__init__(registers, settings, count)
        self._scale_bits, self._gain = chip.look_up_choice(
            'lis3mdl.range_ut', settings.range_ut, self.FULL_SCALES)
        self._max_field = settings.range_ut * 1e-6

    def set_up(self) -> None:
        """Configure the chip for continuous measurement."""
        self._registers.write(self.CONTROL_1 + 1, self.SOFT_RESET)
        self._registers.sleep(self.SOFT_RESET_S)
        self._registers.write(self.CONTROL_1, self.ULTRA_155_HZ)
        self._registers.write(self.CONTROL_1 + 1, self._scale_bits)
        self._registers.write(self.CONTROL_1 + 3, self.ULTRA_Z)
        self._registers.write(self.CONTROL_1 + 4, self.BLOCK_DATA_UPDATE)
        self._registers.write(self.CONTROL_1 + 2, self.CONTINUOUS)
        self._registers.sleep(self.PERIOD_NS * 1e-9 * chip.CONVERSION_MARGIN)

    def measure(self) -> chip.Measurement:
        """Read the latest conversion, None if it is not new; nothing is yielded."""
        yield from ()
        now_ns = self._registers.monotonic_ns()
        status = self._registers.read(self.STATUS)
        if not status & self.NEW_DATA:
            return None
        if status & self.OVERRUN:
            self._count('conversions overwritten before they were read')
        block = self._registers.read_block(self.OUT | self.AUTO_INCREMENT, 6)
        return chip.Conversion(now_ns - self.PERIOD_NS, chip.mask_overrange(
            [c / self._gain * 1e-4 for c in struct.unpack('<hhh', block)], self._max_field))


@dataclass(frozen=True)
class Rm3100Settings:
    """Settings of an RM3100 on I2C."""

    cycle_count: int = param(
        200, 'Number of oscillations counted for each axis: 50, 100 or 200. Higher counts give '
        'finer resolution at a lower rate.', '', (50, 200))


class Rm3100(chip.Chip):
    """RM3100 magnetometer; the module describes its timing, axes and scale."""

    NAME = 'rm3100'
    IDENTITY = ((0x36, 0x22),)
    CONTINUOUS, CYCLE_COUNTS, RATE, RESULTS, STATUS = 0x01, 0x04, 0x0B, 0x24, 0x34
    ALL_AXES_READY = 0x79
    """Register value: measure all three axes continuously, and report them when all are ready."""
    FASTEST_RATE = 0x92
    READY = 0x80
    FULL_SCALE = 800e-6
    """[T] Measurement range of an axis."""
    CYCLES = {50: (20.0, 534.0), 100: (38.0, 283.0), 200: (75.0, 147.0)}
    """{cycle count: (counts per microtesla, measurements of all axes per second)}."""

    def __init__(self, registers: chip.Registers, settings: Rm3100Settings,
                 count: Callable[[str], None]) -> None:
        super().__init__(registers, settings, count)
        self._cycles = settings.cycle_count
        self._gain, rate_hz = chip.look_up_choice('rm3100.cycle_count', self._cycles, self.CYCLES)
        self._delay_ns = round(1e9 / rate_hz)

    def set_up(self) -> None:
        """Configure the chip for continuous measurement."""
        # Cycle counts and rate are accepted only while the chip does not measure.
        self._registers.write(self.CONTINUOUS, 0)
        for axis in range(3):
            self._registers.write(self.CYCLE_COUNTS + 2 * axis, self._cycles >> 8)
            self._registers.write(self.CYCLE_COUNTS + 2 * axis + 1, self._cycles & 0xFF)
        self._registers.write(self.RATE, self.FASTEST_RATE)
        self._registers.write(self.CONTINUOUS, self.ALL_AXES_READY)
        self._registers.sleep(self._delay_ns * 1e-9 * chip.CONVERSION_MARGIN)

    def measure(self) -> chip.Measurement:
        """Read the latest conversion, None if it is not new; nothing is yielded."""
        yield from ()
        now_ns = self._registers.monotonic_ns()
        if not self._registers.read(self.STATUS) & self.READY:
            return None
        block = self._registers.read_block(self.RESULTS, 9)
        counts = (int.from_bytes(block[i:i + 3], 'big', signed=True) for i in (0, 3, 6))
        return chip.Conversion(now_ns - self._delay_ns, chip.mask_overrange(
            [c / self._gain * 1e-6 for c in counts], self.FULL_SCALE))
