"""Sensor state that is updated with every reading, in one structured array for all sensors.

Compiled code accesses it for each reading, Python for each block.
"""

import numpy as np

from mag_tracking.arrays import StructArray
from mag_tracking.calibration import core
from mag_tracking.units import NEVER

N_RECENT = core.N_RECENT
"""Number of differences between consecutive readings that a spike is compared with."""
MAX_HELD = core.MAX_HELD
"""Maximum number of readings of a spike; a longer change is a step."""

N_WINDOW = core.N_WINDOW
"""Number of raw readings in which faults of the driver are searched."""
FIRST_WINDOW = 64
"""Number of raw readings between the searches in the first `N_WINDOW` readings of a sensor."""

SENSOR = core.SENSOR
"""Data type of the state of one sensor, defined in `sensor.hpp`. Values are in [T] and [s], or in
[ns] if the name ends with `_ns`."""


def new_sensors(n: int) -> StructArray:
    """Create the state of `n` sensors without any reading, (n,) SENSOR array."""
    sensors = np.zeros(n, SENSOR)
    for name in ('first_ns', 'last_ns', 'unconfirmed_ns', 'before_ns'):
        sensors[name] = NEVER
    for name in ('last', 'before', 'end', 'noise_std', 'noise', 'raw', 'stated_std', 'latest'):
        sensors[name] = np.nan
    sensors['step'], sensors['n_averaged'] = np.inf, 1.0
    sensors['window_due'], sensors['repetition'] = FIRST_WINDOW, 1.0
    return sensors
