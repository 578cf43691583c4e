"""Detection of saturated readings and of isolated faulty readings."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.screening import COARSE_FRACTION

MIN_RUN = 3
"""Minimum number of consecutive equal readings at the limit of a saturated axis."""

MIN_JUMP = 3.0
"""Minimum jump to the limit of an axis, in multiples of the smallest step; a smooth curve in coarse
steps reaches its extreme by single steps."""

N_MARGIN = 6
"""Number of readings excluded before and after each saturated reading. Noise pushes some of these
readings beyond the limit, which biases the remaining readings."""


MIN_ISOLATION = 10.0
"""Minimum difference between an isolated reading (a bus error) and both neighbours, relative to the
differences between and next to these neighbours."""


def isolated_readings(values: FloatArray) -> IntArray:
    """Find single readings of one axis that differ from two neighbours that agree with each other.

    Parameters
    ----------
    values : (n,) array
        Readings in chronological order, without NaN.

    Returns
    -------
    (k,) int array
        Indices of the readings.
    """
    if len(values) < 5:
        return np.zeros(0, dtype=np.int64)
    change = np.diff(values)
    change_before, change_after = change[1:-2], change[2:-1]
    adjacent_change = np.maximum(np.abs(change[:-3]), np.abs(change[3:]))
    adjacent_change = np.maximum(adjacent_change, np.abs(change_before + change_after))
    height = np.minimum(np.abs(change_before), np.abs(change_after))
    smallest_change = np.min(np.abs(change[change != 0.0]), initial=np.inf)
    indices: IntArray = 2 + np.flatnonzero((change_before * change_after < 0.0) & (
        height > MIN_ISOLATION * np.maximum(adjacent_change, smallest_change)))
    return indices


def saturated_readings(values: FloatArray) -> BoolArray:
    """Find readings of one axis at the limit of its range, and adjacent readings.

    Noise makes equal neighbours rare, and a curve in coarse steps reaches its extreme step by step.
    Only saturation produces several equal readings directly after a jump.

    Parameters
    ----------
    values : (n,) array
        Raw readings in chronological order; NaN for a missing axis.

    Returns
    -------
    (n,) bool array
        True for a saturated reading, and for the `N_MARGIN` readings on both sides of it.
    """
    values = np.asarray(values, dtype=float)
    is_saturated = np.zeros(len(values), dtype=bool)
    present_indices = np.flatnonzero(~np.isnan(values))
    v = values[present_indices]
    v = v.copy()
    outliers = isolated_readings(v)
    v[outliers] = v[outliers - 1]
    if max(np.count_nonzero(v == v.min(initial=np.inf)),
           np.count_nonzero(v == v.max(initial=-np.inf))) < MIN_RUN:
        return is_saturated
    jumps = np.abs(np.diff(v))
    if not (jumps > 0.0).any():
        return is_saturated
    step = jumps[jumps > 0.0].min()
    level = float(np.median(v))
    for extreme in (v.min(), v.max()):
        is_extreme = v == extreme
        if extreme == level \
                and np.mean(jumps[~(is_extreme[1:] & is_extreme[:-1])] == 0.0) >= COARSE_FRACTION:
            # An axis with coarse steps is at rest at its median.
            continue
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_extreme, [False]])))
        for first, end in edges.reshape(-1, 2):
            edge_jumps = [jumps[i] for i in (first - 1, end - 1) if 0 <= i < len(jumps)]
            if end - first >= MIN_RUN and max(edge_jumps) >= MIN_JUMP * step:
                nearby = np.flatnonzero(is_extreme)[:, None] + np.arange(-N_MARGIN, N_MARGIN + 1)
                is_saturated[present_indices[np.clip(nearby, 0, len(v) - 1)]] = True
                break
    return is_saturated
