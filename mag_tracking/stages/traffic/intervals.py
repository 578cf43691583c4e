"""Counts of passages in time intervals."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from mag_tracking.event_records import TrafficCount, TrafficSummary, VehiclePassage
from mag_tracking.units import NS

MAX_GAP_S = 5.0
"""Maximum time between two frames that counts as observed [s]."""


class TrafficIntervals:
    """Counts passages in time intervals, those that are too late in a later one."""

    def __init__(self, line_names: Sequence[str], interval_s: float,
                 counts: 'Counter[str]') -> None:
        self._names, self._length, self._counts = tuple(line_names), round(interval_s * NS), counts
        # End of the latest interval that has been summarised.
        self._closed_ns: int | None = None
        # Passages in open intervals, each with the start time of its interval [ns].
        self._passages: list[tuple[int, VehiclePassage]] = []
        # Observed time [ns] of each open interval, by its start.
        self._observed: dict[int, int] = {}
        self._last_ns: int | None = None

    def add(self, passage: VehiclePassage) -> None:
        """Add a passage to its interval, or to the earliest open interval if its own is closed."""
        begin = self._begin_of(passage.stamp_ns)
        if self._closed_ns is not None and begin < self._closed_ns:
            self._counts['passages counted in a later interval'] += 1
            begin = self._closed_ns
        self._passages.append((begin, passage))
        self._observed.setdefault(begin, 0)

    def close_until(self, before_ns: int, now_ns: int) -> list[TrafficSummary]:
        """Close and return the intervals that end by `before_ns`, until which all passages have
        been added; `now_ns` is the time of the latest frame."""
        self._observe(now_ns)
        return self._close([begin for begin in self._observed
                            if begin + self._length <= before_ns])

    def flush(self) -> list[TrafficSummary]:
        """Close all open intervals, and return their summaries."""
        self._last_ns = None
        out = self._close(list(self._observed))
        self._closed_ns = None
        return out

    def _begin_of(self, stamp_ns: int) -> int:
        """Start [ns] of the interval that contains a time."""
        return stamp_ns // self._length * self._length

    def _observe(self, now_ns: int) -> None:
        """Add the time since the previous frame to the observed times, split at interval limits."""
        self._observed.setdefault(self._begin_of(now_ns), 0)
        last_ns, self._last_ns = self._last_ns, now_ns
        if last_ns is None or now_ns - last_ns > MAX_GAP_S * NS:
            return
        while last_ns < now_ns:
            begin = self._begin_of(last_ns)
            until = min(now_ns, begin + self._length)
            self._observed[begin] = self._observed.get(begin, 0) + until - last_ns
            last_ns = until

    def _close(self, begins: list[int]) -> list[TrafficSummary]:
        """Remove the intervals that start at `begins` [ns], and return a summary for each line."""
        out: list[TrafficSummary] = []
        for begin in sorted(begins):
            end, observed_s = begin + self._length, self._observed.pop(begin) / NS
            in_interval = [p for first, p in self._passages if first == begin]
            self._passages = [(first, p) for first, p in self._passages if first != begin]
            self._closed_ns = end
            out += [TrafficSummary(begin, end, name, observed_s,
                                   counts_of([p for p in in_interval if p.line == name]))
                    for name in self._names]
        return out


def counts_of(passages: Sequence[VehiclePassage]) -> tuple[TrafficCount, ...]:
    """Count passages by direction and class; counts of the forward direction come first."""
    groups = sorted({(not p.forward, p.vehicle_class) for p in passages})
    out = []
    for backward, name in groups:
        group = [p for p in passages if p.forward is not backward and p.vehicle_class == name]
        headways = [p.headway for p in group if np.isfinite(p.headway)]
        out.append(TrafficCount(not backward, name, len(group), sum(p.ambiguous for p in group),
                                float(np.mean([p.speed for p in group])),
                                float(np.mean(headways)) if headways else float('nan')))
    return tuple(out)
