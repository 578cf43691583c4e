"""PNI RM3100: three magneto-inductive coils and a counter, 24 bits.

It measures continuously, X, Y and Z in sequence, as fast as its cycle count permits. The timestamp
of a reading is the time of the read access minus one period: half a period for the conversion and
half a period for its mean age. The uncertainty is half a period. The period is 1.9, 3.5, 6.8 ms for
50, 100, 200 cycles.

Axes: determined by the board on which the coils are mounted. If the coils are placed and connected
as in the manual, the axes are right-handed (north, east, down).

Scale: 50, 26, 13 nT per count; range ±800 µT, beyond which an axis is NaN; noise of 30, 20, 15 nT
rms.

Source: RM3100 & RM2100 Sensor Suite User Manual, PNI doc 1017252, table 3-1 (scale, rate, noise),
tables 5-1 to 5-4 and 5-8.
"""

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

CONTINUOUS, CYCLE_COUNTS, RATE, RESULTS, STATUS = 0x01, 0x04, 0x0B, 0x24, 0x34
ALL_AXES_READY = 0x79
"""Register value: measure all three axes continuously, and report them when all are ready."""
FASTEST_RATE = 0x92
READY = 0x80
FULL_SCALE = 800e-6
"""[T] Measurement range of an axis."""
CYCLES = {50: (20.0, 534.0), 100: (38.0, 283.0), 200: (75.0, 147.0)}
"""{cycle count: (counts per microtesla, measurements of all axes per second)}."""


@dataclass(frozen=True)
class Rm3100Settings:
    """Settings of an RM3100 on I2C."""

    cycle_count: int = param(
        200, 'Number of oscillations counted for each axis: 50, 100 or 200. Higher counts give '
        'finer resolution at a lower rate.', '', (50, 200))


class Rm3100:
    """RM3100 magnetometer; the module describes its timing, axes and scale."""

    IDENTITY = ((0x36, 0x22),)
    NAME = 'rm3100'

    def __init__(self, registers: Registers, settings: Rm3100Settings,
                 count: Callable[[str], None]) -> None:
        self._registers, self._cycles = registers, settings.cycle_count
        self._gain, rate_hz = look_up_choice('rm3100.cycle_count', settings.cycle_count, CYCLES)
        self._delay_ns = round(1e9 / rate_hz)

    def set_up(self) -> None:
        """Configure the chip for continuous measurement."""
        # Cycle counts and rate are accepted only while the chip does not measure.
        self._registers.write(CONTINUOUS, 0)
        for axis in range(3):
            self._registers.write(CYCLE_COUNTS + 2 * axis, self._cycles >> 8)
            self._registers.write(CYCLE_COUNTS + 2 * axis + 1, self._cycles & 0xFF)
        self._registers.write(RATE, FASTEST_RATE)
        self._registers.write(CONTINUOUS, ALL_AXES_READY)
        self._registers.sleep(self._delay_ns * 1e-9 * CONVERSION_MARGIN)

    def measure(self) -> Measurement:
        """Read the latest conversion, None if it is not new; nothing is yielded, since it measures
        continuously."""
        yield from ()
        now_ns = self._registers.monotonic_ns()
        if not self._registers.read(STATUS) & READY:
            return None
        block = self._registers.read_block(RESULTS, 9)
        counts = (int.from_bytes(block[i:i + 3], 'big', signed=True) for i in (0, 3, 6))
        return Conversion(now_ns - self._delay_ns,
                          mask_overrange([c / self._gain * 1e-6 for c in counts], FULL_SCALE))
