"""Resolution of a sensor: the quantisation steps of its readings and the resulting error.

If the steps are larger than the noise, a reading is constant while the field changes by up to a
step. Averaging does not remove that error, and a repeated reading adds little information. The
operations on every reading are compiled: `resolution.hpp`.
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
    """Quantisation steps of a sensor's axes after the soft-iron correction.

    Parameters
    ----------
    sensors : (1,) SENSOR array

    Returns
    -------
    (3,) array, T
        0 if the steps are too fine to be observed, inf if the axis has never changed.
    """
    return core.steps_of(sensors, True)


def raw_steps(sensors: StructArray) -> FloatArray:
    """Quantisation steps of a sensor's axes before the soft-iron correction.

    Parameters
    ----------
    sensors : (1,) SENSOR array

    Returns
    -------
    (3,) array, T
        0 if the steps are too fine to be observed, inf if the axis has never changed.
    """
    return core.steps_of(sensors, False)


def completed_steps(variance: FloatArray, steps: FloatArray) -> FloatArray:
    """Replace unknown steps by the steps of other axes at rest.

    An axis that has never changed is dead if another axis of the same sensor changes with every
    reading. If no axis has changed, all axes may be at rest.

    Parameters
    ----------
    variance : (3,) array, T²
        Variance of quiet readings; NaN for a missing axis.
    steps : (3,) array, T
        From `corrected_steps`.

    Returns
    -------
    (3,) array, T
        NaN for a dead axis; inf if no axis has changed.
    """
    out = plain(steps).copy()
    core.complete_steps(plain(variance), out)
    return out


def smallest_steps(fields: FloatArray) -> FloatArray:
    """Smallest non-zero change between consecutive readings of each axis.

    Parameters
    ----------
    fields : (n, 3) array, T
        Readings in chronological order; NaN for a missing axis.

    Returns
    -------
    (3,) array, T
        Infinite if an axis has never changed.
    """
    out = np.full(3, np.inf)
    for axis, values in enumerate(fields.T):
        values = values[~np.isnan(values)]
        change = np.abs(np.diff(values))
        change = change[change > MAX_ROUNDING * np.abs(values[1:])]
        out[axis] = change.min(initial=np.inf)
    return out
