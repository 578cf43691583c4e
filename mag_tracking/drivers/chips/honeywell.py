"""Honeywell HMC5883L and HMC5983: anisotropic magnetoresistive bridges, 12 bits.

Each reading starts a conversion. The timestamp is the middle of the conversion, 3 ms after the
start, with an uncertainty of about 1 ms.

Axes: as drawn in the data sheets, right-handed, in registers X, Z, Y; NaN over the range.

Scale: 73, 92, 122, 152, 227, 256, 303, 435 nT per count for ranges of ±88, 130, 190, 250, 400, 470,
560, 810 µT. The noise is about 200 nT. The offset may be tens of microtesla and drifts with
temperature. The HMC5983 is configured to correct its scale for temperature.

Chips sold as HMC5883L are often QMC5883L, which answer at 0x0d and are not supported. An LSM303DLHC
has the same address, identity and registers, but other gains: 1100, 855, 670, 450, 400, 330, 230
counts per gauss on x and y, and 980, 760, 600, 400, 355, 295, 205 on z, for the ranges from ±130 µT
on. Its z axis therefore reads 11 % less than x and y. The CircuitPython class LSM303DLH_Mag has the
gains of that chip.

Sources: HMC5883L data sheet 900405 Rev E (2013), tables 2 to 21; HMC5983 data sheet 900425 (2012),
whose registers differ in bit 7 of configuration register A; LSM303DLHC data sheet, ST DocID018771,
register CRB_REG_M.
"""

import errno
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from mag_tracking.drivers.chips import chip
from mag_tracking.settings import param

CONFIGURATION_A, CONFIGURATION_B, MODE = 0x00, 0x01, 0x02
SINGLE_MEASUREMENT = 0x01
CONVERSION_S = 6e-3
OVERFLOW = -4096
GAINS = {88.0: 1370, 130.0: 1090, 190.0: 820, 250.0: 660,
         400.0: 440, 470.0: 390, 560.0: 330, 810.0: 230}
"""{range [µT]: counts per gauss}, in the order of the gain codes of configuration register B."""


@dataclass(frozen=True)
class Hmc5883lSettings:
    """Settings of an HMC5883L or HMC5983 on I2C."""

    range_ut: float = param(
        190.0, 'Measurement range of an axis: 88, 130, 190, 250, 400, 470, 560 or 810.', 'uT',
        (88.0, 810.0))


class Hmc5883l(chip.Chip):
    """HMC5883L magnetometer; the module describes its timing, axes and scale."""

    IDENTITY = ((0x0A, ord('H')), (0x0B, ord('4')), (0x0C, ord('3')))
    NAME = 'hmc5883l'
    CONFIGURATION = 0x10
    """Configuration register A: one sample per measurement, no bias; the rate has no effect."""

    def __init__(self, registers: chip.Registers, settings: Hmc5883lSettings,
                 count: Callable[[str], None]) -> None:
        super().__init__(registers, settings, count)
        self._gain = chip.look_up_choice(f'{self.NAME}.range_ut', settings.range_ut, GAINS)
        self._gain_bits = list(GAINS).index(settings.range_ut) << 5

    def set_up(self) -> None:
        """Configure the chip."""
        self._registers.write(CONFIGURATION_A, self.CONFIGURATION)
        self._registers.write(CONFIGURATION_B, self._gain_bits)
        # The first measurement after a change of the gain still uses the old gain.
        self._registers.write(MODE, SINGLE_MEASUREMENT)
        self._registers.sleep(CONVERSION_S * chip.CONVERSION_MARGIN)

    def measure(self) -> chip.Measurement:
        """Make a single measurement, None if it is not finished in time."""
        self._registers.write(MODE, SINGLE_MEASUREMENT)
        start_ns = self._registers.monotonic_ns()
        yield CONVERSION_S * chip.CONVERSION_MARGIN
        configuration, gain_bits, mode, x, z, y = struct.unpack(
            '>BBBhhh', self._registers.read_block(CONFIGURATION_A, 9))
        if configuration != self.CONFIGURATION or gain_bits != self._gain_bits:
            raise OSError(errno.EIO, 'the chip lost its settings; check its power supply')
        # The chip becomes idle when the conversion is finished. Its RDY bit does not indicate a
        # new conversion, because it remains set from one conversion to the next.
        if mode & 0x03 == SINGLE_MEASUREMENT:
            return None
        x, y, z = (math.nan if c == OVERFLOW else c / self._gain * 1e-4 for c in (x, y, z))
        return chip.Conversion(start_ns + round(CONVERSION_S * 1e9) // 2, (x, y, z))


class Hmc5983(Hmc5883l):
    """HMC5983 magnetometer: an HMC5883L with temperature compensation."""

    NAME = 'hmc5983'
    CONFIGURATION = 0x90
