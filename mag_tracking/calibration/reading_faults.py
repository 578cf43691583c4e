"""Faults of a driver that are visible in the raw readings: marks and regular repetitions."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration import core
from mag_tracking.calibration.missing_marks import are_marked, missing_marks
from mag_tracking.calibration.repetition import changes_of, repetition_of, with_lost_readings

MAX_MARKS = core.MAX_MARKS
"""Maximum number of different marks of a sensor."""


@dataclass(frozen=True)
class ReadingFaults:
    """Marks for missing readings, and the regular repetition of readings."""

    marks: FloatArray
    """(k, 3) T; NaN for an axis that a mark does not concern. See `missing_marks`."""
    repetition: float
    """Readings per measurement; 1 if every reading is measured. See `repetition_of`."""
    rate: float = float('nan')
    """Rate [Hz] of the readings, including the repetitions; NaN if unknown."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ReadingFaults) and self.repetition == other.repetition \
            and np.array_equal(self.marks, other.marks, equal_nan=True)

    def __bool__(self) -> bool:
        return len(self.marks) > 0 or self.repetition > 1.0

    def merged(self, latest: 'ReadingFaults') -> 'ReadingFaults':
        """Add the marks, or the repetition, found in later readings."""
        marks = [*self.marks, *(mark for mark in latest.marks if not any(
            np.array_equal(mark, known, equal_nan=True) for known in self.marks))]
        return ReadingFaults(np.array(marks[:MAX_MARKS]).reshape(-1, 3),
                             self.repetition if self.repetition > 1.0 else latest.repetition,
                             latest.rate)

    def without(self, fields: FloatArray) -> FloatArray:
        """Chronological raw readings (n, 3) in T, with marks and repetitions replaced by NaN."""
        out: FloatArray = np.where(are_marked(fields, self.marks), np.nan, fields)
        if self.repetition > 1.0:
            present = np.flatnonzero(~np.isnan(out).all(axis=1))
            out[present[~changes_of(out[present])]] = np.nan
        return out


NO_FAULTS = ReadingFaults(np.zeros((0, 3)), 1.0)
"""Readings of a sensor without these faults."""


def reading_faults(fields: FloatArray, stamps: IntArray | None = None) -> ReadingFaults:
    """Find marks and repetitions in chronological raw readings (n, 3) in T, NaN for a missing axis.

    The timestamps (n,) in ns show where readings were lost.
    """
    marks = missing_marks(fields)
    kept = np.where(are_marked(fields, marks), np.nan, fields)
    return ReadingFaults(marks, repetition_of(
        kept if stamps is None else with_lost_readings(kept, stamps)))
