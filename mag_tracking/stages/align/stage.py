"""Align: asynchronous samples of many sensors to frames of the whole network.

Samples are put in order of their stamps, and a frame is built only from what
is final: older than the latest sample of every sensor that is alive. So the
frames do not depend on the order in which the sensors' messages arrive.
"""

from collections import Counter
from math import isfinite, isinf, isnan

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration.ordinary import NEVER
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame, MagSample, Readings, plain
from mag_tracking.stages.align.clock_step import ClockStepFilter
from mag_tracking.stages.align.sample_buffer import (
    CLOCK,
    SampleBuffer,
    hold_ordinary,
    is_one_behind,
)
from mag_tracking.stages.align.settings import AlignSettings
from mag_tracking.units import NS

FAR = np.iinfo(np.int64).max
"""[ns] Later than anything."""
MOST_HELD = 16
"""Samples of a sensor that are held while it is not known whether its clock has stepped."""


class Align:
    """Calibrated samples to frames; memory is bounded by `most_pending`.

    Between two frames a sample costs the same with any number of sensors: it can
    complete nothing while one sensor is known that the frame has to wait for. Samples
    that nothing is odd about take a way that is compiled (`stages.pending`).
    """

    def __init__(self, network: SensorNetwork, settings: AlignSettings) -> None:
        self.counts: Counter[str] = Counter()
        self._n = len(network)
        self._noise = [None if std is None else np.diag(std ** 2) for std in network.noise_std]
        self._index = {name: i for i, name in enumerate(network.names)}
        self._rows = np.arange(self._n)
        self._burst = settings.burst
        self._most_pending = settings.most_pending
        self._jump_back = settings.jump_back_s * NS
        self._names = network.names
        self._longest_jump = int(round(settings.ahead_s * NS)) or FAR
        self._period = int(round(settings.period_s * NS))
        self._wait = int(round(settings.max_wait_s * NS))
        self._reset()

    def _reset(self) -> None:
        """As new."""
        self._pending = SampleBuffer(self._n)
        self._latest = np.full(self._n, NEVER)
        self._taken = np.full(self._n, NEVER)
        self._stamp: int | None = None
        self._last_taken: int | None = None
        self._ahead = ClockStepFilter(self._n, self._longest_jump,
                                      min(self._most_pending, MOST_HELD))
        self._clocks = np.zeros(1, CLOCK)
        self._clock = self._clocks[0]
        for name in ('first', 'newest', 'end', 'passed'):
            self._clock[name] = NEVER
        for name, value in (('period', self._period), ('wait', self._wait),
                            ('limit', self._longest_jump), ('most', self._most_pending)):
            self._clock[name] = value
        self._look_ahead()

    @property
    def n_held(self) -> int:
        """How many samples wait for their frame, or for the other sensors' clocks."""
        return len(self._pending) + self._ahead.n_held

    @property
    def n_held_ahead(self) -> int:
        """How many of them are held because their timestamps jumped ahead."""
        return self._ahead.n_held

    def feed(self, sample: MagSample) -> list[FieldFrame]:
        """A calibrated `MagSample` gives the `FieldFrame`s that it completes."""
        i = self._index.get(sample.sensor, -1)
        C = self._noise[i] if sample.covariance is None else sample.covariance
        if i >= 0 and C is not None and self._hold_many(
                self._rows[i:i + 1], np.array([sample.stamp_ns]),
                np.array([sample.field], dtype=float), np.array([C], dtype=float), 0):
            return self._completed()
        return self._feed_any(sample)

    def feed_many(self, readings: Readings) -> list[FieldFrame]:
        """Calibrated `Readings` give the `FieldFrame`s that they complete."""
        out: list[FieldFrame] = []
        k, n = 0, len(readings)
        rows, C = readings.rows(self._index), readings.covariance
        if C is None:
            rows, C = np.full(n, -1), np.full((n, 3, 3), np.nan)
        stamps, fields, C = plain(readings.stamp_ns, np.int64), plain(readings.field), plain(C)
        while k < n:
            odd = self._hold_many(rows, stamps, fields, C, k)
            if self._clock['is_complete']:
                out, k = out + self._completed(), odd
            else:
                out += self._feed_any(readings.sample(odd)) if odd < n else []
                k = odd + 1
        return out

    def _hold_many(self, rows: IntArray, stamps: IntArray, fields: FloatArray,
                   covariances: FloatArray, begin: int) -> int:
        """`pending.hold_ordinary`, where nothing stands against it."""
        pending, ahead, clock = self._pending, self._ahead, self._clock
        clock['is_complete'] = 0
        if self._burst or ahead.newest == NEVER or not ahead.is_calm:
            return begin
        clock['passed'] = ahead.newest
        end = hold_ordinary(self._clocks, self._latest, ahead.latest, pending.first,
                            pending.count, pending.stamp, pending.field, pending.covariance,
                            rows, stamps, fields, covariances, begin)
        ahead.newest = int(clock['passed'])
        return end

    def _completed(self) -> list[FieldFrame]:
        """The frames that are complete, if it is not known that one has to wait."""
        if not self._clock['is_complete'] or self._waits():
            return []
        return self._frames()

    def _feed_any(self, sample: MagSample) -> list[FieldFrame]:
        """As `feed`, of a sample that may be odd."""
        i = self._index.get(sample.sensor)
        cause = self._fault(i, sample)
        if i is None or cause:
            self._reject(cause or f'unknown sensor {sample.sensor}')
            return []
        passed, refused = self._ahead.feed(i, sample)
        for j, _ in refused:
            self._reject(f'ahead of all others: {self._names[j]}')
        return [f for j, s in passed for f in self._take_in(j, s)]

    def _take_in(self, i: int, sample: MagSample) -> list[FieldFrame]:
        """A sample whose stamp is not ahead of all others gives the frames that it completes."""
        out: list[FieldFrame] = []
        stamp, clock = sample.stamp_ns, self._clock
        last = int(self._latest[i])
        if stamp <= last:
            if last - stamp <= self._jump_back:
                self._reject('duplicate stamp' if stamp == last else 'out of order')
                return []
            out = self.flush()
            self._reset()
            clock = self._clock
            self.counts['time jumped back'] += 1
        self._latest[i] = stamp
        if stamp < clock['end']:
            self._reject('late')
            return []
        if clock['newest'] == NEVER:
            clock['first'] = stamp
        clock['newest'] = max(int(clock['newest']), stamp)
        clock['first'] = min(int(clock['first']), stamp)
        self._hold(i, stamp, sample)
        return out if self._waits() else out + self._frames()

    def flush(self) -> list[FieldFrame]:
        """All frames that can be made of what is pending."""
        out = [f for i, s in self._ahead.flush() for f in self._take_in(i, s)]
        return out + self._frames(final=True)

    def _fault(self, i: int | None, sample: MagSample) -> str | None:
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

    def _reject(self, cause: str) -> None:
        """Count the rejection."""
        self.counts[f'rejected: {cause}'] += 1

    def _hold(self, i: int, stamp: int, sample: MagSample) -> None:
        """Put a sample of sensor `i` to those that are pending."""
        pending = self._pending
        if not pending.count[i]:
            self._bring_forward(stamp, int(self._taken[i]))
        C = self._noise[i] if sample.covariance is None else sample.covariance
        assert C is not None
        pending.append(i, stamp, sample.field, C)
        if pending.count[i] > self._most_pending:
            pending.drop(i)
            self._look_ahead()
            self._reject('too many pending')

    def _look_ahead(self) -> None:
        """Find the end of the next frame; any sensor may be one to wait for."""
        self._window = self._period
        self._clock['start'] = self._clock['due'] = FAR
        for i in np.flatnonzero(self._pending.count) if self._burst else ():
            self._bring_forward(int(self._pending.oldest()[i]), int(self._taken[i]))
        if not self._burst and len(self._pending):
            # Of sensors that are not read in turn the oldest decides alone.
            self._bring_forward(int(np.min(self._pending.oldest()[self._pending.count > 0])),
                                NEVER)
        self._clock['watch'] = -1

    def _bring_forward(self, stamp: int, taken: int) -> None:
        """Have the next frame end early enough for `stamp`, the oldest pending of a sensor.

        `taken` is the stamp of that sensor which was in a frame.
        """
        clock = self._clock
        end = int(clock['end'])
        if self._burst:
            # A round spreads over the period, or half of any sensor's sample interval.
            if taken != NEVER:
                self._window = min(self._window, max(1, (stamp - taken) // 2))
        elif end != NEVER and stamp < end + self._period:
            stamp = end
        clock['start'] = min(int(clock['start']), stamp)
        clock['due'] = clock['start'] + self._window

    def _waits(self) -> bool:
        """Whether there is a sensor that the next frame has to wait for."""
        clock, latest = self._clock, self._latest
        is_young = int(clock['newest']) - int(clock['first']) < self._wait
        # Who was never heard counts as heard up to -1: frames that end before are not held up.
        if clock['due'] < 0 and is_young and (latest == NEVER).any():
            return False
        return is_one_behind(self._clocks, latest) and (
            not self._burst or self._is_one_missing(is_young))

    def _is_one_missing(self, is_young: bool) -> bool:
        """Whether a sensor may still answer in this round, where its next is not of another."""
        oldest, latest = self._pending.oldest(), self._latest
        # It was heard and is not pending, so frames were taken. At the head of a new round the
        # others' latest samples are a round old.
        heard = latest >= (NEVER if self._last_taken is None else self._last_taken - self._wait)
        return bool(np.where(oldest != NEVER, oldest >= self._clock['due'],
                             np.where(latest == NEVER, is_young, heard)).any())

    def _frames(self, final: bool = False) -> list[FieldFrame]:
        """Frames that are complete, or all if what is pending is `final`."""
        out: list[FieldFrame] = []
        while True:
            self._look_ahead()
            if self._clock['due'] == FAR or not final and self._waits():
                return out
            out.append(self._frame(int(self._clock['due'])))

    def _frame(self, end: int) -> FieldFrame:
        """Take the samples before `end` (in burst mode one each) and average them."""
        oldest = self._pending.oldest()
        taken = self._pending.take(end, self._burst)
        n, last = taken.n, taken.last
        self._taken[n > 0] = last[n > 0]
        first, newest, n_all = int(oldest[n > 0].min()), int(last.max()), int(n.sum())
        self._last_taken = newest if self._last_taken is None else max(self._last_taken, newest)
        self._clock['end'] = newest + 1 if self._burst else end
        self.counts['frames'] += 1
        if not n.all():
            self.counts['frames with a sensor missing'] += 1
        stamp = first + round((int(taken.since.sum()) + n_all * (end - first)) / n_all)
        if self._stamp is not None:
            # Rounds of sensors with different rates overlap; the offsets keep their true times.
            stamp = max(stamp, self._stamp + 1)
        self._stamp = stamp
        offset = (taken.since + n * (end - stamp)) / np.maximum(n, 1) / NS
        field, covariance = _averages(n, taken.n_axis, taken.field, taken.covariance)
        return FieldFrame(stamp, field, covariance, n, offset)


def _averages(n: IntArray, n_axis: FloatArray, total: FloatArray,
              total_covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(field, covariance) of the sums over the samples of each sensor."""
    field = np.divide(total, n_axis, out=np.full(total.shape, np.nan), where=n_axis > 0)
    # The fewest per axis counts for all: never better than it is.
    fewest = np.fmin.reduce(np.where(n_axis > 0, n_axis, np.nan), axis=1)
    return field, total_covariance / (np.maximum(n, 1) * fewest)[:, None, None]
