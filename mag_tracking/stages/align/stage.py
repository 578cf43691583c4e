"""Align: asynchronous samples of many sensors to frames of the whole network.

Samples are put in order of their timestamps, and a frame is built only from what is final: older
than the latest sample of every sensor that is alive. So the frames do not depend on the order in
which the sensors' messages arrive.
"""

from collections import Counter

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame, Readings, plain
from mag_tracking.stages.align import kernel
from mag_tracking.stages.align.clock_step import ClockStepFilter, HeldSample
from mag_tracking.stages.align.frame_period import frame_period
from mag_tracking.stages.align.sample_buffer import SampleBuffer
from mag_tracking.stages.align.settings import AlignSettings
from mag_tracking.units import NEVER, NS

FAR = np.iinfo(np.int64).max
"""[ns] Later than anything."""
MOST_HELD = 16
"""Samples of a sensor that are held while it is not known whether its clock has stepped."""

CAUSES = {
    kernel.NO_FIELD: 'no finite field',
    kernel.NO_COVARIANCE: 'covariance unknown, and no noise_std in the network',
    kernel.DUPLICATE: 'duplicate stamp',
    kernel.OUT_OF_ORDER: 'out of order',
    kernel.LATE: 'late',
}
"""{reason code: why a sample is rejected}, apart from those that name a sensor."""


class Align:
    """Calibrated readings to frames; memory is bounded by `most_pending`.

    Between two frames a sample costs the same with any number of sensors: it cannot complete a
    frame while one sensor is known that the frame has to wait for.

    `kernel.hold_samples` has the rules; here is what it reports.
    """

    def __init__(self, network: SensorNetwork, settings: AlignSettings) -> None:
        self.counts: Counter[str] = Counter()
        self._n = len(network)
        self._noise = np.array([np.full((3, 3), np.nan) if std is None else np.diag(std ** 2)
                                for std in network.noise_std]).reshape(-1, 3, 3)
        self._index = {name: i for i, name in enumerate(network.names)}
        self._burst = settings.burst
        self._names = network.names
        self._settings = settings
        self._period = int(round(frame_period(settings, network) * NS))
        self._wait = int(round(settings.max_wait_s * NS))
        self._reset()

    def _reset(self) -> None:
        """As new."""
        settings = self._settings
        longest_jump = int(round(settings.ahead_s * NS)) or FAR
        self._pending = SampleBuffer(self._n)
        self._latest = np.full(self._n, NEVER)
        self._taken = np.full(self._n, NEVER)
        self._stamp: int | None = None
        self._last_taken: int | None = None
        self._clock_steps = ClockStepFilter(self._n, longest_jump,
                                            min(settings.most_pending, MOST_HELD))
        self._clocks = np.zeros(1, kernel.CLOCK)
        self._clock = self._clocks[0]
        for name in ('first', 'newest', 'end'):
            self._clock[name] = NEVER
        for name, value in (('period', self._period), ('wait', self._wait),
                            ('limit', longest_jump), ('most', settings.most_pending),
                            ('jump_back', int(round(settings.jump_back_s * NS))),
                            ('is_burst', settings.burst)):
            self._clock[name] = value
        self._look_ahead()

    @property
    def n_held(self) -> int:
        """How many samples wait for their frame, or for the other sensors' clocks."""
        return len(self._pending) + self._clock_steps.n_held

    @property
    def n_held_ahead(self) -> int:
        """How many of them are held because their timestamps jumped ahead."""
        return self._clock_steps.n_held

    def feed(self, readings: Readings) -> list[FieldFrame]:
        """Calibrated `Readings` give the `FieldFrame`s that they complete."""
        rows, C = readings.rows(self._index), readings.covariance
        if C is None:
            C = self._noise[rows]
        else:
            unknown = readings.without_covariance()
            if unknown.any():
                C = np.where(unknown[:, None, None], self._noise[rows], C)
        return self._hold(rows, plain(readings.stamp_ns, np.int64), plain(readings.field),
                          plain(C), readings)

    def _hold(self, rows: IntArray, stamps: IntArray, fields: FloatArray, covariances: FloatArray,
              readings: Readings | None = None) -> list[FieldFrame]:
        """Put samples to the pending ones; the frames that they complete.

        Without `readings` it is known that they are not from clocks that stepped.
        """
        out: list[FieldFrame] = []
        k = 0
        while True:
            pending, steps, clock = self._pending, self._clock_steps, self._clock
            clock['next'], clock['passed'], clock['is_calm'] = k, steps.newest, steps.is_calm
            reason = kernel.hold_samples(
                self._clocks, readings is None, self._latest, steps.latest, self._taken,
                pending.first, pending.count, pending.stamp, pending.field, pending.covariance,
                rows, stamps, fields, covariances)
            k, steps.newest = int(clock['next']), int(clock['passed'])
            if reason == kernel.DONE:
                return out
            if reason == kernel.UNKNOWN_SENSOR:
                assert readings is not None
                self._reject(f'unknown sensor {readings.names[readings.sensor[k - 1]]}')
            elif reason == kernel.CLOCK_STEP:
                out += self._after_clock_step(int(rows[k - 1]), HeldSample(
                    int(stamps[k - 1]), fields[k - 1], covariances[k - 1]))
            elif reason == kernel.JUMPED_BACK:
                out += self._restarted()
                here = slice(k, k + 1)
                out += self._hold(rows[here], stamps[here], fields[here], covariances[here])
                k += 1
            else:
                out += self._handle(reason, int(clock['row']))

    def _handle(self, reason: int, i: int) -> list[FieldFrame]:
        """Do what the kernel asks for, or count a rejection; it is about sensor `i`."""
        if reason == kernel.NO_ROOM:
            self._pending.grow()
            return []
        if reason in CAUSES:
            self._reject(CAUSES[reason])
            return []
        if reason == kernel.TOO_MANY:
            self._pending.drop(i)
            self._look_ahead()
            self._reject('too many pending')
        return [] if self._waits() else self._frames()

    def _after_clock_step(self, i: int, sample: HeldSample) -> list[FieldFrame]:
        """A sample of sensor `i` that may be from a clock that stepped."""
        passed, refused = self._clock_steps.feed(i, sample)
        for j, _ in refused:
            self._reject(f'ahead of all others: {self._names[j]}')
        return self._hold_passed(passed)

    def _hold_passed(self, passed: list[tuple[int, HeldSample]]) -> list[FieldFrame]:
        """Put samples that are not from clocks that stepped to the pending ones."""
        out: list[FieldFrame] = []
        for i, s in passed:
            out += self._hold(np.array([i]), np.array([s.stamp_ns]), s.field[None],
                              s.covariance[None])
        return out

    def _restarted(self) -> list[FieldFrame]:
        """The time jumped back: the frames of what was pending; then as new."""
        out = self.flush()
        self._reset()
        self.counts['time jumped back'] += 1
        return out

    def flush(self) -> list[FieldFrame]:
        """All frames that can be made of what is pending."""
        out = self._hold_passed(self._clock_steps.flush())
        return out + self._frames(final=True)

    def idle(self) -> None:
        """Nothing waits."""

    def _reject(self, cause: str) -> None:
        """Count the rejection."""
        self.counts[f'rejected: {cause}'] += 1

    def _look_ahead(self) -> None:
        """Find the end of the next frame; any sensor may be one to wait for."""
        self._clock['window'] = self._period
        self._clock['start'] = self._clock['due'] = FAR
        oldest = self._pending.oldest()
        for i in np.flatnonzero(self._pending.count) if self._burst else ():
            kernel.bring_forward(self._clocks, oldest[i], self._taken[i])
        if not self._burst and len(self._pending):
            # Where sensors are not read in turn the oldest sample alone decides.
            kernel.bring_forward(self._clocks, oldest[self._pending.count > 0].min(), NEVER)
        self._clock['watch'] = -1

    def _waits(self) -> bool:
        """Whether there is a sensor that the next frame has to wait for."""
        clock, latest = self._clock, self._latest
        is_young = int(clock['newest']) - int(clock['first']) < self._wait
        # Who was never heard counts as heard up to -1: frames that end before are not held up.
        if clock['due'] < 0 and is_young and (latest == NEVER).any():
            return False
        return kernel.is_one_behind(self._clocks, latest) and (
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
