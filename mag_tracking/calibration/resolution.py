"""Resolution of a sensor: the quantisation steps of its readings and the resulting error.

If the steps exceed the noise, a reading is constant while the field changes by up to a step.
Averaging does not remove that error, and a repeated reading adds little information. The operations
on every reading are compiled: `resolution.hpp`.
"""

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.records import plain

MAX_ROUNDING = core.MAX_ROUNDING
"""Maximum relative difference of two values that is due to rounding (single precision)."""

MIN_STD = core.MIN_STD
"""[T] Minimum standard deviation of the readings of an axis that is not constant."""

TOGGLE_TOLERANCE = core.TOGGLE_TOLERANCE
"""[steps] Tolerance of an axis at rest, which may toggle between two adjacent values."""


def corrected_steps(sensors: StructArray) -> FloatArray:
    """Quantisation steps (3,) T after soft-iron correction; 0 if too fine, inf if unchanged."""
    return core.steps_of(sensors, True)


def raw_steps(sensors: StructArray) -> FloatArray:
    """Quantisation steps (3,) T before soft-iron correction; 0 if too fine, inf if unchanged."""
    return core.steps_of(sensors, False)


def completed_steps(variance: FloatArray, steps: FloatArray) -> FloatArray:
    """Replace unknown steps (3,) T by those of other axes at rest; NaN for a dead axis.

    An axis that has never changed is dead if another axis of the sensor changes with every reading.
    If no axis has changed, all may be at rest: inf. `variance` (3,) in T² is that of quiet
    readings.
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
        change = change[change > MAX_ROUNDING * np.abs(values[1:])]
        out[axis] = change.min(initial=np.inf)
    return out
