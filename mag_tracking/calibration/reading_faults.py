"""Faults that are visible in the raw readings: marks, regular repetitions and saturation.

Marks for missing readings are values that a driver publishes when it has no reading: 0, 99999, the
end of the range, the largest number of a type. A mark is entered and left by a jump, and always has
exactly the same value, which noise prevents for readings.

A driver that publishes readings faster than its sensor measures repeats each of them a regular
number of times. A sensor with coarse steps also repeats readings at rest, but at random.

The limit of the range cuts the peak off an excursion: several equal readings, far from the level
at rest, between steep flanks. Other peaks are round, and noise makes equal readings rare.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration import core

MIN_READINGS, MIN_OTHERS = 3, 12
"""Minimum number of readings with the value of a mark, and of other readings of the axis."""
MIN_JUMP = 30.0
"""Minimum difference between a mark and its neighbours, in standard deviations or steps."""
MIN_ISOLATION = 10.0
"""Minimum difference of a mark, or of an isolated reading (a bus error), from its neighbours,
relative to the changes next to it."""
MIN_ISOLATED = 0.5
"""Minimum fraction of the occurrences that are isolated; during a pass they are not."""
MIN_COARSE = 0.5
"""Fraction of repeated readings above which the value of a reading at rest is no coincidence."""
MAX_PLAUSIBLE = 1.5
"""Minimum ratio of such a mark, unless zero or equal on all axes, to the largest median."""
MIN_TOGETHER = 0.9
"""Minimum fraction of the occurrences of a mark in which another axis has a mark as well."""
LARGEST = 1e30
"""[T] Limit to which values are clipped, so that differences do not overflow."""

MIN_REPETITION, MAX_REPETITION = 1.2, 40.0
"""Minimum and maximum readings per measurement; timing jitter causes fewer repetitions."""
MIN_LOG_ODDS = 24.0
"""Minimum significance of the regularity; random repetitions reach it with probability exp(-24)."""
MIN_RESULTANT = 0.85
"""Minimum regularity of the changes, relative to a perfectly regular source."""
MAX_JITTER = 0.2
"""Maximum deviation of an interval from a multiple of the median interval, relative to it."""
MIN_REGULAR = 0.9
"""Minimum fraction of the intervals with less jitter, to know where readings were lost."""
MAX_LOST = 2.0
"""Maximum ratio of all readings, including lost ones, to the received readings."""
OVERSAMPLING = 4
"""Oversampling of the frequencies at which the regularity is evaluated."""

MIN_RUN = 3
"""Minimum number of consecutive equal readings at the limit of a saturated axis."""
MAX_RUN = 50.0
"""Default maximum number of readings for which a single excursion stays at the limit."""
MIN_DISTANCE = 4.0
"""Minimum distance of the limit from the level at rest, in standard deviations or steps."""
N_FLANK = 3
"""Number of readings next to the limit from which the steepness of the flanks is determined."""
MIN_NOISE_RATIO = 8.0
"""Minimum height of a flank in standard deviations of the noise."""
MAX_FLATNESS = 4
"""Exponent of the flattest peak that is not cut off; the peak of a pass is a parabola."""
MAX_ENTRY = 0.7
"""Maximum jump from the nearest flank reading to the limit, relative to that from rest."""
MIN_LOG_PROBABILITY = np.log(1e-9)
"""Log-probability of equal readings below which they are not due to chance."""
N_MARGIN = 6
"""Number of readings excluded beside each saturated reading, some of which are cut off, too."""


def missing_marks(fields: FloatArray) -> FloatArray:
    """Find the marks (k, 3) among chronological raw readings (n, 3) in T; values of several axes
    that always occur together are one mark, NaN for the other axes."""
    fields = np.where(np.isinf(fields), np.nan, fields)
    marks_of_axis = [_marks_of_axis(fields, axis) for axis in range(3)]
    if not any(marks_of_axis):
        return np.zeros((0, 3))
    changes = np.abs(np.diff(np.clip(fields, -LARGEST, LARGEST), axis=0, prepend=np.nan))
    is_jump = changes > MIN_JUMP * np.array([typical_change(values) for values in fields.T])
    # By bytes, because NaN differs from NaN.
    marks: dict[bytes, FloatArray] = {}
    for axis, of_axis in enumerate(marks_of_axis):
        for mark in of_axis:
            is_mark, vector = fields[:, axis] == mark, np.full(3, np.nan)
            for b in range(3):
                # A background close to zero does not stand out from a mark of zero.
                vector[b] = next((v for v in (mark, *marks_of_axis[b])
                                  if np.mean(fields[is_mark, b] == v) > MIN_TOGETHER), np.nan)
            # Where other axes jump to other values, an equal value is a coincidence.
            if not (np.mean(is_jump[is_mark], axis=0) > MIN_ISOLATED)[np.isnan(vector)].any():
                marks[vector.tobytes()] = vector
    return np.array(list(marks.values())).reshape(-1, 3)


def are_marked(fields: FloatArray, marks: FloatArray) -> BoolArray:
    """Axes (n, 3) of fields that hold a mark of `missing_marks`."""
    found = np.zeros(fields.shape, dtype=bool)
    for mark in marks:
        concerned = ~np.isnan(mark)
        found |= (fields == mark)[:, concerned].all(axis=1)[:, None] & concerned
    return found


def describe_marks(marks: FloatArray) -> str:
    """Format marks (k, 3) in T, with axis names unless a mark concerns all axes."""
    texts = []
    for mark in marks.tolist():
        values = [(f'{axis} = ', v) for axis, v in zip('xyz', mark, strict=True) if not np.isnan(v)]
        if len(values) == 3 and len({v for _, v in values}) == 1:
            values = [('', values[0][1])]
        texts.append(', '.join(axis + (f'{1e9 * v:.6g} nT' if abs(v) < 1.0 else f'{v:.6g} T')
                               for axis, v in values))
    return ' or '.join(texts)


def _marks_of_axis(fields: FloatArray, axis: int) -> list[float]:
    """Marks of one axis."""
    fields = fields[~np.isnan(fields[:, axis])]
    marks: list[float] = []
    while True:
        runs, jumps, lengths = _isolated_runs(fields[:, axis])
        candidates, index = np.unique(runs, return_inverse=True)
        n = np.bincount(index, lengths, len(candidates)).astype(int)
        mark = next((float(candidates[k]) for k in np.argsort(-n) if n[k] >= MIN_READINGS
                     and _is_mark(fields, axis, candidates[k],
                                  float(np.median(jumps[index == k])), n[k])), None)
        if mark is None:
            return marks
        marks.append(mark)
        fields = fields[fields[:, axis] != mark]


def _isolated_runs(values: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Runs of equal values that are entered and left by a jump: values, jumps, and lengths."""
    starts = np.flatnonzero(np.append(True, values[1:] != values[:-1])[:len(values)])
    if len(starts) < 3:
        return np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.int64)
    # A neighbour of a run is compared with both runs on its other side, because the nearest one may
    # be another occurrence of the mark.
    before3, before2, before, run, after, after2, after3 = np.lib.stride_tricks.sliding_window_view(
        np.pad(np.clip(values[starts], -LARGEST, LARGEST), 3, 'edge'), 7).T
    jump = np.minimum(np.abs(run - before), np.abs(run - after))
    change_after = np.minimum(np.abs(after - after2), np.abs(after - after3))
    change = np.maximum.reduce([
        np.abs(after - before), np.minimum(np.abs(before - before2), np.abs(before - before3)),
        change_after])
    # The reading before the first run is unknown; the last run may continue.
    jump[0], change[0] = np.abs(run - after)[0], change_after[0]
    is_isolated = jump > MIN_ISOLATION * change
    is_isolated[-1] = False
    lengths = np.diff(np.append(starts, len(values)))
    return values[starts][is_isolated], jump[is_isolated], lengths[is_isolated]


def typical_change(values: FloatArray) -> float:
    """Median of the changes of an axis (n,), without repetitions; 0 if there are none."""
    changes = np.abs(np.diff(np.clip(values, -LARGEST, LARGEST)))
    return float(np.median(changes[changes > 0.0])) if (changes > 0.0).any() else 0.0


def _is_mark(fields: FloatArray, axis: int, value: float, jump: float, n_isolated: int) -> bool:
    """Whether a value with a number of isolated readings of an axis, without NaN, is a mark."""
    values = fields[:, axis]
    is_value = values == value
    others = values[~is_value]
    n_inside = np.count_nonzero(is_value)
    if is_value[-1] and not is_value.all():
        # The last run may continue.
        n_inside -= int(np.argmin(is_value[::-1]))
    if len(others) < MIN_OTHERS or n_isolated < MIN_ISOLATED * n_inside:
        return False
    if jump <= MIN_JUMP * typical_change(others):
        return False
    # A first run that nothing was measured before may be a level that has changed.
    is_left_again = n_isolated > int(np.argmin(is_value))
    if value == 0.0 or is_left_again and np.mean(others[1:] != others[:-1]) > 1.0 - MIN_COARSE:
        return True
    if len(others) < len(values) / 2:
        return False
    largest = max(abs(float(np.median(v[~np.isnan(v)]))) for v in fields[~is_value].T
                  if not np.isnan(v).all())
    return abs(value) > MAX_PLAUSIBLE * largest or bool((fields[is_value] == value).all())


def changes_of(fields: FloatArray) -> BoolArray:
    """Whether each reading (n, 3) differs from the previous one; True for the first."""
    before, after = fields[:-1], fields[1:]
    equal = (after == before) | np.isnan(after) & np.isnan(before)
    return np.append(np.ones(min(1, len(fields)), dtype=bool), ~equal.all(axis=1))


def with_lost_readings(fields: FloatArray, stamps: IntArray) -> FloatArray:
    """Insert a NaN row for each lost reading if the timestamps (n,) in ns are regular enough."""
    intervals = np.diff(stamps) / max(1.0, float(np.median(np.diff(stamps)))) if len(stamps) > 1 \
        else np.zeros(0)
    steps = np.round(intervals)
    if np.mean(np.abs(intervals - steps) > MAX_JITTER) > 1.0 - MIN_REGULAR or not len(steps) \
            or steps.min() < 1.0 or steps.sum() > MAX_LOST * len(stamps):
        return fields
    index = np.append(0, np.cumsum(steps.astype(np.int64)))
    out: FloatArray = np.full((int(index[-1]) + 1, 3), np.nan)
    out[index] = fields
    return out


def repetition_of(fields: FloatArray) -> float:
    """Number of chronological readings (n, 3) per measurement, from the regularity of the changes.

    A source that is read every r readings changes at the readings ceil(k r). The phases of the
    changes modulo r then cover 1/r of the circle, so their resultant is sin(π/r) / (π/r). 1 if
    readings are not repeated regularly; an integer unless the rates are incommensurate.
    """
    n, present = len(fields), np.flatnonzero(~np.isnan(fields).all(axis=1))
    is_change = np.zeros(n, dtype=bool)
    is_change[present] = changes_of(fields[present])
    changes = np.flatnonzero(is_change[1:])
    n_changes = len(changes)
    if n_changes < MIN_LOG_ODDS or n_changes > len(present) / MIN_REPETITION:
        return 1.0
    size = OVERSAMPLING * 2 ** int(np.ceil(np.log2(n)))
    resultant = np.abs(np.fft.rfft(is_change[1:].astype(float), size)) / n_changes
    frequency = np.arange(len(resultant)) / size
    # A rate above half the rate of publishing is aliased. Equal measurements only lower the number
    # of changes, so a source is at least as fast as the changes.
    frequency = np.where(frequency < 0.95 * n_changes / n, 1.0 - frequency, frequency)
    period = 1.0 / np.maximum(frequency, 1e-9)
    expected = np.sinc(1.0 / period)
    is_regular = (period >= MIN_REPETITION) & (period <= MAX_REPETITION) \
        & (resultant > MIN_RESULTANT * expected) & (n_changes * resultant**2 > MIN_LOG_ODDS)
    if not is_regular.any():
        return 1.0
    # Multiples of the rate are regular as well: the slowest source decides.
    slowest = np.flatnonzero(is_regular & (period > 0.9 * period[is_regular].max()))
    frequencies = frequency[slowest[np.argmax(resultant[slowest])]] \
        + 1.0 / size * np.linspace(-1.0, 1.0, 65)
    resultant = np.abs(np.exp(2j * np.pi * np.outer(frequencies, changes)).sum(axis=1))
    best = float(1.0 / frequencies[np.argmax(resultant)])
    nearest = round(best)
    return float(nearest) if abs(best - nearest) * n < 2.0 * best**2 / OVERSAMPLING else best


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
        return ReadingFaults(np.array(marks[:core.MAX_MARKS]).reshape(-1, 3),
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
    """Find marks and repetitions in chronological raw readings (n, 3) T at timestamps (n,) ns."""
    marks = missing_marks(fields)
    kept = np.where(are_marked(fields, marks), np.nan, fields)
    return ReadingFaults(marks, repetition_of(
        kept if stamps is None else with_lost_readings(kept, stamps)))


def isolated_readings(values: FloatArray, min_height: float = 0.0) -> IntArray:
    """Indices of single readings (n,), not beside NaN, that differ by more than `min_height` from
    two neighbours that agree with each other."""
    if len(values) < 5:
        return np.zeros(0, dtype=np.int64)
    change = np.diff(values)
    change_before, change_after = change[1:-2], change[2:-1]
    adjacent_change = np.maximum(np.abs(change[:-3]), np.abs(change[3:]))
    adjacent_change = np.maximum(adjacent_change, np.abs(change_before + change_after))
    height = np.minimum(np.abs(change_before), np.abs(change_after))
    smallest_change = np.min(np.abs(change), where=np.abs(change) > 0.0, initial=np.inf)
    return 2 + np.flatnonzero((np.sign(change_before) == -np.sign(change_after)) & (
        height > MIN_ISOLATION * np.maximum(adjacent_change, smallest_change))
        & (height > min_height))


def saturated_readings(fields: FloatArray, max_run: float = MAX_RUN) -> BoolArray:
    """Find readings at the limit of the range of an axis among chronological raw readings (n, 3),
    at which a single excursion stays for at most `max_run`, about half a second."""
    fields = np.asarray(fields, dtype=float)
    is_saturated = np.zeros(fields.shape, dtype=bool)
    # A held reading is equal on all axes.
    is_new = changes_of(fields)
    for axis in range(3):
        rows = np.flatnonzero(np.isfinite(fields[:, axis]) & is_new)
        for limit in _limits(fields[rows, axis], max_run):
            is_saturated[:, axis] |= fields[:, axis] == limit
    return is_saturated


def with_margin(is_saturated: BoolArray) -> BoolArray:
    """Add the `N_MARGIN` readings on both sides of each saturated reading of the same axis."""
    out = np.zeros_like(is_saturated)
    for axis, rows in enumerate(map(np.flatnonzero, is_saturated.T)):
        nearby = rows[:, None] + np.arange(-N_MARGIN, N_MARGIN + 1)
        out[np.clip(nearby, 0, len(out) - 1), axis] = True
    return out


def _limits(values: FloatArray, max_run: float) -> list[float]:
    """Limits that an axis without NaN has reached, at most the largest and the smallest value."""
    values = values.copy()
    outliers = isolated_readings(values)
    values[outliers] = values[outliers - 1]
    changes = np.abs(np.diff(values))
    if len(values) < MIN_RUN + 2 or not changes.any():
        return []
    step, rest = float(changes[changes > 0.0].min()), float(np.median(values))
    curvature = np.abs(np.diff(values, n=2))
    inliers = curvature[curvature <= 8.0 * np.quantile(curvature, 0.6)]
    # The quantisation error is part of the scatter, but does not make equal readings rare.
    variance = np.pi / 12.0 * inliers.mean() ** 2
    noise = float(np.sqrt(max(variance - step**2 / 12.0, 0.0)))
    return [extreme for extreme in (float(values.min()), float(values.max()))
            if abs(extreme - rest) > MIN_DISTANCE * max(step, noise)
            and _is_limit(values, extreme, rest, step, noise, max_run)]


def _is_limit(values: FloatArray, extreme: float, rest: float, step: float, noise: float,
              max_run: float) -> bool:
    """Whether the peaks of the excursions to an extreme are cut off."""
    log_equal = float(np.log(erf(step / (2.0 * np.sqrt(2.0) * noise)))) if noise > 0.0 else 0.0
    height = np.abs(values - extreme)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], height == 0.0, [False]])))
    last_cut = None
    for first, end in edges.reshape(-1, 2).tolist():
        n, before, after = end - first, height[max(0, first - N_FLANK):first], \
            height[end:end + N_FLANK]
        if n < MIN_RUN or not len(before) or not len(after) \
                or min(before[-1], after[0]) > MAX_ENTRY * abs(extreme - rest):
            continue
        if n * log_equal < MIN_LOG_PROBABILITY:
            return True
        round_height = 2.0 * step * (1.0 + 2.0 * N_FLANK / n) ** MAX_FLATNESS
        if min(before.max(), after.max()) < round_height + MIN_NOISE_RATIO * noise:
            continue
        is_separate = last_cut is not None \
            and height[last_cut:first].max() > 0.5 * abs(extreme - rest)
        if n <= max_run or is_separate:
            return True
        last_cut = end
    return False
