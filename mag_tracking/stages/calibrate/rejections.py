"""Causes for which readings are rejected, and the validity of covariances in messages."""

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration import core
from mag_tracking.inference.axes import are_valid_covariances
from mag_tracking.records import Readings, plain
from mag_tracking.stages.health.diagnosis import Cause

REJECTIONS = {
    core.NO_AXIS: (Cause.NO_AXIS, 'no axis reported (all NaN)'),
    core.INFINITE: (Cause.INFINITE, 'infinite value'),
    core.BAD_COVARIANCE: (Cause.WRONG_COVARIANCE, 'covariance is not positive definite'),
    core.AXIS_MISSING: (Cause.MISSING_AXIS, 'an axis that the correction needs is missing'),
    core.TOO_FAR_AHEAD: (Cause.TOO_FAR_AHEAD, 'timestamp too far ahead'),
    core.DUPLICATE: (Cause.DUPLICATE_STAMPS, 'duplicate timestamp'),
    core.OUT_OF_ORDER: (Cause.BACKWARD_STAMPS, 'out of order'),
    core.STUCK: (Cause.STUCK, 'stuck sensor (repeated reading)'),
    core.MARKED: (Cause.NO_READING_MARK, 'mark for a missing reading'),
    core.REPEATED: (Cause.REPEATED, 'repetition of the previous reading'),
}
"""Cause and description of the rejection for each reason code; `TOO_LARGE` depends on a setting."""


def own_covariances(readings: Readings) -> tuple[IntArray, FloatArray]:
    """Covariances of readings, and whether they are valid.

    Parameters
    ----------
    readings : Readings

    Returns
    -------
    validity : (n,) int array
        NONE, VALID or INVALID; all NONE if the readings have no covariances.
    covariance : (n, 3, 3) array, T²
        Empty if the readings have no covariances.
    """
    if readings.covariance is None:
        return np.zeros(len(readings), dtype=np.int64), np.empty((0, 3, 3))
    C = plain(readings.covariance)
    valid = np.where(are_valid_covariances(plain(readings.field), C), core.VALID, core.INVALID)
    return np.where(readings.has_unknown_covariance(), core.NONE, valid), C
