"""Sum of a quantity over the latest frames of a track."""

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.units import NS


class SlidingSum:
    """Sum of the values in a sliding window that ends at the latest frame."""

    def __init__(self, window_s: float) -> None:
        self._window_ns = round(window_s * NS)
        self._frames: deque[tuple[int, FloatArray]] = deque()

    def add(self, stamp_ns: int, value: ArrayLike) -> None:
        """Add the value of a frame, with the same shape for all frames."""
        self._frames.append((stamp_ns, np.asarray(value, dtype=float)))
        while self._frames[0][0] < stamp_ns - self._window_ns:
            self._frames.popleft()

    @property
    def total(self) -> FloatArray:
        """Sum of the values in the window, with the shape of a value; 0 before the first value."""
        total: FloatArray = np.sum([value for _, value in self._frames], axis=0)
        return total
