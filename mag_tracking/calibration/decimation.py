"""Fewer samples of a fast sensor, without what would be folded into them.

Source: T10 section 6.3 (low-pass filter before 100 Hz becomes 12.5 Hz); the filter is
`scipy.signal.firwin`'s, of linear phase, and its delay is taken from the stamps.
"""

from collections import deque

import numpy as np

from mag_tracking.arrays import FloatArray

ATTENUATION_DB = 60.0
"""Of what would be folded into the pass band."""
PASS_SHARE = 0.5
"""Of half the new rate; from there to its mirror image the filter falls. What is folded falls above
it. A wider share would take longer: the filter's delay is now about four of the new intervals."""
IRREGULAR = 0.5
"""An interval that differs from the usual one by more than this share of it is a gap."""
RATE_SAMPLES = 32
"""Samples that the rate is measured by; they are not lost."""


def lowpass(factor: int) -> FloatArray:
    """(n,) taps, n odd, that sum to one: what `factor` times fewer samples need."""
    # It takes a third of a second to import, and most sensors need no filter.
    from scipy.signal import firwin, kaiserord

    width = 2.0 * (1.0 - PASS_SHARE) / factor
    n, beta = kaiserord(ATTENUATION_DB, width)
    taps: FloatArray = firwin(n | 1, 1.0 / factor, window=('kaiser', beta))
    return taps


class Decimator:
    """Samples of one sensor in, fewer out; memory of one filter length.

    It measures the rate by the first samples, and begins anew after a gap or a step
    of the clock: a filter that runs across one would invent a field.
    """

    def __init__(self, rate: float) -> None:
        """`rate` [Hz] is what is wanted; the nearest whole share of the sensor's is made."""
        self._rate = rate
        self.factor: int | None = None
        self._taps: FloatArray | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the samples; the rate stays."""
        self._window: deque[tuple[int, FloatArray]] = deque(
            maxlen=None if self._taps is None else len(self._taps))
        self._until_next = 0

    def feed(self, stamp_ns: int, field: FloatArray) -> list[tuple[int, FloatArray]]:
        """A sample gives [(stamp_ns, field (3,))], of the middle of the filter; mostly [].

        NaN where an axis is missing anywhere under the filter.
        """
        if self._window and self._is_gap(stamp_ns):
            self.reset()
        self._window.append((stamp_ns, field))
        if self.factor is None:
            return self._measure()
        if self._taps is None:
            self._window = deque(list(self._window)[-2:])
            return [(stamp_ns, field)]
        return self._step(self.factor, self._taps)

    @property
    def n_waiting(self) -> int:
        """How many samples it may give at once: those that wait until the rate is known."""
        return len(self._window) if self.factor is None else 0

    def noise_gain(self) -> float:
        """By what white noise's variance is multiplied; ValueError before the rate is known."""
        if self.factor is None:
            raise ValueError('the rate of the sensor is not known yet')
        return 1.0 if self._taps is None else float(self._taps @ self._taps)

    def _is_gap(self, stamp_ns: int) -> bool:
        """Whether the regular row of samples is broken."""
        interval = stamp_ns - self._window[-1][0]
        return interval <= 0 or (self.factor is not None and abs(
            interval - self._interval) > IRREGULAR * self._interval)

    def _measure(self) -> list[tuple[int, FloatArray]]:
        """The factor, once there are enough samples; those go through then."""
        if len(self._window) < RATE_SAMPLES:
            return []
        stamps = np.array([s for s, _ in self._window], dtype=np.int64)
        self._interval = float(np.median(np.diff(stamps)))
        self.factor = max(1, round(1e9 / self._interval / self._rate))
        self._taps = lowpass(self.factor) if self.factor > 1 else None
        waiting = list(self._window)
        self.reset()
        return [out for stamp, field in waiting for out in self.feed(stamp, field)]

    def _step(self, factor: int, taps: FloatArray) -> list[tuple[int, FloatArray]]:
        """The filter's output where one is due."""
        if len(self._window) < len(taps):
            return []
        if self._until_next:
            self._until_next -= 1
            return []
        self._until_next = factor - 1
        # The filter is symmetric: its output is of the middle sample.
        middle = self._window[len(taps) // 2][0]
        return [(middle, taps @ np.array([f for _, f in self._window]))]
