"""Background field and noise of one sensor, learnt from target-free stretches.

The background is a straight line in time (level and drift) through the means
of short quiet blocks; the noise is their pooled scatter. A block that departs
from the line freezes the learning, and takes with it what was learnt shortly
before: a target comes near gradually. Source: TSP14 section VI, T10 section
6.3 (mean and covariance of a target-free stretch); the line and the freezing
are this package's own.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Block:
    """Summary of one short stretch."""

    time: float
    """[s], centre."""
    mean: np.ndarray
    """(3,) [T]; NaN = axis not reported."""
    scatter: np.ndarray
    """(3, 3) [T^2], sum of squared deviations."""
    n: np.ndarray
    """(3,) samples per axis."""


LEAST_SAMPLES = 8
"""A block has at least so many samples, however slow the sensor: fewer tell nothing of noise."""

LOUDEST = 100.0
"""A block whose variance is so many times that of the quietest is no noise: a target passed within
it, as it can within the long blocks of a slow sensor. Noise and coarse steps stay well below."""

LEAST_STD = 1e-11
"""[T] A block that scatters less teaches nothing: the sensor is stuck, or its steps are coarse."""


class RunningBackground:
    """Running estimate of one sensor's background; times in seconds of the records.

    Parameters
    ----------
    learn, memory, guard, block : float [s]
        Quiet time needed before it is ready; length of the stretch that the
        line is fitted to; how far the line stays behind the present; length
        of a block.
    freeze_std : float
        A block departs if its mean is this many noise deviations off.
    relearn : float [s]
        After so long frozen on a steady level that level is the new
        background; 0 = never.
    background, noise_std : (3,) [T], optional
        Known beforehand: with both it is ready at once.
    """

    def __init__(self, learn, memory, guard, block, freeze_std, relearn,
                 background=None, noise_std=None):
        self._learn, self._guard, self._block = learn, guard, block
        self._freeze_std, self._relearn = freeze_std, relearn
        self._most = max(3, int(round(memory / block)))
        self._memory = memory
        self._given = None if background is None else np.asarray(background, dtype=float)
        self._noise = None if noise_std is None else np.diag(np.asarray(noise_std, float) ** 2)
        self._noise_given = self._noise is not None
        self._std = (None, None)
        self.n_relearnt = 0
        self.forget()

    def forget(self):
        """Drop what was learnt; what was given beforehand stays."""
        self._samples, self._start = [], None
        self._window = deque(maxlen=self._most)
        self._pending, self._strange = deque(), deque()
        self.frozen = False
        if not self._noise_given:
            self._noise = None
        self._line = None if self._given is None else (0.0, self._given, np.zeros(3), 0.0)
        self.stuck = False

    @property
    def ready(self):
        """Whether both background and noise are known."""
        return self._line is not None and self._noise is not None

    @property
    def covariance(self):
        """(3, 3) [T^2] noise of one sample, or None; NaN for an axis not reported."""
        return self._noise

    @property
    def noise_std(self):
        """[3 float] [T], or None; NaN for an axis not reported."""
        # It is asked of every sample, and changes once a block.
        if self._std[0] is not self._noise:
            self._std = (self._noise, None if self._noise is None
                         else np.sqrt(np.diagonal(self._noise)).tolist())
        return self._std[1]

    @property
    def measured(self):
        """Whether the background is from readings, not from what was given beforehand."""
        return bool(self._window) and self.ready

    @property
    def drift(self):
        """(3,) [T/s] of the background; NaN before it is ready, and of an axis not reported."""
        return np.full(3, np.nan) if self._line is None else self._line[2]

    def level(self, time):
        """(3,) [T] background at `time` [s].

        The drift is carried on for at most twice the stretch that it was
        learnt from: what is known of it from three seconds is not good for twenty.
        Raises ValueError before it is ready.
        """
        if self._line is None:
            raise ValueError('the background has not been learnt yet')
        centre, mean, slope, horizon = self._line
        return mean + slope * (min(time, horizon) - centre)

    def add(self, time, field):
        """Take a sample: `time` [s], `field` (3,) [T], sensor frame."""
        if self._start is not None and time >= self._start + self._block \
                and len(self._samples) >= LEAST_SAMPLES:
            self._close()
        if self._start is None:
            self._start = time
        self._samples.append((time, field))

    def _close(self):
        """Turn the collected samples into a block and judge it."""
        times = np.array([t for t, _ in self._samples])
        fields = np.array([f for _, f in self._samples])
        n = np.count_nonzero(~np.isnan(fields), axis=0)
        mean = np.where(n > 0, np.nansum(fields, axis=0) / np.maximum(n, 1), np.nan)
        # An axis that is missing now and then is missing in those products only.
        deviation = np.nan_to_num(fields - mean)
        block = Block(float(times.mean()), mean, deviation.T @ deviation, n)
        self._samples, self._start = [], None
        variance = np.diagonal(block.scatter)[n > 1] / (n[n > 1] - 1)
        self.stuck = bool((variance < LEAST_STD**2).any())
        if self.stuck:
            return
        if self._line is not None and self._noise is not None:
            self._follow(block)
        else:
            self._begin(block)

    def _begin(self, block):
        """Before it is ready: collect until a quiet stretch is long enough."""
        self._strange.append(block)
        # From centre to centre; the blocks of a slow sensor may be longer than `_block`.
        enough = self._learn - 1.5 * self._block
        while len(self._strange) > 3 and block.time - self._strange[1].time >= enough:
            self._strange.popleft()
        if len(self._strange) >= 3 and block.time - self._strange[0].time >= enough:
            self._adopt_if_steady()

    def _follow(self, block):
        """Once ready: extend the quiet stretch, or freeze."""
        std = np.sqrt(np.diagonal(self._noise))
        off = np.abs(block.mean - self.level(block.time))
        # A comparison with NaN is false: an axis that is not reported freezes nothing.
        self.frozen = bool(np.any(off > self._freeze_std * std))
        if self.frozen:
            self._pending.clear()
            self._strange.append(block)
            if self._relearn and block.time - self._strange[0].time >= self._relearn:
                if self._adopt_if_steady():
                    self.n_relearnt += 1
                    self.frozen = False
                else:
                    self._strange.popleft()
            elif not self._relearn:
                self._strange.clear()
            return
        self._strange.clear()
        self._pending.append(block)
        while self._pending and self._pending[0].time <= block.time - self._guard:
            self._window.append(self._pending.popleft())
            self._fit()

    def _adopt_if_steady(self):
        """Take the collected blocks as the background if they lie on one line."""
        blocks = list(self._strange)
        if _one_is_loud(blocks):
            return False
        noise = _pooled_covariance(blocks)
        if noise is None and not self._noise_given:
            return False
        std = np.sqrt(np.diagonal(self._noise if self._noise_given else noise))
        if np.isnan(std).all():
            return False
        centre, mean, slope = _line_through(blocks)
        off = [np.abs(b.mean - mean - slope * (b.time - centre)) for b in blocks]
        if not np.nanmax(np.array(off) / std) <= self._freeze_std:
            return False
        if not self._noise_given:
            self._noise = noise
        if self._given is not None and self._line is not None and not self.n_relearnt \
                and not self.frozen:
            # The background was given and only the noise had to be learnt.
            self._strange.clear()
            return True
        self._window.clear()
        self._window.extend(blocks[-self._most:])
        self._strange.clear()
        self._fit()
        return True

    def _fit(self):
        """Line and noise from the present window."""
        blocks = list(self._window)
        if self._given is not None and blocks[-1].time - blocks[0].time < self._learn:
            return
        centre, mean, slope = _line_through(blocks)
        span = blocks[-1].time - blocks[0].time
        self._line = (centre, mean, slope, blocks[-1].time + 2.0 * span)
        noise = _pooled_covariance(blocks)
        if not self._noise_given and noise is not None:
            self._noise = noise


def _line_through(blocks):
    """Weighted least-squares line per axis: centre [s], mean (3,) and slope (3,) there.

    NaN for an axis that no block reports.
    """
    t = np.array([b.time for b in blocks])
    w = np.array([b.n for b in blocks], dtype=float)
    y = np.nan_to_num(np.array([b.mean for b in blocks]))
    total = w.sum(axis=0)
    some = total > 0.0
    total = np.where(some, total, np.nan)
    centre = float(t.mean())
    mean_t = (w * t[:, None]).sum(axis=0) / total
    mean_y = (w * y).sum(axis=0) / total
    d = t[:, None] - mean_t
    spread = (w * d * d).sum(axis=0)
    flat = ~(spread > 0.0)
    slope = np.where(flat, 0.0, (w * d * (y - mean_y)).sum(axis=0) / np.where(flat, 1.0, spread))
    return centre, mean_y + slope * (centre - mean_t), slope


def _one_is_loud(blocks):
    """Whether a block scatters far more than the others, on any axis."""
    variance = np.array([np.where(b.n > 1, np.diagonal(b.scatter) / np.maximum(b.n - 1, 1), np.nan)
                         for b in blocks])
    known = variance[:, ~np.isnan(variance).all(axis=0)]
    return bool((np.nanmax(known, axis=0) > LOUDEST * np.nanmin(known, axis=0)).any())


def _pooled_covariance(blocks):
    """Scatter within blocks, pooled; None with too few samples, NaN for an axis not reported."""
    n = sum(b.n for b in blocks)
    freedom = n - np.count_nonzero([b.n > 0 for b in blocks], axis=0)
    if freedom.max() <= 3:
        return None
    freedom = np.where(freedom > 3, freedom, np.nan).astype(float)
    scatter = sum(b.scatter for b in blocks)
    return scatter / np.sqrt(freedom[:, None] * freedom[None, :])
