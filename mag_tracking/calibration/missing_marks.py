"""Marks for missing readings: values that a driver publishes when it has no reading.

Typical marks are 0, 99999, the end of the range and the largest number of a type. A mark is entered
and left by a jump, and always has exactly the same value, which noise prevents for readings.
"""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray

MIN_READINGS = 3
"""Minimum number of readings with the value of a mark."""
MIN_OTHERS = 12
"""Minimum number of other readings of the axis."""
MIN_JUMP = 30.0
"""Minimum difference between a mark and its neighbours, in standard deviations or steps."""
MIN_ISOLATION = 10.0
"""Minimum difference between a mark and its neighbours, relative to the changes next to it."""
MIN_ISOLATED = 0.5
"""Minimum fraction of the occurrences that are isolated; during a pass they are not."""
MIN_COARSE = 0.5
"""Fraction of repeated readings above which the value of a reading at rest is no coincidence."""
MAX_PLAUSIBLE = 1.5
"""Minimum ratio of a mark of such a sensor to the largest median of an axis, unless it is zero or
equal on all axes."""
MIN_TOGETHER = 0.9
"""Minimum fraction of the occurrences of a mark in which another axis has a mark as well."""
LARGEST = 1e30
"""[T] Limit to which values are clipped, so that differences do not overflow."""


def missing_marks(fields: FloatArray) -> FloatArray:
    """Find the marks (k, 3) among chronological raw readings (n, 3) in T, NaN for a missing axis.

    A mark is NaN for an axis that it does not concern. Values of several axes that always occur
    together are one mark.
    """
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
    return ' or '.join(map(_describe_mark, marks))


def _describe_mark(mark: FloatArray) -> str:
    """Format a mark (3,) [T]."""
    values = [(f'{axis} = ', v) for axis, v in zip('xyz', mark.tolist(), strict=True)
              if not np.isnan(v)]
    if len(values) == 3 and len({v for _, v in values}) == 1:
        values = [('', values[0][1])]
    return ', '.join(axis + (f'{1e9 * v:.6g} nT' if abs(v) < 1.0 else f'{v:.6g} T')
                     for axis, v in values)


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
