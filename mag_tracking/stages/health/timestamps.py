"""Examination of the timestamps of all sensors, and findings about their faults."""

from collections.abc import Mapping

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration.doubtful_times import DoubtfulTimes, doubtful_since, updated
from mag_tracking.calibration.timestamps import (
    MAX_ERROR_S,
    WINDOW,
    TimestampError,
    TimestampFault,
    latest_interval_s,
    timestamp_fault,
)
from mag_tracking.stages.health.clocks import ClockSpan, clock_differences
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.health.reading_buffer import ReadingBuffer

UPDATE_INTERVAL = 64
"""Number of new readings of a sensor after which its timestamps are examined again."""

CAUSES = {
    TimestampError.ZERO: (Cause.ZERO_STAMPS, 'set the timestamps in the driver'),
    TimestampError.COARSE: (
        Cause.COARSE_STAMPS, 'let the driver set timestamps of a finer resolution'),
    TimestampError.PACKET: (
        Cause.PACKET_STAMPS, 'let the driver set the timestamp of each reading'),
    TimestampError.BURST: (
        Cause.BURST_STAMPS, 'let the driver set the time of measurement instead of the time of '
        'arrival'),
    TimestampError.UNIT: (
        Cause.MILLISECOND_STAMPS, 'correct the unit of the timestamps in the driver')}
"""Cause and remedy of each error of timestamps."""


def timestamp_finding(sensor: str, fault: TimestampFault) -> Finding:
    """Convert a fault of timestamps to a finding, serious if its error exceeds `MAX_ERROR_S`."""
    is_serious, text = fault.error_s > MAX_ERROR_S, fault.text
    if is_serious and np.isfinite(fault.error_s):
        text += (f'; the timestamps are wrong by up to {1e3 * fault.error_s:.0f} ms, which makes '
                 'tracks ambiguous')
    cause, advice = CAUSES[fault.error]
    return Finding(is_serious, sensor, text, advice, cause)


class TimestampMonitor:
    """Examines the timestamps of several sensors while their readings arrive.

    The result does not depend on how the readings are split into batches.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        n = len(names)
        self._index = {name: j for j, name in enumerate(names)}
        self._buffer = ReadingBuffer(n, UPDATE_INTERVAL)
        self._stamps: list[IntArray] = [np.zeros(0, dtype=np.int64)] * n
        self._fields: list[FloatArray] = [np.zeros((0, 3))] * n
        self._worst: dict[int, TimestampFault] = {}
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
        self._stamps[j] = np.append(self._stamps[j], stamps)[-WINDOW:]
        self._fields[j] = np.append(self._fields[j], fields, axis=0)[-WINDOW:]
        if fault is not None:
            self._worst[j] = fault.after(self._worst.get(j))
        else:
            self._longest_s[j] = max(self._longest_s[j], latest_interval_s(self._stamps[j]))
        times = self._doubtful_times[j]
        self._doubtful_times[j] = doubtful_since(times, first_ns) \
            if fault is not None and fault.error_s > MAX_ERROR_S \
            else updated(times, int(stamps[-1]), False)

    def _latest_fault(self, j: int) -> TimestampFault | None:
        """Fault in the latest readings of sensor `j`, including those in the buffer."""
        stamps, fields, _ = self._buffer.peek(j)
        return timestamp_fault(np.append(self._stamps[j], stamps)[-WINDOW:],
                               np.append(self._fields[j], fields, axis=0)[-WINDOW:])

    def compare_clocks(self, clocks: Mapping[str, ClockSpan]) -> None:
        """Mark all timestamps of sensors whose clocks differ from those of other sensors.

        The clocks replace those of the previous call.
        """
        self._differing = {
            name for name, (_, differs) in clock_differences(clocks).items() if differs}

    def doubtful_times(self) -> dict[str, DoubtfulTimes]:
        """Intervals in which timestamps were wrong by over `MAX_ERROR_S`, by sensor."""
        out = {name: self._doubtful_times[j] for name, j in self._index.items()
               if self._doubtful_times[j]}
        return {**out, **dict.fromkeys(self._differing, ((0, None),))}

    def worst_fault(self, sensor: str) -> TimestampFault | None:
        """Fault of a sensor with the largest error so far."""
        j = self._index[sensor]
        latest, worst = self._latest_fault(j), self._worst.get(j)
        return worst if latest is None else latest.after(worst)

    def lowest_rate(self, sensor: str) -> float:
        """Lowest rate [Hz] of a sensor without faults of the timestamps; inf if unknown."""
        j = self._index[sensor]
        stamps = np.append(self._stamps[j], self._buffer.peek(j)[0])
        latest_s = latest_interval_s(stamps) if self.worst_fault(sensor) is None else 0.0
        longest_s = max(float(self._longest_s[j]), latest_s)
        return 1.0 / longest_s if longest_s else float('inf')
