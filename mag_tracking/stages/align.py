"""Align: asynchronous samples of many sensors to frames of the whole network.

Samples are put in order of their stamps, and a frame is built only from what
is final: older than the latest sample of every sensor that is alive. So the
frames do not depend on the order in which the sensors' messages arrive.
"""

from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.records import FieldFrame
from mag_tracking.settings import param
from mag_tracking.stages.stage import NS


@dataclass(frozen=True)
class AlignSettings:
    """Settings of the alignment."""

    period_s: float = param(
        0.08, 'Length of a frame: the samples of each sensor in it are averaged.',
        's', (1e-4, 60.0))
    burst: bool = param(
        False, 'The sensors are read in turn, one sample each: a frame is closed as soon as '
        'every sensor has given one, and period_s is the longest that a round may take.')
    max_wait_s: float = param(
        0.5, 'A sensor that is silent for longer is taken for dead and delays nobody.',
        's', (1e-3, 3600.0))
    jump_back_s: float = param(
        1.0, 'A stamp that goes back by more than this is a restart (a looped recording).',
        's', (0.0, 3600.0))
    most_pending: int = param(
        10000, 'Samples held per sensor at most; more than that and the oldest are rejected.',
        '', (2, 10_000_000))


class Align:
    """Calibrated samples to frames; memory is bounded by `most_pending`."""

    def __init__(self, network, settings):
        self.counts = Counter()
        self._n = len(network)
        self._noise = network.noise_std
        self._index = {name: i for i, name in enumerate(network.names)}
        self._settings = settings
        self._period = int(round(settings.period_s * NS))
        self._wait = int(round(settings.max_wait_s * NS))
        self._reset()

    def _reset(self):
        """As new."""
        self._pending = [deque() for _ in range(self._n)]
        self._latest = [None] * self._n
        self._first = self._newest = self._end = self._stamp = None
        self._taken = [None] * self._n

    def feed(self, sample):
        """A calibrated `MagSample` gives the `FieldFrame`s that it completes."""
        i, stamp = self._index.get(sample.sensor), sample.stamp_ns
        if i is None:
            self.counts[f'rejected: unknown sensor {sample.sensor}'] += 1
            return []
        if not np.isfinite(sample.field).any() or np.isinf(sample.field).any():
            self.counts['rejected: no finite field'] += 1
            return []
        if sample.covariance is None:
            if self._noise[i] is None:
                self.counts['rejected: covariance unknown, and no noise_std in the network'] += 1
                return []
            sample = replace(sample, covariance=np.diag(self._noise[i] ** 2))
        out = []
        last = self._latest[i]
        if last is not None and stamp <= last:
            if last - stamp <= self._settings.jump_back_s * NS:
                self.counts['rejected: duplicate stamp' if stamp == last
                            else 'rejected: out of order'] += 1
                return []
            out = self.flush()
            self._reset()
            self.counts['time jumped back'] += 1
        self._latest[i] = stamp
        if self._end is not None and stamp < self._end:
            self.counts['rejected: late'] += 1
            return out
        self._first = stamp if self._first is None else min(self._first, stamp)
        self._newest = stamp if self._newest is None else max(self._newest, stamp)
        self._pending[i].append(sample)
        if len(self._pending[i]) > self._settings.most_pending:
            self._pending[i].popleft()
            self.counts['rejected: too many pending'] += 1
        return out + self._frames(self._watermark())

    def flush(self):
        """All frames that can be made of what is pending."""
        return self._frames(float('inf'))

    def _expected(self):
        """Rows of the sensors that are worth waiting for."""
        young = self._newest - self._first < self._wait
        return [i for i, t in enumerate(self._latest)
                if (young if t is None else t >= self._newest - self._wait)]

    def _watermark(self):
        """Stamp up to which everything has arrived."""
        latest = [self._latest[i] for i in self._expected()]
        return -1 if None in latest else min(latest)

    def _frames(self, watermark):
        """Frames that are complete at `watermark`."""
        out = []
        while True:
            heads = [q[0].stamp_ns for q in self._pending if q]
            if not heads:
                return out
            start = min(heads)
            if self._settings.burst:
                end = start + self._burst_window()
                ready = watermark >= end or self._round_complete(end, watermark)
            else:
                if self._end is not None and start < self._end + self._period:
                    start = self._end
                end = start + self._period
                ready = watermark >= end
            if not ready:
                return out
            out.append(self._frame(end))

    def _burst_window(self):
        """Longest spread of one round: the period, and half of any sensor's sample interval."""
        gaps = [q[0].stamp_ns - t for q, t in zip(self._pending, self._taken, strict=True)
                if q and t is not None]
        return max(1, min([self._period] + [g // 2 for g in gaps]))

    def _round_complete(self, end, watermark):
        """Whether every sensor that is alive has given a sample before `end`."""
        if watermark == float('inf'):
            return True
        # At the head of a new round the others' latest samples are a round old.
        awaited = [i for i in range(self._n) if self._pending[i] or self._alive(i)]
        return all(self._pending[i] and self._pending[i][0].stamp_ns < end for i in awaited)

    def _alive(self, i):
        """Whether sensor `i` may still answer in this round."""
        if self._latest[i] is None:
            return self._newest - self._first < self._wait
        taken = [t for t in self._taken if t is not None]
        previous = max(taken) if taken else self._first
        return self._latest[i] >= previous - self._wait

    def _frame(self, end):
        """Take the samples before `end` (in burst mode one each) and average them."""
        field = np.full((self._n, 3), np.nan)
        covariance = np.full((self._n, 3, 3), np.nan)
        n_samples = np.zeros(self._n, dtype=int)
        stamps = [[] for _ in range(self._n)]
        for i, queue in enumerate(self._pending):
            taken = []
            while queue and queue[0].stamp_ns < end:
                taken.append(queue.popleft())
                if self._settings.burst:
                    break
            if not taken:
                continue
            self._taken[i] = taken[-1].stamp_ns
            stamps[i] = [s.stamp_ns for s in taken]
            n_samples[i] = len(taken)
            values = np.array([s.field for s in taken])
            there = np.count_nonzero(~np.isnan(values), axis=0)
            field[i, there > 0] = np.nansum(values, axis=0)[there > 0] / there[there > 0]
            # The fewest per axis counts for all: never better than it is.
            n = there[there > 0].min() if there.any() else 1
            covariance[i] = np.mean([s.covariance for s in taken], axis=0) / n
        every = [t for row in stamps for t in row]
        self._end = max(every) + 1 if self._settings.burst else end
        self.counts['frames'] += 1
        if (n_samples == 0).any():
            self.counts['frames with a sensor missing'] += 1
        first = min(every)
        stamp = first + round(sum(t - first for t in every) / len(every))
        if self._stamp is not None:
            # Rounds of sensors with different rates overlap; the offsets keep their true times.
            stamp = max(stamp, self._stamp + 1)
        self._stamp = stamp
        offset = [sum(t - stamp for t in row) / len(row) / NS if row else 0.0 for row in stamps]
        return FieldFrame(stamp, field, covariance, n_samples, np.array(offset))
