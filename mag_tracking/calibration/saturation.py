"""Detection of saturated readings and of isolated faulty readings.

The limit of the range cuts the peak off an excursion: several equal readings, far from the level
at rest, between steep flanks. Other peaks are round, and noise makes equal readings rare.
"""

import numpy as np
from scipy.special import erf

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.reading_faults import changes_of

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

MIN_ISOLATION = 10.0
"""Minimum difference of an isolated reading (a bus error) from its neighbours, relative to
theirs."""


def isolated_readings(values: FloatArray) -> IntArray:
    """Indices of single readings (n,) that differ from two neighbours that agree with each other.

    NaN next to a reading excludes it.
    """
    if len(values) < 5:
        return np.zeros(0, dtype=np.int64)
    change = np.diff(values)
    change_before, change_after = change[1:-2], change[2:-1]
    adjacent_change = np.maximum(np.abs(change[:-3]), np.abs(change[3:]))
    adjacent_change = np.maximum(adjacent_change, np.abs(change_before + change_after))
    height = np.minimum(np.abs(change_before), np.abs(change_after))
    smallest_change = np.min(np.abs(change), where=np.abs(change) > 0.0, initial=np.inf)
    indices: IntArray = 2 + np.flatnonzero((np.sign(change_before) == -np.sign(change_after)) & (
        height > MIN_ISOLATION * np.maximum(adjacent_change, smallest_change)))
    return indices


def saturated_readings(fields: FloatArray, max_run: float = MAX_RUN) -> BoolArray:
    """Find readings at the limit of the range of an axis among chronological raw readings (n, 3).

    NaN marks a missing axis. `max_run` is the most readings, about half a second, for which a
    single excursion stays at the limit. See `with_margin` for the adjacent readings.
    """
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
