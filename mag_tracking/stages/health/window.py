"""Statistics of the latest readings of a sensor."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration.sensor_state import smallest_steps


def quantiles(values: Sequence[float] | FloatArray | IntArray,
              *probabilities: float) -> list[float]:
    """Quantiles of finite values, by linear interpolation; NaN if `values` is empty.

    This is `numpy.quantile` without its checks, which take longer than the computation for small
    arrays.
    """
    if not len(values):
        return [float('nan')] * len(probabilities)
    ordered, out = np.sort(values), []
    for probability in probabilities:
        position = probability * (len(ordered) - 1)
        low = int(position)
        a, b = float(ordered[low]), float(ordered[min(low + 1, len(ordered) - 1)])
        out.append(a + (position - low) * (b - a))
    return out


def median_field(fields: FloatArray) -> FloatArray:
    """Median (3,) of each axis of `fields` (n, 3); NaN for a missing axis."""
    return np.array([quantiles(axis[~np.isnan(axis)], 0.5)[0] for axis in fields.T])


def sample_noise_std(fields: FloatArray) -> FloatArray:
    """Noise std (3,) of each axis of `fields` (n, 3), from second differences without outliers.

    Second differences suppress a passing target, whose field has a slope but hardly any curvature
    from one reading to the next. The result is at least the quantisation error, and NaN for an axis
    with fewer than eight second differences.
    """
    out, steps = np.full(3, np.nan), smallest_steps(fields)
    for axis, d in enumerate(np.abs(np.diff(fields, n=2, axis=0)).T):
        d = d[~np.isnan(d)]
        if len(d) >= 8:
            minimum = steps[axis] / np.sqrt(12.0) if np.isfinite(steps[axis]) else 0.0
            # The mean is used, because with coarse resolution the median is a whole step.
            inliers = d[d <= max(8.0 * quantiles(d, 0.6)[0], minimum)]
            out[axis] = max(np.sqrt(np.pi / 12.0) * inliers.mean(), minimum)
    return out
