"""Decimation of a fast sensor with an anti-aliasing filter."""

from collections import deque

import numpy as np

from mag_tracking.arrays import FloatArray

ATTENUATION_DB = 60.0
"""Attenuation of the frequencies that alias into the pass band."""
PASS_FRACTION = 0.5
"""Pass band as a fraction of half the output rate; only frequencies above the pass band alias. The
delay is about four output intervals, and more for a wider pass band."""
GAP_TOLERANCE = 0.5
"""Relative difference from the median interval beyond which an interval is a gap."""
RATE_SAMPLES = 32
"""Number of samples from which the rate is measured. These samples are decimated afterwards."""


def lowpass(factor: int) -> FloatArray:
    """Odd number of taps, which sum to one, of a low-pass filter for decimation by `factor`."""
    # The import takes 0.3 s, and most sensors need no filter.
    from scipy.signal import firwin, kaiserord

    n, beta = kaiserord(ATTENUATION_DB, 2.0 * (1.0 - PASS_FRACTION) / factor)
    return firwin(n | 1, 1.0 / factor, window=('kaiser', beta))


class Decimator:
    """Decimator of one sensor to about `rate` Hz, an integer fraction of the sensor's rate.

    The filter has linear phase, and its delay is subtracted from the timestamps ([T10]_ section 6.3
    reduces 100 Hz to 12.5 Hz likewise). The rate is measured from the first samples; `factor`, the
    ratio of input to output rate, is None until then. The filter restarts after a gap or clock
    step, because filtering across it would produce an invalid field.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self.factor: int | None = None
        self._taps: FloatArray | None = None
        self.reset()

    def reset(self) -> None:
        """Discard the stored samples and retain the measured rate."""
        self._window: deque[tuple[int, FloatArray]] = deque(
            maxlen=None if self._taps is None else len(self._taps))
        self._n_until_output = 0

    def feed(self, stamp_ns: int, field: FloatArray) -> list[tuple[int, FloatArray]]:
        """Add a sample (3,) T; return the outputs that become available: timestamp [ns] of the
        filter's centre and field, NaN for incomplete axes."""
        interval = stamp_ns - self._window[-1][0] if self._window else 1
        if interval <= 0 or self._window and self.factor is not None and abs(
                interval - self._interval) > GAP_TOLERANCE * self._interval:
            self.reset()
        self._window.append((stamp_ns, field))
        if self.factor is None:
            return self._measure_rate()
        if self._taps is None:
            self._window = deque(list(self._window)[-2:])
            return [(stamp_ns, field)]
        if len(self._window) < len(self._taps):
            return []
        if self._n_until_output:
            self._n_until_output -= 1
            return []
        self._n_until_output = self.factor - 1
        # The filter is symmetric, so its output belongs to the centre sample.
        return [(self._window[len(self._taps) // 2][0],
                 self._taps @ np.array([f for _, f in self._window]))]

    @property
    def n_waiting(self) -> int:
        """Number of samples stored to measure the rate; 0 once the rate is known."""
        return len(self._window) if self.factor is None else 0

    def noise_gain(self) -> float:
        """Ratio of output to input variance of white noise, once the rate is known."""
        return 1.0 if self._taps is None else float(self._taps @ self._taps)

    def _measure_rate(self) -> list[tuple[int, FloatArray]]:
        """Measure the rate if enough samples are stored; return the outputs of these samples."""
        if len(self._window) < RATE_SAMPLES:
            return []
        stamps = np.array([s for s, _ in self._window], dtype=np.int64)
        self._interval = float(np.median(np.diff(stamps)))
        self.factor = max(1, round(1e9 / self._interval / self._rate))
        self._taps = lowpass(self.factor) if self.factor > 1 else None
        stored_samples = list(self._window)
        self.reset()
        return [out for stamp, field in stored_samples for out in self.feed(stamp, field)]
