"""ST LIS3MDL: a magnetoresistive sensor, 16 bits.

It measures continuously at 155 Hz in its ultra-high-performance mode. A reading's
time is that of reading less one period of 6.5 ms: half a period for the conversion, half for how
long it has lain there, which is uncertain by half a period.

Axes: as drawn in the data sheet, right-handed.

Scale: 14.6, 29.2, 43.8, 58.4 nT a count for full scales of 400, 800, 1200, 1600 uT,
beyond which an axis is NaN. Noise 320 nT (X, Y) and 410 nT (Z) rms, measured by ST at
1200 uT. The offset is up to 100 uT.

Source: LIS3MDL data sheet, ST DocID024204 Rev 4 (2015), tables 3, 16 and sections 5, 7.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass

from mag_tracking.drivers.chips.chip import (
    MARGIN,
    Conversion,
    Measurement,
    Registers,
    in_range,
    one_of,
)
from mag_tracking.settings import param

CONTROL_1, STATUS, OUT = 0x20, 0x27, 0x28
AND_FOLLOWING = 0x80
"""In a register's number: count it up while bytes are read."""
SOFT_RESET, ULTRA_155_HZ, CONTINUOUS, ULTRA_Z, WHOLE_UPDATES = 0x04, 0x62, 0x00, 0x0C, 0x40
NEW, OVERWRITTEN = 0x08, 0x80
SOFT_RESET_S = 0.01
PERIOD_NS = round(1e9 / 155.0)
FULL_SCALES = {400.0: (0x00, 6842), 800.0: (0x20, 3421), 1200.0: (0x40, 2281),
               1600.0: (0x60, 1711)}
"""{full scale [uT]: (bits of control register 2, counts per gauss)}."""


@dataclass(frozen=True)
class Lis3mdlSettings:
    """Settings of the LIS3MDL on a bus."""

    range_ut: float = param(
        400.0, 'Largest field of an axis: 400, 800, 1200 or 1600.', 'uT', (400.0, 1600.0))


class Lis3mdl:
    """LIS3MDL; see the module."""

    IDENTITY = ((0x0F, 0x3D),)
    NAME = 'lis3mdl'

    def __init__(self, registers: Registers, settings: Lis3mdlSettings,
                 count: Callable[[str], None]) -> None:
        self._registers, self._count = registers, count
        self._scale_bits, self._gain = one_of('lis3mdl.range_ut', settings.range_ut, FULL_SCALES)
        self._largest = settings.range_ut * 1e-6

    def set_up(self) -> None:
        """See `Chip`."""
        self._registers.write(CONTROL_1 + 1, SOFT_RESET)
        self._registers.sleep(SOFT_RESET_S)
        self._registers.write(CONTROL_1, ULTRA_155_HZ)
        self._registers.write(CONTROL_1 + 1, self._scale_bits)
        self._registers.write(CONTROL_1 + 3, ULTRA_Z)
        self._registers.write(CONTROL_1 + 4, WHOLE_UPDATES)
        self._registers.write(CONTROL_1 + 2, CONTINUOUS)
        self._registers.sleep(PERIOD_NS * 1e-9 * MARGIN)

    def measure(self) -> Measurement:
        """See `Chip`; it measures by itself, so there is nothing to wait for."""
        yield from ()
        now_ns = self._registers.monotonic_ns()
        status = self._registers.read(STATUS)
        if not status & NEW:
            return None
        if status & OVERWRITTEN:
            self._count('conversions overwritten before they were read')
        counts = struct.unpack('<hhh', self._registers.read_block(OUT | AND_FOLLOWING, 6))
        return Conversion(now_ns - PERIOD_NS,
                          in_range([c / self._gain * 1e-4 for c in counts], self._largest))
