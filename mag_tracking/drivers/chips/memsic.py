"""MEMSIC MMC5983MA and MMC5603NJ: anisotropic magnetoresistive bridges, 18 and 20 bits.

The offset of a bridge drifts with temperature by much more than the noise. A current pulse (SET, or
RESET with the opposite sign) reverses the sensing direction of all three axes, but not the offset.
Half the difference of the measurements after a SET and a RESET therefore has no offset, and half
their sum is the offset. The pulses also remove the effect of a strong magnet on the chip. By
default, a reading is a pair of such measurements, `1 ms + 1.1 conversion` apart. If `set_reset_s`
is above 0, a pair is measured only at that interval, and its offset is subtracted from the single
measurements until the next pair: faster, but with 1.4 times the noise, and half of a change of the
field during a pair remains in the offset until the next.

Each reading starts its own conversions. Its timestamp is the middle of the conversion, or the mean
of the two middles in a pair, within 0.5 ms for the chip's oscillator. A pair lasts twice `1 ms +
1.1 conversion`, plus about 1 ms on a bus of 400 kHz.

Axes: positive after RESET, which makes them right-handed (Linux, mmc5633.c: "naturally aligned
after RESET"), although the data sheet of the MMC5983MA calls the value after SET positive. Rotate
the board once in the Earth's field to verify the signs.

MMC5983MA: ±800 µT, 6.10 nT per count. Noise of 40, 60, 80, 120 nT rms for conversions of 8, 4, 2,
0.5 ms; a pair has 0.7 times the noise. MMC5603NJ: ±3 mT, 6.10 nT per count. Noise of 200 nT rms for
the conversion of 6.6 ms.

Sources: MMC5983MA data sheet Rev A (2019), "Register Map" and "Using SET and RESET to remove bridge
offset"; MMC5603NJ data sheet Rev B (2018).
"""

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass

from mag_tracking.drivers.chips import chip
from mag_tracking.drivers.reading import Axes
from mag_tracking.settings import param

COUNTS_PER_TESLA = 16384e4
TAKE_MEASUREMENT, SET, RESET, SOFT_RESET = 0x01, 0x08, 0x10, 0x80
SETTLING_TIME_S = 1e-3
"""[s] Minimum time from a pulse to the next measurement."""


@dataclass(frozen=True)
class Mmc5983maSettings:
    """Settings of an MMC5983MA on I2C."""

    conversion_ms: float = param(
        4.0, 'Duration of a conversion: 8, 4, 2 or 0.5. Longer conversions have less noise.', 'ms',
        (0.5, 8.0))
    set_reset_s: float = param(
        0.0, 'Interval between measurements of the offset; 0 measures it with every reading.', 's',
        (0.0, 3600.0))


@dataclass(frozen=True)
class Mmc5603Settings(Mmc5983maSettings):
    """Settings of an MMC5603NJ on I2C."""

    conversion_ms: float = param(
        3.5, 'Duration of a conversion: 6.6, 3.5, 2 or 1.2. Longer conversions have less noise.',
        'ms', (1.2, 6.6))


class Mmc5983ma(chip.Chip):
    """MMC5983MA magnetometer; the module describes its timing, axes and scale."""

    IDENTITY = ((0x2F, 0x30),)
    NAME = 'mmc5983ma'
    STATUS, DONE, CONTROL_0, CONTROL_1 = 0x08, 0x01, 0x09, 0x0A
    BANDWIDTHS = {8.0: 0, 4.0: 1, 2.0: 2, 0.5: 3}
    SOFT_RESET_S = 0.015
    FULL_SCALE = 131070
    """Maximum valid magnitude of a count; at larger magnitudes, the converter is saturated."""
    N_BYTES = 7

    def __init__(self, registers: chip.Registers, settings: Mmc5983maSettings,
                 count: Callable[[str], None]) -> None:
        super().__init__(registers, settings, count)
        self._bandwidth = chip.look_up_choice(f'{self.NAME}.conversion_ms', settings.conversion_ms,
                                              self.BANDWIDTHS)
        self._conversion_ns = round(settings.conversion_ms * 1e6)
        self._set_reset_ns = round(settings.set_reset_s * 1e9)
        self._offset: Axes | None = None
        self._offset_ns = 0

    def set_up(self) -> None:
        """Reset and configure the chip."""
        self._registers.write(self.CONTROL_1, SOFT_RESET)
        self._registers.sleep(self.SOFT_RESET_S)
        self._registers.write(self.CONTROL_1, self._bandwidth)

    def measure(self) -> chip.Measurement:
        """Make one measurement if the stored offset is recent, otherwise a SET/RESET pair."""
        if self._offset is None or (
                self._registers.monotonic_ns() - self._offset_ns >= self._set_reset_ns):
            return (yield from self._measure_pair())
        conversion = yield from self._convert()
        if conversion is None:
            return None
        middle_ns, counts = conversion
        x, y, z = (c - o for c, o in zip(counts, self._offset, strict=True))
        return _conversion(middle_ns, (x, y, z))

    def _measure_pair(self) -> chip.Measurement:
        conversions = []
        for pulse in (SET, RESET):
            self._registers.write(self.CONTROL_0, pulse)
            yield SETTLING_TIME_S
            conversion = yield from self._convert()
            if conversion is None:
                return None
            conversions.append(conversion)
        (set_ns, after_set), (reset_ns, after_reset) = conversions
        x, y, z = ((r + s) / 2 for r, s in zip(after_reset, after_set, strict=True))
        # An axis over its range has no offset, so the next measurement is a pair again.
        self._offset = None if any(map(math.isnan, (x, y, z))) else (x, y, z)
        self._offset_ns = reset_ns
        x, y, z = ((r - s) / 2 for r, s in zip(after_reset, after_set, strict=True))
        return _conversion((set_ns + reset_ns) // 2, (x, y, z))

    def _convert(self) -> Generator[float, None, tuple[int, Axes] | None]:
        """Make one conversion; return (middle [ns], counts), or None if not finished in time."""
        self._registers.write(self.CONTROL_0, TAKE_MEASUREMENT)
        start_ns = self._registers.monotonic_ns()
        yield self._conversion_ns * 1e-9 * chip.CONVERSION_MARGIN
        if not self._registers.read(self.STATUS) & self.DONE:
            return None
        counts = self._counts(self._registers.read_block(0x00, self.N_BYTES))
        return start_ns + self._conversion_ns // 2, chip.mask_overrange(counts, self.FULL_SCALE)

    @staticmethod
    def _counts(block: bytes) -> list[int]:
        """Signed counts from a block: 16 bits per axis, then one byte with 2 low bits per axis."""
        return [(block[2 * i] << 10 | block[2 * i + 1] << 2 | block[6] >> (6 - 2 * i) & 3)
                - (1 << 17) for i in range(3)]


class Mmc5603(Mmc5983ma):
    """MMC5603NJ magnetometer; the module describes its timing, axes and scale."""

    IDENTITY = ((0x39, 0x10),)
    NAME = 'mmc5603'
    STATUS, DONE, CONTROL_0, CONTROL_1 = 0x18, 0x40, 0x1B, 0x1C
    BANDWIDTHS = {6.6: 0, 3.5: 1, 2.0: 2, 1.2: 3}
    SOFT_RESET_S = 0.025
    FULL_SCALE = 30 * 16384
    N_BYTES = 9

    @staticmethod
    def _counts(block: bytes) -> list[int]:
        """Signed counts from a block: 16 bits per axis, then one byte per axis with 4 low bits."""
        return [(block[2 * i] << 12 | block[2 * i + 1] << 4 | block[6 + i] >> 4) - (1 << 19)
                for i in range(3)]


def _conversion(middle_ns: int, counts: Axes) -> chip.Conversion:
    x, y, z = (c / COUNTS_PER_TESLA for c in counts)
    return chip.Conversion(middle_ns, (x, y, z))
