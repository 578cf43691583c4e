"""Resolution of a sensor: the steps of its readings, and the error that they add to the noise.

Where the steps are larger than the noise, a reading stays the same while the field moves by up to a
step. Averaging does not remove that error, and a reading that repeats the one before adds little.
What is done for every reading is compiled: `resolution.hpp`.
"""

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.records import plain

SAME = core.SAME
"""Values that differ by a smaller share than this differ by rounding only: single precision."""

MIN_STD = core.MIN_STD
"""[T] An axis that scatters less has not changed at all."""

TOGGLE = core.TOGGLE
"""[steps] An axis that rests on one value may rest on the next one a moment later."""


def corrected_steps(sensors: StructArray) -> FloatArray:
    """Steps of a sensor's axes after the soft-iron correction.

    Parameters
    ----------
    sensors : (1,) SENSOR

    Returns
    -------
    (3,) array, T
        0 where they are too fine to be seen, inf where the axis has never changed.
    """
    return core.steps_of(sensors, True)


def raw_steps(sensors: StructArray) -> FloatArray:
    """As `corrected_steps`, before the correction."""
    return core.steps_of(sensors, False)


def completed_steps(variance: FloatArray, steps: FloatArray) -> FloatArray:
    """Steps of all axes; one that is not known yet is that of the others if those rest, too.

    An axis that has never changed is dead where another one of the same sensor changes with every
    reading. It may rest where none has changed so far.

    Parameters
    ----------
    variance : (3,) array, T^2
        Scatter of quiet readings; NaN = missing axis.
    steps : (3,) array, T
        As of `corrected_steps`.

    Returns
    -------
    (3,) array, T
        NaN of a dead axis; inf where none has changed.
    """
    out = plain(steps).copy()
    core.complete_steps(plain(variance), out)
    return out


def smallest_steps(fields: FloatArray) -> FloatArray:
    """Smallest change between consecutive readings of each axis.

    Parameters
    ----------
    fields : (n, 3) array, T
        In order of time; NaN = missing.

    Returns
    -------
    (3,) array, T
        inf where an axis has never changed.
    """
    out = np.full(3, np.inf)
    for axis, values in enumerate(fields.T):
        values = values[~np.isnan(values)]
        change = np.abs(np.diff(values))
        change = change[change > SAME * np.abs(values[1:])]
        out[axis] = change.min(initial=np.inf)
    return out
