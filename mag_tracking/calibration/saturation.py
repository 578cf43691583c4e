"""Readings that a sensor cut off at the end of its range."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.screening import COARSE

MIN_RUN = 3
"""So many equal readings in a row at an extreme are cut off ..."""

MIN_JUMP = 3.0
"""... where they were reached by a jump of so many of the smallest steps that the sensor makes: the
top of a gentle curve in coarse steps is reached by one."""

MARGIN = 6
"""Readings so near in time to one that is cut off are not to be trusted either: noise took some of
their neighbours over the limit, and what is left of them is on one side of the truth."""


ISOLATED = 10.0
"""A reading that differs from both its neighbours by so many times what they differ from each
other, and from theirs, is an error of the bus."""


def isolated(values: FloatArray) -> IntArray:
    """Readings of one axis that are far off both their neighbours, which agree.

    Parameters
    ----------
    values : (n,) array
        In order of time, without NaN.

    Returns
    -------
    (k,) int array
        Their places.
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
        height > ISOLATED * np.maximum(around, least)))
    return found


def cut_off(values: FloatArray) -> BoolArray:
    """Which readings of one axis stand at the end of its range, or beside such.

    Noise makes equal neighbours rare, and where steps are coarse a curve comes to its extreme
    step by step; only a limit makes several equal readings right after a jump.

    Parameters
    ----------
    values : (n,)
        In order of time, as the sensor gave them; NaN = missing.

    Returns
    -------
    (n,) bool
    """
    values = np.asarray(values, dtype=float)
    out = np.zeros(len(values), dtype=bool)
    present = np.flatnonzero(~np.isnan(values))
    v = values[present]
    v = v.copy()
    outliers = isolated(v)
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
            # An axis with coarse steps rests there.
            continue
        edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]])))
        for first, end in edges.reshape(-1, 2):
            sides = [jumps[i] for i in (first - 1, end - 1) if 0 <= i < len(jumps)]
            if end - first >= MIN_RUN and max(sides) >= MIN_JUMP * step:
                near = np.flatnonzero(at)[:, None] + np.arange(-MARGIN, MARGIN + 1)
                out[present[np.clip(near, 0, len(v) - 1)]] = True
                break
    return out
