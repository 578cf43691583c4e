"""Faults of timestamps, and clocks of the sensors, compared by the times of receipt."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration import timestamps
from mag_tracking.calibration.doubtful_times import DoubtfulTimes, doubtful_since, updated
from mag_tracking.network import SensorNetwork
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.health.window import ReadingBuffer
from mag_tracking.units import NS

MAX_CLOCK_DIFFERENCE_S = 60.0
"""[s] Difference from the clocks of other sensors above which a clock is reported."""
MAX_BOOT_DIFFERENCE_S = 1.0
"""[s] The same for clocks that count from the start of their devices."""
MAX_LATENCY_S = 0.25
"""[s] Constant difference above which clocks differ; delays of packets vary."""
MAX_CLOCK_ERROR_S = 0.1
"""[s] The same if timestamps are later than their receipt, which no delay explains."""
MIN_AHEAD_S = 0.02
"""[s] Timestamps are later than their receipt by more than this."""
MAX_CHANGE = 0.1
"""Maximum relative change of a difference that does not change."""
EARLIEST_DATE_S = 20.0 * 365.25 * 86400.0
"""[s] A clock that shows an earlier date (1990) than this counts from the start of its device."""
MIN_SPAN_S = 0.2
"""[s] Minimum time of receipt that shows the unit of timestamps or the change of a difference."""
UNITS = ((1e3, 'the seconds of its timestamps are milliseconds'),
         (1e6, 'the seconds of its timestamps are microseconds'),
         (1e9, 'the seconds of its timestamps are nanoseconds'),
         (1e-3, 'the nanoseconds of its timestamps are microseconds'),
         (1e-6, 'the nanoseconds of its timestamps are milliseconds'))
"""Factor by which the timestamps advance too fast, and the reason."""
MAX_RATIO_ERROR = 0.1
"""Maximum relative error of this factor; of clocks that are compared, it is 1."""
ZERO_STAMP = 'message with header.stamp 0'
"""Cause for which a message without a timestamp is rejected."""
UPDATE_INTERVAL = 64
"""Number of new readings of a sensor after which its timestamps are examined again."""
CAUSES = {
    timestamps.TimestampError.ZERO: (Cause.ZERO_STAMPS, 'set the timestamps in the driver'),
    timestamps.TimestampError.COARSE: (
        Cause.COARSE_STAMPS, 'let the driver set timestamps of a finer resolution'),
    timestamps.TimestampError.PACKET: (
        Cause.PACKET_STAMPS, 'let the driver set the timestamp of each reading'),
    timestamps.TimestampError.BURST: (
        Cause.BURST_STAMPS, 'let the driver set the time of measurement instead of the time of '
        'arrival'),
    timestamps.TimestampError.UNIT: (
        Cause.MILLISECOND_STAMPS, 'correct the unit of the timestamps in the driver')}
"""Cause and remedy of each error of timestamps."""


class ClockSpan(NamedTuple):
    """First and last timestamp of a sensor, and their times of receipt."""

    first_ns: int
    last_ns: int
    first_received_ns: int
    last_received_ns: int

    def until(self, later: 'ClockSpan') -> 'ClockSpan':
        """Span from the begin of this span to the end of a later one."""
        return ClockSpan(self.first_ns, later.last_ns, self.first_received_ns,
                         later.last_received_ns)

    @classmethod
    def of(cls, stamps: IntArray, received: IntArray) -> 'ClockSpan':
        """Span of consecutive readings with timestamps and times of receipt, both (n,) [ns]."""
        return cls(int(stamps[0]), int(stamps[-1]), int(received[0]), int(received[-1]))

    @property
    def delay_s(self) -> float:
        """Delay from the last timestamp to its receipt [s]."""
        return (self.last_received_ns - self.last_ns) / NS

    @property
    def rate(self) -> float:
        """Advance of the timestamps relative to the times of receipt; NaN if unknown."""
        received_ns = self.last_received_ns - self.first_received_ns
        return (self.last_ns - self.first_ns) / received_ns if received_ns > MIN_SPAN_S * NS \
            else np.nan

    def corrected(self, offset_ns: int) -> 'ClockSpan':
        """Subtract the offset of the clock from the timestamps."""
        return self._replace(first_ns=self.first_ns - offset_ns, last_ns=self.last_ns - offset_ns)

    def ahead_s(self, reference: 'ClockSpan') -> tuple[float, bool]:
        """Time [s] by which this clock is ahead of another, and whether it is too large for delays;
        never so in a fast replay."""
        ahead_s = reference.delay_s - self.delay_s
        first_s = (reference.first_received_ns - reference.first_ns) / NS \
            - (self.first_received_ns - self.first_ns) / NS
        if not all(abs(clock.rate - 1.0) <= MAX_RATIO_ERROR for clock in (self, reference)):
            return ahead_s, False
        if abs(first_s - ahead_s) > MAX_CHANGE * abs(ahead_s):
            return ahead_s, abs(ahead_s) > MAX_CLOCK_DIFFERENCE_S
        is_ahead = min(self.delay_s, reference.delay_s) < -MIN_AHEAD_S
        return ahead_s, abs(ahead_s) > (MAX_CLOCK_ERROR_S if is_ahead else MAX_LATENCY_S)

    @property
    def wrong_unit(self) -> str | None:
        """Description of a wrong unit of the timestamps; None if it is right, or unknown."""
        return next((text for factor, text in UNITS
                     if abs(self.rate / factor - 1.0) < MAX_RATIO_ERROR), None)


def corrected(clocks: Mapping[str, ClockSpan], network: SensorNetwork) -> dict[str, ClockSpan]:
    """Correct the clocks of the sensors of a network, and omit other sensors."""
    return {name: clocks[name].corrected(offset_ns) for name, offset_ns in zip(
        network.names, network.clock_offset_ns.tolist(), strict=True) if name in clocks}


def clock_differences(clocks: Mapping[str, ClockSpan]) -> dict[str, tuple[float, bool]]:
    """Compare clocks with the one nearest to the clock of the host, as by `ClockSpan.ahead_s`."""
    reference = min(clocks.values(), key=lambda clock: abs(clock.delay_s), default=None)
    return {} if reference is None else {
        name: clock.ahead_s(reference) for name, clock in clocks.items()}


def clock_findings(clocks: Mapping[str, ClockSpan]) -> Iterator[Finding]:
    """Report wrong units of timestamps, and clocks that differ from those of other sensors."""
    for name, (ahead_s, differs) in clock_differences(clocks).items():
        clock = clocks[name]
        if clock.wrong_unit is not None:
            yield Finding(True, name, clock.wrong_unit,
                          'correct the unit of the timestamps in the driver',
                          Cause.MILLISECOND_STAMPS)
            continue
        if 0 < clock.last_ns < EARLIEST_DATE_S * NS < clock.last_received_ns:
            differs = abs(ahead_s) > MAX_BOOT_DIFFERENCE_S
            yield Finding(
                differs, name, 'its timestamps count from the start of its device (the latest '
                f'is {clock.last_ns / NS:.4g} s)' + (', and differ by '
                f'{ahead_s:+.4g} s from those of other sensors' if differs else ''),
                'let the driver use the time of arrival, or add the time of the start',
                Cause.BOOT_STAMPS)
        elif differs:
            yield Finding(True, name, f'its timestamps differ by {ahead_s:+.4g} s from '
                          'the timestamps of other sensors', 'synchronise its clock (chrony, PTP); '
                          'knocks correct only offsets below half a second',
                          Cause.CLOCK_DIFFERS)


def timestamp_finding(sensor: str, fault: timestamps.TimestampFault) -> Finding:
    """Convert a fault of timestamps to a finding, serious if its error exceeds `MAX_ERROR_S`."""
    is_serious, text = fault.error_s > timestamps.MAX_ERROR_S, fault.text
    if is_serious and np.isfinite(fault.error_s):
        text += (f'; the timestamps are wrong by up to {1e3 * fault.error_s:.0f} ms, which makes '
                 'tracks ambiguous')
    cause, advice = CAUSES[fault.error]
    return Finding(is_serious, sensor, text, advice, cause)


class TimestampMonitor:
    """Examines the timestamps of several sensors while their readings arrive."""

    def __init__(self, names: tuple[str, ...]) -> None:
        n = len(names)
        self._index = {name: j for j, name in enumerate(names)}
        self._buffer = ReadingBuffer(n, UPDATE_INTERVAL)
        self._stamps: list[IntArray] = [np.zeros(0, dtype=np.int64)] * n
        self._fields: list[FloatArray] = [np.zeros((0, 3))] * n
        self._worst: dict[int, timestamps.TimestampFault] = {}
        self._longest_s: FloatArray = np.zeros(n)
        self._doubtful_times: list[DoubtfulTimes] = [()] * n
        self._differing: set[str] = set()

    def add(self, rows: IntArray, stamps: IntArray, fields: FloatArray) -> None:
        """Add readings; `rows` are sensor indices, and negative ones are skipped."""
        i = 0
        while (i := self._buffer.add(rows, stamps, fields, 0, i)) < len(rows):
            self._examine(int(rows[i]))

    def _examine(self, j: int) -> None:
        """Examine the latest readings of sensor `j`, and update its doubtful times."""
        fault, first_ns = self._latest_fault(j), int(self._buffer.peek(j)[0][0])
        stamps, fields, _ = self._buffer.pop(j)
        self._stamps[j] = np.append(self._stamps[j], stamps)[-timestamps.WINDOW:]
        self._fields[j] = np.append(self._fields[j], fields, axis=0)[-timestamps.WINDOW:]
        if fault is not None:
            self._worst[j] = fault.after(self._worst.get(j))
        else:
            interval_s = timestamps.latest_interval_s(self._stamps[j])
            self._longest_s[j] = max(self._longest_s[j], interval_s)
        times = self._doubtful_times[j]
        self._doubtful_times[j] = doubtful_since(times, first_ns) \
            if fault is not None and fault.error_s > timestamps.MAX_ERROR_S \
            else updated(times, int(stamps[-1]), False)

    def _latest_fault(self, j: int) -> timestamps.TimestampFault | None:
        """Fault in the latest readings of sensor `j`, including those in the buffer."""
        stamps, fields, _ = self._buffer.peek(j)
        return timestamps.timestamp_fault(
            np.append(self._stamps[j], stamps)[-timestamps.WINDOW:],
            np.append(self._fields[j], fields, axis=0)[-timestamps.WINDOW:])

    def compare_clocks(self, clocks: Mapping[str, ClockSpan]) -> None:
        """Mark all timestamps of sensors whose clocks differ from those of other sensors now."""
        self._differing = {
            name for name, (_, differs) in clock_differences(clocks).items() if differs}

    def doubtful_times(self) -> dict[str, DoubtfulTimes]:
        """Intervals in which timestamps were wrong by over `MAX_ERROR_S`, by sensor."""
        out = {name: self._doubtful_times[j] for name, j in self._index.items()
               if self._doubtful_times[j]}
        return {**out, **dict.fromkeys(self._differing, ((0, None),))}

    def worst_fault(self, sensor: str) -> timestamps.TimestampFault | None:
        """Fault of a sensor with the largest error so far."""
        j = self._index[sensor]
        latest, worst = self._latest_fault(j), self._worst.get(j)
        return worst if latest is None else latest.after(worst)

    def lowest_rate(self, sensor: str) -> float:
        """Lowest rate [Hz] of a sensor without faults of the timestamps; inf if unknown."""
        j = self._index[sensor]
        stamps = np.append(self._stamps[j], self._buffer.peek(j)[0])
        latest_s = timestamps.latest_interval_s(stamps) if self.worst_fault(sensor) is None else 0.0
        longest_s = max(float(self._longest_s[j]), latest_s)
        return 1.0 / longest_s if longest_s else float('inf')
