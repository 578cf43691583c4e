"""Causes for which the calibration rejects readings, and faults of drivers."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray, StructArray
from mag_tracking.calibration import core, reading_faults
from mag_tracking.calibration.sensor_state import FIRST_WINDOW, N_WINDOW
from mag_tracking.inference.covariances import are_valid_covariances
from mag_tracking.records import Readings, plain
from mag_tracking.stages.health.diagnosis import Cause
from mag_tracking.units import NS

MAX_MARKED = 0.2
"""Fraction of readings with a mark above which a background is learnt again when they are found."""
MAX_SKIPPED = 3
"""Maximum number of consecutive windows without a jump that are not searched, to save time. Only a
repetition could be found there, which lasts."""
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
    """Validity of each reading, and the covariances, empty if there are none."""
    if readings.covariance is None:
        return np.zeros(len(readings), dtype=np.int64), np.empty((0, 3, 3))
    C = plain(readings.covariance)
    valid = np.where(are_valid_covariances(plain(readings.field), C), core.VALID, core.INVALID)
    return np.where(readings.has_unknown_covariance(), core.NONE, valid), C


class DriverFaults:
    """Marks for missing readings, and repetitions, in raw readings; the compiled code leaves out
    those that are stored in `sensors`, a (n,) SENSOR array."""

    def __init__(self, names: Sequence[str], sensors: StructArray) -> None:
        self._states = dict(zip(names, sensors, strict=True))
        # Rate of the readings of each sensor [Hz] when its faults were found.
        self._rates = dict.fromkeys(names, float('nan'))
        # Change of an axis that is no jump to a mark (3,) [T], and number of windows skipped.
        self._max_changes: dict[str, FloatArray] = {}
        self._n_skipped = dict.fromkeys(names, 0)

    def of(self, sensor: str) -> reading_faults.ReadingFaults:
        """Faults of a sensor that have been found so far."""
        s = self._states[sensor]
        return reading_faults.ReadingFaults(
            s['marks'][:s['n_marks']].copy(), float(s['repetition']), self._rates[sensor])

    def n_marked(self, sensor: str) -> int:
        """Number of readings of a sensor with a mark for a missing reading on any axis."""
        return int(self._states[sensor]['n_marked'])

    def store(self, sensor: str, faults: reading_faults.ReadingFaults) -> None:
        """Leave out faults of a sensor from now on."""
        s, self._rates[sensor] = self._states[sensor], faults.rate
        s['n_marks'], s['marks'][:len(faults.marks)] = len(faults.marks), faults.marks
        s['repetition'] = faults.repetition
        # The steps and repetitions so far are those of the faults.
        s['step'] = np.inf
        s['n_same'] = s['n_changed'] = s['n_rest'] = 0
        s['repeats'] = s['changes'] = s['run'] = 0

    def examine(self, sensor: str, stamp_ns: int) -> float:
        """Search the latest raw readings before `stamp_ns`; return the fraction of readings with a
        mark if a fault was found and stored, otherwise NaN."""
        s, known = self._states[sensor], self.of(sensor)
        n = int(s['n_window'])
        if n == N_WINDOW and self._may_skip(sensor, s['window']):
            s['n_window'] = 0
            return float('nan')
        faults = known.merged(reading_faults.reading_faults(s['window'][:n], s['window_ns'][:n]))
        if n < N_WINDOW:
            s['window_due'] += FIRST_WINDOW
        else:
            s['n_window'] = self._n_skipped[sensor] = 0
        if faults == known:
            if n == N_WINDOW and not known:
                limits = reading_faults.MIN_JUMP * np.array(
                    [reading_faults.typical_change(values) for values in s['window'].T])
                self._max_changes[sensor] = np.minimum(
                    limits, self._max_changes.get(sensor, np.inf))
            return float('nan')
        duration_s = (stamp_ns - int(s['window_ns'][0])) / NS
        n_published = len(reading_faults.with_lost_readings(s['window'][:n], s['window_ns'][:n]))
        rate = n_published / duration_s if duration_s > 0.0 else float('nan')
        self.store(sensor, replace(faults, rate=rate))
        return float(reading_faults.are_marked(s['window'][:n], faults.marks).any(axis=1).mean())

    def _may_skip(self, sensor: str, fields: FloatArray) -> bool:
        """Whether a window (n, 3) [T] need not be searched; counts the windows skipped."""
        max_changes = self._max_changes.get(sensor)
        if max_changes is None or self._n_skipped[sensor] >= MAX_SKIPPED \
                or (np.abs(np.diff(fields, axis=0)) > max_changes).any():
            return False
        self._n_skipped[sensor] += 1
        return True

    def rejection(self, sensor: str, reason: int) -> tuple[Cause, str]:
        """Cause and description of a rejection; `reason` is MARKED or REPEATED."""
        faults = self.of(sensor)
        if reason == core.MARKED:
            return (Cause.NO_READING_MARK,
                    f'mark for a missing reading: {reading_faults.describe_marks(faults.marks)}')
        return Cause.REPEATED, (
            f'repetition: measured at {faults.rate / faults.repetition:.3g} Hz, published at '
            f'{faults.rate:.3g} Hz')
