"""Statistics of the latest readings of a sensor."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration.resolution import smallest_steps


def quantiles(values: Sequence[float] | FloatArray | IntArray, *shares: float) -> list[float]:
    """[float] quantiles of (n,) finite `values`, by linear interpolation; NaN of none.

    As `numpy.quantile`, whose checks take longer than the work where arrays are small.
    """
    if not len(values):
        return [float('nan')] * len(shares)
    ordered, out = np.sort(values), []
    for share in shares:
        place = share * (len(ordered) - 1)
        low = int(place)
        a, b = float(ordered[low]), float(ordered[min(low + 1, len(ordered) - 1)])
        out.append(a + (place - low) * (b - a))
    return out


def median_field(fields: FloatArray) -> FloatArray:
    """(3,) [T] median of `fields` (n, 3); NaN of an axis that none has."""
    return np.array([quantiles(axis[~np.isnan(axis)], 0.5)[0] for axis in fields.T])


def noise_of(fields: FloatArray) -> FloatArray:
    """(3,) [T] deviation by second differences, without the largest; NaN of a missing axis.

    Of the second: a passing target has a slope, but hardly a curve from one reading to the next.
    A sensor with coarse steps is no better than those.
    """
    out, steps = np.full(3, np.nan), smallest_steps(fields)
    for axis, d in enumerate(np.abs(np.diff(fields, n=2, axis=0)).T):
        d = d[~np.isnan(d)]
        if len(d) >= 8:
            least = steps[axis] / np.sqrt(12.0) if np.isfinite(steps[axis]) else 0.0
            # Their mean, not their median: of coarse steps the median is one.
            usual = d[d <= max(8.0 * quantiles(d, 0.6)[0], least)]
            out[axis] = max(np.sqrt(np.pi / 12.0) * usual.mean(), least)
    return out
