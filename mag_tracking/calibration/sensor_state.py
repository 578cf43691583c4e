"""State of the sensors that compiled code updates with every reading, and their quantisation steps.

If the steps of a sensor exceed its noise, a reading is constant while the field changes by up to a
step, so that repeated readings are not independent (`resolution.hpp`).
"""

import numpy as np

from mag_tracking.arrays import FloatArray, Record, StructArray
from mag_tracking.calibration import core
from mag_tracking.records import plain
from mag_tracking.units import NEVER

N_WINDOW, MIN_CHANGES, COARSE_FRACTION = core.N_WINDOW, core.MIN_CHANGES, core.COARSE_FRACTION
"""Number of raw readings in which faults of the driver are searched; minimum number of changes, and
minimum fraction of repetitions, of a sensor that is stuck, or coarse (`screening.hpp`)."""
FIRST_WINDOW = 64
"""Number of raw readings between the searches in the first `N_WINDOW` readings of a sensor."""


def new_sensors(n: int) -> StructArray:
    """Create the state of `n` sensors without any reading, (n,) SENSOR array of `sensor.hpp`."""
    sensors = np.zeros(n, core.SENSOR)
    for name in ('first_ns', 'last_ns', 'unconfirmed_ns', 'before_ns'):
        sensors[name] = NEVER
    for name in ('last', 'before', 'end', 'noise_std', 'noise', 'raw', 'stated_std', 'latest'):
        sensors[name] = np.nan
    sensors['step'], sensors['n_averaged'] = np.inf, 1.0
    sensors['window_due'], sensors['repetition'] = FIRST_WINDOW, 1.0
    return sensors


def clear_spikes(sensor: Record) -> None:
    """Reset spike detection: discard the previous and the held readings."""
    sensor['before_ns'], sensor['n_steps'] = NEVER, 0
    sensor['n_held'] = sensor['n_released'] = 0


def corrected_steps(sensors: StructArray) -> FloatArray:
    """Quantisation steps (3,) T after soft-iron correction; 0 if too fine, inf if unchanged."""
    return core.steps_of(sensors, True)


def completed_steps(variance: FloatArray, steps: FloatArray) -> FloatArray:
    """Replace unknown steps (3,) T by those of other axes at rest; NaN for a dead axis.

    An axis that has never changed is dead if another axis of the sensor changes with every reading.
    `variance` (3,) in T² is that of quiet readings.
    """
    out = plain(steps).copy()
    core.complete_steps(plain(variance), out)
    return out


def smallest_steps(fields: FloatArray) -> FloatArray:
    """Smallest non-zero change (3,) T between consecutive readings (n, 3); inf if none."""
    out = np.full(3, np.inf)
    for axis, values in enumerate(fields.T):
        values = values[~np.isnan(values)]
        change = np.abs(np.diff(values))
        change = change[change > core.MAX_ROUNDING * np.abs(values[1:])]
        out[axis] = change.min(initial=np.inf)
    return out
