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
    n: int


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
        self._line = None if self._given is None else (0.0, self._given, np.zeros(3), np.inf)
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
        self._line = None if self._given is None else (0.0, self._given, np.zeros(3), np.inf)

    @property
    def ready(self):
        """Whether both background and noise are known."""
        return self._line is not None and self._noise is not None

    @property
    def covariance(self):
        """(3, 3) [T^2] noise of one sample, or None; NaN for an axis not reported."""
        return self._noise

    def level(self, time):
        """(3,) [T] background at `time` [s].

        The drift is carried on for at most the length of the memory.
        Raises ValueError before it is ready.
        """
        if self._line is None:
            raise ValueError('the background has not been learnt yet')
        centre, mean, slope, last = self._line
        return mean + slope * (min(time, last + self._memory) - centre)

    def add(self, time, field):
        """Take a sample: `time` [s], `field` (3,) [T], sensor frame."""
        if self._start is not None and time >= self._start + self._block:
            self._close()
        if self._start is None:
            self._start = time
        self._samples.append((time, field))

    def _close(self):
        """Turn the collected samples into a block and judge it."""
        times = np.array([t for t, _ in self._samples])
        fields = np.array([f for _, f in self._samples])
        mean = fields.mean(axis=0)
        deviation = fields - mean
        block = Block(float(times.mean()), mean, deviation.T @ deviation, len(times))
        self._samples, self._start = [], None
        if self._line is not None and self._noise is not None:
            self._follow(block)
        else:
            self._begin(block)

    def _begin(self, block):
        """Before it is ready: collect until a quiet stretch is long enough."""
        self._strange.append(block)
        while self._strange[-1].time - self._strange[0].time > self._learn:
            self._strange.popleft()
        if self._strange[-1].time - self._strange[0].time < self._learn - 1.5 * self._block:
            return
        self._adopt_if_steady()

    def _follow(self, block):
        """Once ready: extend the quiet stretch, or freeze."""
        std = np.sqrt(np.diagonal(self._noise))
        off = np.abs(block.mean - self.level(block.time))
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
        noise = _pooled_covariance(blocks)
        if noise is None and not self._noise_given:
            return False
        std = np.sqrt(np.diagonal(self._noise if self._noise_given else noise))
        centre, mean, slope = _line_through(blocks)
        off = [np.abs(b.mean - mean - slope * (b.time - centre)) for b in blocks]
        if np.nanmax(np.array(off) / std) > self._freeze_std:
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
        self._line = (centre, mean, slope, blocks[-1].time)
        noise = _pooled_covariance(blocks)
        if not self._noise_given and noise is not None:
            self._noise = noise


def _line_through(blocks):
    """Weighted least-squares line: centre [s], mean (3,) and slope (3,) there."""
    t = np.array([b.time for b in blocks])
    w = np.array([b.n for b in blocks], dtype=float)
    y = np.array([b.mean for b in blocks])
    centre = float(w @ t / w.sum())
    mean = w @ y / w.sum()
    spread = float(w @ (t - centre) ** 2)
    slope = (w * (t - centre)) @ (y - mean) / spread if spread > 0.0 else np.zeros(3)
    return centre, mean, slope


def _pooled_covariance(blocks):
    """Scatter within blocks, pooled; None where there are too few samples for it."""
    freedom = sum(b.n - 1 for b in blocks)
    return sum(b.scatter for b in blocks) / freedom if freedom > 3 else None
