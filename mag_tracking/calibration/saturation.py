"""Readings of a saturated sensor."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.screening import COARSE

MIN_RUN = 3
"""Minimum number of equal consecutive readings at an extreme of a saturated axis ..."""

MIN_JUMP = 3.0
"""... that are reached by a jump of at least this number of smallest steps; a smooth curve in
coarse steps reaches its top by one step."""

MARGIN = 6
"""Number of readings before and after a saturated one that are not trusted either: noise takes some
of them over the limit, which biases the others."""


MIN_ISOLATION = 10.0
"""Minimum ratio of the differences of a reading from both neighbours to the differences between and
around those neighbours. Beyond it, the reading is a bus error."""


def isolated_readings(values: FloatArray) -> IntArray:
    """Find readings of one axis that differ from both neighbours, which agree.

    Parameters
    ----------
    values : (n,) array
        In order of time, without NaN.

    Returns
    -------
    (k,) int array
        Indices of the readings.
    """
    if len(values) < 5:
        return np.zeros(0, dtype=np.int64)
    change = np.diff(values)
    before, after = change[1:-2], change[2:-1]
    around = np.maximum(np.abs(change[:-3]), np.abs(change[3:]))
    around = np.maximum(around, np.abs(before + after))
    height = np.minimum(np.abs(before), np.abs(after))
    least = np.min(np.abs(change[change != 0.0]), initial=np.inf)
    found: IntArray = 2 + np.flatnonzero((before * after < 0.0) & (
        height > MIN_ISOLATION * np.maximum(around, least)))
    return found


def saturated_readings(values: FloatArray) -> BoolArray:
    """Find readings of one axis at the end of its range, and those next to them.

    Noise makes equal neighbours rare, and a curve in coarse steps reaches its extreme step by step.
    Only saturation gives several equal readings directly after a jump.

    Parameters
    ----------
    values : (n,) array
        Raw readings in order of time; NaN = missing.

    Returns
    -------
    (n,) bool array
    """
    values = np.asarray(values, dtype=float)
    out = np.zeros(len(values), dtype=bool)
    present = np.flatnonzero(~np.isnan(values))
    v = values[present]
    v = v.copy()
    outliers = isolated_readings(v)
    v[outliers] = v[outliers - 1]
    if max(np.count_nonzero(v == v.min(initial=np.inf)),
           np.count_nonzero(v == v.max(initial=-np.inf))) < MIN_RUN:
        return out
    jumps = np.abs(np.diff(v))
    if not (jumps > 0.0).any():
        return out
    step = jumps[jumps > 0.0].min()
    level = float(np.median(v))
    for extreme in (v.min(), v.max()):
        at = v == extreme
        if extreme == level and np.mean(jumps[~(at[1:] & at[:-1])] == 0.0) >= COARSE:
            # An axis with coarse steps is at rest at its median.
            continue
        edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]])))
        for first, end in edges.reshape(-1, 2):
            sides = [jumps[i] for i in (first - 1, end - 1) if 0 <= i < len(jumps)]
            if end - first >= MIN_RUN and max(sides) >= MIN_JUMP * step:
                near = np.flatnonzero(at)[:, None] + np.arange(-MARGIN, MARGIN + 1)
                out[present[np.clip(near, 0, len(v) - 1)]] = True
                break
    return out
