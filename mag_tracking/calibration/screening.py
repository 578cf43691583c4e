"""Rejection of faulty readings of one sensor: spikes and stuck sensors.

Only a suspect reading is held until the next ones decide; all others pass at once. The rules are
compiled: `screening.hpp`.
"""

from mag_tracking.arrays import Record
from mag_tracking.calibration import core
from mag_tracking.units import NEVER

MIN_CHANGES = core.MIN_CHANGES
"""Minimum number of changes of a sensor; with fewer, its steps may be so coarse that it repeats
itself for long."""
COARSE = core.COARSE
"""Share of repeated readings above which the steps of a sensor are coarse, so that it may repeat
itself indefinitely at rest. With a noise of one step or more on three axes, the share is lower."""

PASSES, HELD, SPIKE, RELEASED = core.PASSES, core.HELD, core.SPIKE, core.RELEASED
"""Verdicts: the reading passes; it is held; the held readings are a spike; the held readings and
this one pass."""


def clear_spikes(sensor: Record) -> None:
    """Discard the previous and the held readings.

    Parameters
    ----------
    sensor : SENSOR record
    """
    sensor['before_ns'], sensor['n_steps'] = NEVER, 0
    sensor['n_held'] = sensor['n_released'] = 0
