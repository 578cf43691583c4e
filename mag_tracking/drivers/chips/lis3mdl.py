"""ST LIS3MDL: magnetoresistive sensor, 16 bits.

It measures continuously at 155 Hz in ultra-high-performance mode. The timestamp of a reading is the
time of the read access minus one period of 6.5 ms: half a period for the conversion and half a
period for its mean age. The uncertainty is half a period.

Axes: as drawn in the data sheet, right-handed.

Scale: 14.6, 29.2, 43.8, 58.4 nT per count for full scales of 400, 800, 1200, 1600 µT, beyond which
an axis is NaN. The noise is 320 nT (X, Y) and 410 nT (Z) rms, measured by ST at 1200 µT. The offset
is up to 100 µT.

Source: LIS3MDL data sheet, ST DocID024204 Rev 4 (2015), tables 3, 16 and sections 5, 7.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass

from mag_tracking.drivers.chips.chip import (
    CONVERSION_MARGIN,
    Conversion,
    Measurement,
    Registers,
    look_up_choice,
    mask_overrange,
)
from mag_tracking.settings import param

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


@dataclass(frozen=True)
class Lis3mdlSettings:
    """Settings of a LIS3MDL on I2C."""

    range_ut: float = param(
        400.0, 'Measurement range of an axis: 400, 800, 1200 or 1600.', 'uT', (400.0, 1600.0))


class Lis3mdl:
    """LIS3MDL magnetometer; the module describes its timing, axes and scale."""

    IDENTITY = ((0x0F, 0x3D),)
    NAME = 'lis3mdl'

    def __init__(self, registers: Registers, settings: Lis3mdlSettings,
                 count: Callable[[str], None]) -> None:
        self._registers, self._count = registers, count
        self._scale_bits, self._gain = look_up_choice(
            'lis3mdl.range_ut', settings.range_ut, FULL_SCALES)
        self._max_field = settings.range_ut * 1e-6

    def set_up(self) -> None:
        """Configure the chip for continuous measurement."""
        self._registers.write(CONTROL_1 + 1, SOFT_RESET)
        self._registers.sleep(SOFT_RESET_S)
        self._registers.write(CONTROL_1, ULTRA_155_HZ)
        self._registers.write(CONTROL_1 + 1, self._scale_bits)
        self._registers.write(CONTROL_1 + 3, ULTRA_Z)
        self._registers.write(CONTROL_1 + 4, BLOCK_DATA_UPDATE)
        self._registers.write(CONTROL_1 + 2, CONTINUOUS)
        self._registers.sleep(PERIOD_NS * 1e-9 * CONVERSION_MARGIN)

    def measure(self) -> Measurement:
        """Read the latest conversion, None if it is not new; nothing is yielded, since it measures
        continuously."""
        yield from ()
        now_ns = self._registers.monotonic_ns()
        status = self._registers.read(STATUS)
        if not status & NEW_DATA:
            return None
        if status & OVERRUN:
            self._count('conversions overwritten before they were read')
        counts = struct.unpack('<hhh', self._registers.read_block(OUT | AUTO_INCREMENT, 6))
        return Conversion(now_ns - PERIOD_NS,
                          mask_overrange([c / self._gain * 1e-4 for c in counts], self._max_field))
