"""Readings that a sensor cut off at the end of its range."""

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray

LEAST_RUN = 3
"""So many equal readings in a row at an extreme are cut off ..."""

LEAST_JUMP = 3.0
"""... where they were reached by a jump of so many of the smallest steps that the sensor makes: the
top of a gentle curve in coarse steps is reached by one."""

MARGIN = 6
"""Readings so near in time to one that is cut off are not to be trusted either: noise took some of
their neighbours over the limit, and what is left of them is on one side of the truth."""


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
    if max(np.count_nonzero(v == v.min(initial=np.inf)),
           np.count_nonzero(v == v.max(initial=-np.inf))) < LEAST_RUN:
        return out
    jumps = np.abs(np.diff(v))
    if not (jumps > 0.0).any():
        return out
    step = jumps[jumps > 0.0].min()
    for extreme in (v.min(), v.max()):
        at = v == extreme
        edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]])))
        for first, end in edges.reshape(-1, 2):
            sides = [jumps[i] for i in (first - 1, end - 1) if 0 <= i < len(jumps)]
            if end - first >= LEAST_RUN and max(sides) >= LEAST_JUMP * step:
                near = np.flatnonzero(at)[:, None] + np.arange(-MARGIN, MARGIN + 1)
                out[present[np.clip(near, 0, len(v) - 1)]] = True
                break
    return out
