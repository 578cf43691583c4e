"""Rates, gaps and clocks of the topics of a recording."""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.errors import RecordingError
from mag_tracking.messages.message_arrays import magnetic_fields
from mag_tracking.messages.schema import readings_of, stamp_ns
from mag_tracking.messages.types import FIELD_READINGS, MAGNETIC_FIELD, decode
from mag_tracking.quantities import occurrences, quantity
from mag_tracking.recording.message_block import MessageBlock
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import fault_of
from mag_tracking.units import NS

BATCH_SIZE = 4096
GAP_INTERVALS, MIN_GAP_S = 10.0, 1.0
"""A gap is longer than this number of median intervals, and, if messages come in bursts, than this
time [s]."""
MAX_GAP_FRACTION = 0.01
"""Fraction of intervals longer than `GAP_INTERVALS` above which messages come in bursts."""
_BINS_PER_OCTAVE = 16
"""Resolution of the histogram of intervals."""
_MAX_CLOCK_DIFFERENCE = 0.1
"""Relative difference of the durations of two clocks above which one of them is wrong."""
_MIN_CLOCK_DIFFERENCE_S = 10.0


class Source(NamedTuple):
    """Sensor or topic whose messages are counted together."""

    topic: str
    sensor: str
    """Name of the sensor, or frame_id. Empty for other topics."""


class Timing:
    """Statistics of the times of one source, in constant memory."""

    def __init__(self) -> None:
        self.n_messages = self.n_backward = self.n_unstamped = 0
        # Earliest and latest log time and timestamp; latest message.
        self._log: list[int] = []
        self._times: list[int] = []
        self._last: IntArray = np.zeros(0, dtype=np.int64)
        self._longest = self._longest_begin = self._n_steps = 0
        # Histogram of the intervals: number and sum [ns] by logarithm.
        self._counts: IntArray = np.zeros(64 * _BINS_PER_OCTAVE, dtype=np.int64)
        self._sums: FloatArray = np.zeros(64 * _BINS_PER_OCTAVE)

    def add(self, times_ns: IntArray, log_times_ns: IntArray) -> None:
        """Add messages in the order of the recording, by log time if all timestamps are 0."""
        if not len(times_ns):
            return
        self.n_messages += len(times_ns)
        is_missing = (times_ns == 0) & (log_times_ns != 0)
        self.n_unstamped += int(is_missing.sum())
        if is_missing.all():
            times_ns = log_times_ns
        else:
            times_ns, log_times_ns = times_ns[~is_missing], log_times_ns[~is_missing]
        steps = np.diff(np.concatenate((self._last, times_ns)))
        self._last = times_ns[-1:].copy()
        for span, values in ((self._log, log_times_ns), (self._times, times_ns)):
            span[:] = [min([*span[:1], int(values.min())]), max([*span[1:], int(values.max())])]
        self._n_steps += len(steps)
        self.n_backward += int(np.sum(steps < 0))
        if len(steps) and steps.max() > self._longest:
            self._longest = int(steps.max())
            # The end of the step is in this batch.
            self._longest_begin = int(times_ns[int(steps.argmax()) - len(steps)]) - self._longest
        forward = steps[steps > 0]
        bins = (np.log2(forward) * _BINS_PER_OCTAVE).astype(np.int64)
        self._counts += np.bincount(bins, minlength=len(self._counts))
        self._sums += np.bincount(bins, forward, minlength=len(self._sums))

    @property
    def span_s(self) -> float:
        """Time from the earliest to the latest message [s]; 0 without messages."""
        return (self._times[-1] - self._times[0]) / NS if self._times else 0.0

    @property
    def log_span_s(self) -> float:
        """Log time from the earliest to the latest message [s]; 0 without messages."""
        return (self._log[-1] - self._log[0]) / NS if self._log else 0.0

    @property
    def clocks_disagree(self) -> bool:
        """Whether the durations by timestamps and by log times contradict each other."""
        difference = abs(self.span_s - self.log_span_s)
        return not self.n_unstamped and difference > max(
            _MIN_CLOCK_DIFFERENCE_S, _MAX_CLOCK_DIFFERENCE * min(abs(self.span_s),
                                                                 abs(self.log_span_s)))

    def _n_regular_bins(self) -> int:
        """Number of bins of intervals that are not gaps."""
        n = int(self._counts.sum())
        median_bin = int(np.searchsorted(np.cumsum(self._counts), (n + 1) // 2))
        n_bins = median_bin + int(np.log2(GAP_INTERVALS) * _BINS_PER_OCTAVE) + 1
        if self._counts[n_bins:].sum() > MAX_GAP_FRACTION * n:
            return max(n_bins, int(np.log2(MIN_GAP_S * NS) * _BINS_PER_OCTAVE) + 1)
        return n_bins

    def describe(self) -> str:
        """Format rate, gaps and steps backward; empty for fewer than two messages."""
        if self.n_messages < 2:
            return ''
        n_bins = self._n_regular_bins()
        n_gaps, total = int(self._counts[n_bins:].sum()), self._sums[:n_bins].sum()
        # Messages with equal times belong to the same intervals.
        n = self._n_steps - n_gaps - self.n_backward
        parts = [f'{n * NS / total:.4g} Hz'] if total else []
        if n_gaps:
            parts.append(f'{quantity(n_gaps, "gap")}, the longest {self._longest / NS:.4g} s, '
                         f'{(self._longest_begin - self._times[0]) / NS:.4g} s after the start')
        if self.n_backward:
            parts.append(f'time steps backward {occurrences(self.n_backward)}')
        if self.n_unstamped:
            parts.append(f'header.stamp is 0 in {quantity(self.n_unstamped, "message")}')
        return ', '.join(parts)


def time_topics(recording: Recording, progress: Callable[[int], object] | None = None
                ) -> tuple[dict[Source, Timing], 'Counter[str]', 'Counter[str]']:
    """Compute the timing of each topic and sensor; count undecodable readings by cause, and
    messages by topic."""
    timings: dict[Source, Timing] = {}
    faults: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for block in recording.blocks(progress=progress):
        for channel, n in zip(*np.unique(block.channel, return_counts=True), strict=True):
            counts[block.kinds[int(channel)].topic] += int(n)
        for first in range(0, len(block), BATCH_SIZE):
            for source, times, log_times in _times_of(
                    block.part(slice(first, first + BATCH_SIZE)), faults):
                timings.setdefault(source, Timing()).add(times, log_times)
        # The bytes of this chunk are freed before the next chunk is read.
        del block
    return timings, faults, counts


def _times_of(block: MessageBlock, faults: 'Counter[str]'
              ) -> Iterator[tuple[Source, IntArray, IntArray]]:
    """Iterate over the sources in a block, with times (n,) [ns] and log times (n,) [ns]."""
    for channel in np.unique(block.channel).tolist():
        kind = block.kinds[channel]
        rows = np.flatnonzero(block.channel == channel)
        log_times = block.log_time_ns[rows]
        if kind.type == MAGNETIC_FIELD:
            yield from _field_times(block, kind.topic, rows, faults)
        elif kind.type == FIELD_READINGS:
            yield from _batch_times(block, kind.topic, rows, faults)
        else:
            yield Source(kind.topic, ''), log_times, log_times


def _field_times(block: MessageBlock, topic: str, rows: IntArray, faults: 'Counter[str]'
                 ) -> Iterator[tuple[Source, IntArray, IntArray]]:
    """Times of the magnetic fields `rows` of a block, by frame_id."""
    fields = magnetic_fields(block.data, block.begin[rows], block.end[rows])
    is_fast = fields.is_decoded & block.kinds[int(block.channel[rows[0]])].is_cdr
    for frame in np.unique(fields.frame[is_fast]):
        same = is_fast & (fields.frame == frame)
        first = decode(block.message(int(rows[same][0]))).header.frame_id
        yield Source(topic, first), fields.stamp_ns[same], block.log_time_ns[rows[same]]
    times: dict[Source, tuple[list[int], list[int]]] = {}
    for k in rows[~is_fast].tolist():
        message = block.message(k)
        try:
            header = decode(message).header
            source, stamp = Source(topic, header.frame_id), stamp_ns(header.stamp)
        except (RecordingError, AttributeError):
            faults[fault_of(message)] += 1
            continue
        lists = times.setdefault(source, ([], []))
        lists[0].append(stamp)
        lists[1].append(message.log_time_ns)
    for source, (stamps, log_times) in times.items():
        yield source, np.array(stamps), np.array(log_times)


def _batch_times(block: MessageBlock, topic: str, rows: IntArray, faults: 'Counter[str]'
                 ) -> Iterator[tuple[Source, IntArray, IntArray]]:
    for k in rows.tolist():
        message = block.message(k)
        try:
            readings = readings_of(decode(message))
        except RecordingError:
            faults[fault_of(message)] += 1
            continue
        order = np.argsort(readings.sensor, kind='stable')
        numbers, first = np.unique(readings.sensor[order], return_index=True)
        # Without readings, the split has one part and no number.
        for j, stamps in zip(numbers.tolist(), np.split(readings.stamp_ns[order], first[1:]),
                             strict=False):
            yield (Source(topic, readings.names[j]), stamps,
                   np.full(len(stamps), block.log_time_ns[k]))
