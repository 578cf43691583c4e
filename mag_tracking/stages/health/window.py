"""Statistics of the latest readings of a sensor."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration.sensor_state import smallest_steps
from mag_tracking.records import plain
from mag_tracking.stages.health import core


class ReadingBuffer:
    """Buffer for at most `capacity` raw readings of each of `n` sensors, in order of arrival."""

    def __init__(self, n: int, capacity: int) -> None:
        self._count = np.zeros(n, dtype=np.int64)
        self._stamp, self._received = np.zeros((2, n, capacity), dtype=np.int64)
        self._field = np.zeros((n, capacity, 3))

    def add(self, rows: IntArray, stamps: IntArray, fields: FloatArray, received_ns: int,
            first: int) -> int:
        """Add readings from index `first` until a buffer is full, except negative `rows`; return
        the next index."""
        return core.add_readings(plain(rows, np.int64), plain(stamps, np.int64), plain(fields),
                                 received_ns, first, self._count, self._stamp, self._received,
                                 self._field)

    def pop(self, j: int) -> tuple[IntArray, FloatArray, IntArray]:
        """Remove and return timestamps, fields and times of receipt of a sensor, as views."""
        out = self.peek(j)
        self._count[j] = 0
        return out

    def peek(self, j: int) -> tuple[IntArray, FloatArray, IntArray]:
        """Return the readings of a sensor, as `pop`, and keep them in the buffer."""
        k = int(self._count[j])
        return self._stamp[j, :k], self._field[j, :k], self._received[j, :k]


def quantiles(values: Sequence[float] | FloatArray | IntArray,
              *probabilities: float) -> list[float]:
    """Quantiles of finite values, faster than those of numpy; NaN without values."""
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

    They suppress a passing target, whose field has hardly any curvature from one reading to the
    next. The result is at least the quantisation error; NaN for fewer than eight differences.
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
