"""Align: asynchronous samples of many sensors to frames of the whole network.

Samples are put in order of their stamps, and a frame is built only from what
is final: older than the latest sample of every sensor that is alive. So the
frames do not depend on the order in which the sensors' messages arrive.
"""

from collections import Counter, deque
from dataclasses import dataclass
from math import inf, isfinite, isinf, isnan

import numpy as np

from mag_tracking.records import FieldFrame
from mag_tracking.settings import param
from mag_tracking.stages.ahead import Ahead
from mag_tracking.stages.stage import NS

MOST_HELD = 16
"""Samples of a sensor that are held while it is not known whether its clock has stepped."""


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
    ahead_s: float = param(
        0.5, 'A sensor whose stamps jump ahead by more than this while those of the others do not '
        'is held back until they follow: its clock has stepped. 0 = never.', 's', (0.0, 3600.0))
    jump_back_s: float = param(
        1.0, 'A stamp that goes back by more than this is a restart (a looped recording).',
        's', (0.0, 3600.0))
    most_pending: int = param(
        10000, 'Samples held per sensor at most; more than that and the oldest are rejected.',
        '', (2, 10_000_000))


class Align:
    """Calibrated samples to frames; memory is bounded by `most_pending`.

    Between two frames a sample costs the same with any number of sensors: it can
    complete nothing while one sensor is known that the frame has to wait for.
    """

    def __init__(self, network, settings):
        self.counts = Counter()
        self._n = len(network)
        self._noise = [None if std is None else np.diag(std ** 2) for std in network.noise_std]
        self._index = {name: i for i, name in enumerate(network.names)}
        self._burst = settings.burst
        self._most_pending = settings.most_pending
        self._jump_back = settings.jump_back_s * NS
        self._names = network.names
        self._longest_jump = int(round(settings.ahead_s * NS)) or inf
        self._period = int(round(settings.period_s * NS))
        self._wait = int(round(settings.max_wait_s * NS))
        self._reset()

    def _reset(self):
        """As new."""
        # Of each sensor (stamp, field, covariance), oldest first.
        self._pending = [deque() for _ in range(self._n)]
        self._latest = [None] * self._n
        self._first = self._newest = self._end = self._stamp = None
        self._taken = [None] * self._n
        self._last_taken = None
        self._ahead = Ahead(self._n, self._longest_jump, min(self._most_pending, MOST_HELD))
        self._look_ahead()

    @property
    def n_held(self):
        """How many samples wait for their frame, or for the other sensors' clocks."""
        return sum(map(len, self._pending)) + self._ahead.n_held

    def feed(self, sample):
        """A calibrated `MagSample` gives the `FieldFrame`s that it completes."""
        i = self._index.get(sample.sensor)
        cause = self._fault(i, sample)
        if cause:
            return self._reject(cause)
        passed, refused = self._ahead.feed(i, sample)
        for j, _ in refused:
            self._reject(f'ahead of all others: {self._names[j]}')
        return [f for j, s in passed for f in self._take_in(j, s)]

    def _take_in(self, i, sample):
        """A sample whose stamp is not ahead of all others gives the frames that it completes."""
        out, stamp = [], sample.stamp_ns
        last = self._latest[i]
        if last is not None and stamp <= last:
            if last - stamp <= self._jump_back:
                return self._reject('duplicate stamp' if stamp == last else 'out of order')
            out = self.flush()
            self._reset()
            self.counts['time jumped back'] += 1
        self._latest[i] = stamp
        if self._end is not None and stamp < self._end:
            return self._reject('late')
        if self._newest is None:
            self._first = self._newest = stamp
        elif stamp > self._newest:
            self._newest = stamp
        elif stamp < self._first:
            self._first = stamp
        self._hold(i, stamp, sample)
        return out if self._waits() else out + self._frames()

    def flush(self):
        """All frames that can be made of what is pending."""
        out = [f for i, s in self._ahead.flush() for f in self._take_in(i, s)]
        return out + self._frames(final=True)

    def _fault(self, i, sample):
        """Why the sample of sensor `i` cannot be used, or None."""
        if i is None:
            return f'unknown sensor {sample.sensor}'
        # Of three numbers Python's own functions are several times as fast as NumPy's.
        values = sample.field.tolist()
        if not isfinite(sum(values)) and (any(map(isinf, values)) or all(map(isnan, values))):
            return 'no finite field'
        if sample.covariance is None and self._noise[i] is None:
            return 'covariance unknown, and no noise_std in the network'
        return None

    def _reject(self, cause):
        """Count the rejection."""
        self.counts[f'rejected: {cause}'] += 1
        return []

    def _hold(self, i, stamp, sample):
        """Put a sample of sensor `i` to those that are pending."""
        queue = self._pending[i]
        if not queue:
            self._bring_forward(i, stamp)
        covariance = self._noise[i] if sample.covariance is None else sample.covariance
        queue.append((stamp, sample.field, covariance))
        if len(queue) > self._most_pending:
            queue.popleft()
            self._reject('too many pending')
            # The frame may end later than `_due` now: that somebody is behind still holds, but
            # a sample that was too late for it may be in time.
            self._missing.clear()

    def _look_ahead(self):
        """Find the end of the next frame; any sensor may be one to wait for."""
        self._start, self._window, self._due = inf, self._period, inf
        for i, queue in enumerate(self._pending):
            if queue:
                self._bring_forward(i, queue[0][0])
        self._behind = list(range(self._n))
        self._missing = list(range(self._n))

    def _bring_forward(self, i, stamp):
        """Have the next frame end early enough for `stamp`, the oldest pending of sensor `i`."""
        if self._burst:
            # A round spreads over the period, or half of any sensor's sample interval.
            if self._taken[i] is not None:
                self._window = min(self._window, max(1, (stamp - self._taken[i]) // 2))
        elif self._end is not None and stamp < self._end + self._period:
            stamp = self._end
        self._start = min(self._start, stamp)
        self._due = self._start + self._window

    def _waits(self):
        """Whether a sensor is known that the next frame has to wait for."""
        # Who was never heard counts as heard up to -1: frames that end before are not held up.
        if self._due < 0 and None in self._latest and self._is_young():
            return False
        return _some(self._behind, self._is_behind) and (
            not self._burst or _some(self._missing, self._is_missing))

    def _is_young(self):
        """Whether a sensor that was never heard is worth waiting for."""
        return self._newest - self._first < self._wait

    def _is_behind(self, i):
        """Whether sensor `i` is alive, and may still give a sample of before the end."""
        latest = self._latest[i]
        if latest is None:
            return self._is_young()
        return self._newest - self._wait <= latest < self._due

    def _is_missing(self, i):
        """Whether sensor `i` may still answer in this round, or its next sample is of another."""
        if self._pending[i]:
            return self._pending[i][0][0] >= self._due
        if self._latest[i] is None:
            return self._is_young()
        # It was heard and is not pending, so frames were taken. At the head of a new round the
        # others' latest samples are a round old.
        return self._latest[i] >= self._last_taken - self._wait

    def _frames(self, final=False):
        """Frames that are complete, or all if what is pending is `final`."""
        out = []
        while True:
            self._look_ahead()
            if self._due == inf or not final and self._waits():
                return out
            out.append(self._frame(self._due))

    def _take(self, end):
        """(samples by sensor, how many of each) of before `end`, in burst mode one of each."""
        taken, n_samples = [], np.zeros(self._n, dtype=int)
        for i, queue in enumerate(self._pending):
            before = len(taken)
            while queue and queue[0][0] < end:
                taken.append(queue.popleft())
                if self._burst:
                    break
            if len(taken) > before:
                n_samples[i] = len(taken) - before
                self._taken[i] = taken[-1][0]
        return taken, n_samples

    def _frame(self, end):
        """Take the samples before `end` (in burst mode one each) and average them."""
        taken, n_samples = self._take(end)
        stamps, fields, covariances = zip(*taken, strict=True)
        newest = max(stamps)
        self._last_taken = newest if self._last_taken is None else max(self._last_taken, newest)
        self._end = newest + 1 if self._burst else end
        self.counts['frames'] += 1
        if not n_samples.all():
            self.counts['frames with a sensor missing'] += 1
        first = min(stamps)
        since = [t - first for t in stamps]
        stamp = first + round(sum(since) / len(since))
        if self._stamp is not None:
            # Rounds of sensors with different rates overlap; the offsets keep their true times.
            stamp = max(stamp, self._stamp + 1)
        self._stamp = stamp
        since = np.array(since) - (stamp - first)
        return FieldFrame(stamp, *_averages(fields, covariances, since, n_samples))


def _some(rows, holds):
    """Whether `holds` for one of the `rows`; those that it does not hold for are dropped."""
    while rows:
        if holds(rows[-1]):
            return True
        rows.pop()
    return False


def _averages(fields, covariances, since, n_samples):
    """(field, covariance, n_samples, time_offset) of a frame, of samples sensor by sensor."""
    n_sensors, values = len(n_samples), np.concatenate(fields).reshape(-1, 3)
    known = ~np.isnan(values)
    columns = np.empty((len(values), 16))
    columns[:, :3] = np.where(known, values, 0.0)
    columns[:, 3:6] = known
    columns[:, 6:15] = np.concatenate(covariances).reshape(-1, 9)
    columns[:, 15] = since
    # It adds in the order of time, where np.add.reduceat adds in pairs.
    row = np.repeat(16 * np.arange(n_sensors), n_samples)
    total = np.bincount((row[:, None] + np.arange(16)).ravel(), columns.ravel(), 16 * n_sensors)
    total = total.reshape(n_sensors, 16)
    n_axis, n = total[:, 3:6], np.maximum(n_samples, 1)[:, None]
    field = np.divide(total[:, :3], n_axis, out=np.full((n_sensors, 3), np.nan), where=n_axis > 0)
    # The fewest per axis counts for all: never better than it is.
    fewest = np.where(n_axis > 0, n_axis, np.nan)
    C = total[:, 6:15] / n / np.fmin.reduce(fewest, axis=1, keepdims=True)
    return field, C.reshape(-1, 3, 3), n_samples, total[:, 15] / n[:, 0] / NS
