"""Faulty readings of one sensor: spikes, and a sensor that is stuck.

Only a suspect reading is held until the next ones decide; all others pass at once. The rules are
compiled: `screening.hpp`.
"""

from mag_tracking.arrays import Record
from mag_tracking.calibration import core
from mag_tracking.units import NEVER

MIN_CHANGES = core.MIN_CHANGES
"""A sensor that has changed less often may have steps so coarse that it repeats itself for long."""
COARSE = core.COARSE
"""A sensor that repeats itself more often has steps so coarse that at rest it may do so for ever;
with a noise of one step or more, on three axes, the share is below this."""

PASSES, HELD, SPIKE, RELEASED = core.PASSES, core.HELD, core.SPIKE, core.RELEASED
"""A reading passes; it is held; what was held is a spike; the held readings and this one pass."""


def clear_spikes(sensor: Record) -> None:
    """Forget the readings before, and those that are held."""
    sensor['before_ns'], sensor['n_steps'] = NEVER, 0
    sensor['n_held'] = sensor['n_released'] = 0
