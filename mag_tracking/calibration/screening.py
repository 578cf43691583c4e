"""Rejection of faulty readings of one sensor: spikes, and repetitions by a stuck sensor.

A suspect reading is held until the next readings permit a decision. Other readings pass
immediately. The rules are compiled: `screening.hpp`.
"""

from mag_tracking.arrays import Record
from mag_tracking.calibration import core
from mag_tracking.units import NEVER

MIN_CHANGES = core.MIN_CHANGES
"""Minimum number of changes before a sensor can be stuck; with fewer changes, its steps may be so
coarse that long repetitions are normal."""
COARSE_FRACTION = core.COARSE_FRACTION
"""Fraction of repeated readings above which the steps of a sensor are coarse: at rest, it may
repeat a reading indefinitely. With a noise of one step or more on three axes, the fraction is
lower."""

PASSES, HELD, SPIKE, RELEASED = core.PASSES, core.HELD, core.SPIKE, core.RELEASED
"""Verdicts: the reading passes; the reading is held; the held readings are a spike; the held
readings and the current reading pass."""


def clear_spikes(sensor: Record) -> None:
    """Reset spike detection: discard the previous and the held readings."""
    sensor['before_ns'], sensor['n_steps'] = NEVER, 0
    sensor['n_held'] = sensor['n_released'] = 0
