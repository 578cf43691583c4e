"""Causes and numbers of the readings that the calibration rejects; validity of covariances."""

from collections import Counter
from collections.abc import Iterable

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration import core
from mag_tracking.inference.covariances import are_valid_covariances
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
}
"""Cause and description of the rejection for each reason code, except descriptions with a value."""


def own_covariances(readings: Readings) -> tuple[IntArray, FloatArray]:
    """Validity (NONE, VALID or INVALID) and covariance of each reading.

    The covariances are an empty array if the readings have none.
    """
    if readings.covariance is None:
        return np.zeros(len(readings), dtype=np.int64), np.empty((0, 3, 3))
    C = plain(readings.covariance)
    valid = np.where(are_valid_covariances(plain(readings.field), C), core.VALID, core.INVALID)
    return np.where(readings.has_unknown_covariance(), core.NONE, valid), C


class Rejections:
    """Numbers of the rejected readings of several sensors."""

    def __init__(self, names: Iterable[str]) -> None:
        self._n: dict[str, Counter[tuple[Cause, str]]] = {name: Counter() for name in names}

    def add(self, sensor: str, cause: tuple[Cause, str], n: int) -> None:
        """Add `n` rejected readings."""
        self._n[sensor][cause] += n

    def of(self, sensor: str) -> 'Counter[tuple[Cause, str]]':
        """Numbers of a sensor, by cause and description."""
        return self._n[sensor].copy()

    def counts_of(self, sensor: str) -> 'Counter[str]':
        """Numbers of a sensor, in total (`rejected`) and by description (`rejected: ...`)."""
        counts = {f'rejected: {description}': n for (_, description), n in self._n[sensor].items()}
        return Counter(counts) + Counter(rejected=self._n[sensor].total())
