"""State of each sensor that changes with every reading: one structured array for all sensors.

Compiled code reads and writes it reading by reading, Python block by block.
"""

import numpy as np

from mag_tracking.arrays import StructArray
from mag_tracking.calibration import core
from mag_tracking.units import NEVER

RECENT = core.RECENT
"""Differences between consecutive readings that a spike is compared with."""
MAX_HELD = core.MAX_HELD
"""A spike has at most so many readings; what lasts longer is a step."""

SENSOR = core.SENSOR
"""State of one sensor, in [T] and [s], or [ns] where the name says so; `sensor.hpp` has it."""


def new_sensors(n: int) -> StructArray:
    """(n,) SENSOR without any reading."""
    sensors = np.zeros(n, SENSOR)
    for name in ('first_ns', 'last_ns', 'unconfirmed_ns', 'before_ns'):
        sensors[name] = NEVER
    for name in ('last', 'before', 'end', 'noise_std', 'noise', 'raw', 'stated_std'):
        sensors[name] = np.nan
    sensors['step'], sensors['n_averaged'] = np.inf, 1.0
    return sensors
