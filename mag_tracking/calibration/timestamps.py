"""Timestamps that are not the times of the readings: coarse clocks, packets, bursts and zeros."""

import enum
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.units import NS

WINDOW, MIN_READINGS = 256, 16
"""Maximum and minimum number of latest readings that are examined together."""
N_INTERVALS = 8
"""Number of latest intervals that determine the rate."""
MAX_ERROR_S = 0.02
"""[s] Error of the timestamps above which tracks are ambiguous. A car at 20 m/s moves 0.4 m."""
MAX_REGULAR_RATIO = 1.4
"""Ratio of the longest to the shortest interval below which timestamps have none of the errors."""
MIN_SHARED = 0.1
"""Minimum fraction of readings that share the timestamp of a different reading."""
MIN_IN_BURSTS = 0.45
"""Minimum fraction of short intervals; it is 0.5 if readings arrive in pairs."""
MAX_BURST_INTERVAL_NS = 4_000_000
"""[ns] Maximum interval within a burst: a line of text takes 3 ms at 115,200 baud."""
SHORT_RATIO = 0.35
"""Maximum ratio of a short interval to the mean interval."""
MAX_INTERVAL_STEPS = 3
"""Maximum interval between readings, in steps of the clock, that the clock makes irregular."""
ROUND_STEPS_NS = np.array([m * 10**k for k in range(5, 10) for m in (1, 2, 4, 5)] + [16_666_667])
"""[ns] Steps of coarse clocks; other steps are those of packets."""


class TimestampError(enum.Enum):
    """Kind of a regular error of timestamps."""

    ZERO = enum.auto()
    """All timestamps are zero."""
    COARSE = enum.auto()
    """The clock has steps."""
    PACKET = enum.auto()
    """Several readings have the timestamp of their packet."""
    BURST = enum.auto()
    """Several readings have the timestamp of their common arrival."""
    UNIT = enum.auto()
    """The nanoseconds are written in another unit."""


@dataclass(frozen=True)
class TimestampFault:
    """Regular difference between the timestamps and the times of the readings."""

    error: TimestampError
    text: str
    error_s: float
    """Largest error of a timestamp [s]."""
    interval_s: float
    """Mean interval between readings [s]; NaN if unknown."""

    def after(self, earlier: 'TimestampFault | None') -> 'TimestampFault':
        """Worse of this and an earlier fault of the sensor; this one if both are of one kind."""
        return self if earlier is None or self.error is earlier.error \
            or self.error_s >= earlier.error_s else earlier


def timestamp_fault(stamps: IntArray, fields: FloatArray) -> TimestampFault | None:
    """Find a regular error in the timestamps (n,) [ns] of consecutive readings of one sensor,
    except of those that were published twice."""
    if len(stamps) < MIN_READINGS:
        return None
    intervals = np.diff(stamps)
    if 0 < intervals.max() < MAX_REGULAR_RATIO * intervals.min():
        return None
    if np.count_nonzero(intervals < 0) > 0.02 * len(intervals):
        return None
    is_changed = ((fields[1:] != fields[:-1]) & ~np.isnan(fields[1:] + fields[:-1])).any(axis=1)
    n_shared = np.count_nonzero((intervals == 0) & is_changed)
    n_equal = np.count_nonzero(intervals == 0)
    if n_shared >= max(MIN_SHARED * len(intervals), 0.2 * n_equal, 2):
        return _shared_fault(stamps, intervals)
    if n_equal:
        stamps = stamps[np.append(True, intervals != 0)]
        intervals = np.diff(stamps)
    if len(stamps) < MIN_READINGS:
        return None
    return _burst_fault(stamps, intervals) or _coarse_fault(stamps, intervals)


def _shared_fault(stamps: IntArray, intervals: IntArray) -> TimestampFault:
    """Fault of timestamps (n,) [ns] of which several are equal."""
    if not stamps.any():
        return TimestampFault(TimestampError.ZERO, 'all timestamps are 0', np.inf, np.nan)
    n, period_s, interval_s = _groups(intervals == 0, stamps)
    error_s = period_s * (n - 1) / n if n > 1 else period_s / 2.0
    shared = f'{n} readings share one' if n > 1 else 'some readings share one'
    if not (stamps % NS).any():
        return TimestampFault(TimestampError.COARSE, f'its timestamps are whole seconds: {shared}',
                              float(np.fmax(error_s, 0.5)), interval_s)
    if not intervals.any():
        return TimestampFault(TimestampError.PACKET, 'all timestamps are equal', np.inf, np.nan)
    step_ns = int(np.gcd.reduce(intervals))
    if _is_coarse_step(stamps, step_ns) and period_s * NS <= 2 * step_ns:
        return TimestampFault(TimestampError.COARSE, f'its timestamps have steps of '
                              f'{step_ns / NS:g} s: {shared}', error_s, interval_s)
    return TimestampFault(TimestampError.PACKET, f'{n} readings share a timestamp: packets of '
                          f'{period_s:.3g} s', error_s, interval_s)


def _burst_fault(stamps: IntArray, intervals: IntArray) -> TimestampFault | None:
    """Fault of timestamps (n,) [ns] that are close together within bursts."""
    mean_ns = float(stamps[-1] - stamps[0]) / len(intervals)
    is_short = intervals <= min(MAX_BURST_INTERVAL_NS, SHORT_RATIO * mean_ns)
    if np.count_nonzero(is_short) < MIN_IN_BURSTS * len(intervals):
        return None
    n, period_s, interval_s = _groups(is_short, stamps)
    for limit_ns, unit in ((1_000, 'milliseconds'), (1_000_000, 'microseconds')):
        if (stamps % NS).max() < limit_ns:
            return TimestampFault(TimestampError.UNIT, 'the nanoseconds of its timestamps are '
                                  f'{unit}', 1.0, interval_s)
    if np.isnan(interval_s) or n < 2:
        return None
    return TimestampFault(
        TimestampError.BURST, f'its readings arrive in bursts of {n}, {1.0 / interval_s:.3g} Hz on '
        'average', period_s * (n - 1) / n, interval_s)


def _coarse_fault(stamps: IntArray, intervals: IntArray) -> TimestampFault | None:
    """Fault of timestamps (n,) [ns] that are different multiples of the step of a coarse clock,
    without a lost reading that moves the later ones."""
    step_ns = int(np.gcd.reduce(intervals))
    if step_ns < 2.0 * MAX_ERROR_S * NS or not _is_coarse_step(stamps, step_ns) \
            or np.median(intervals) > MAX_INTERVAL_STEPS * step_ns:
        return None
    counts = np.unique(intervals, return_counts=True)[1]
    k = np.arange(len(stamps))
    residual = stamps - stamps[0] - (stamps[-1] - stamps[0]) / k[-1] * k
    if len(counts) < 2 or np.sort(counts)[-2] < MIN_SHARED * len(intervals) \
            or np.ptp(residual) > 1.5 * step_ns:
        return None
    text = 'are whole seconds' if step_ns % NS == 0 else f'have steps of {step_ns / NS:g} s'
    return TimestampFault(TimestampError.COARSE, f'its timestamps {text}', step_ns / NS / 2.0,
                          float(intervals.mean()) / NS)


def _is_coarse_step(stamps: IntArray, step_ns: int) -> bool:
    """Whether all timestamps are multiples of a step of a clock, such as 10 ms."""
    return bool((np.abs(ROUND_STEPS_NS - step_ns) <= 1).any()) and not (stamps % step_ns).any()


def _groups(is_joined: BoolArray, stamps: IntArray) -> tuple[int, float, float]:
    """Median size and period [s] of groups of readings, and mean interval [s] between readings.

    `is_joined` (n - 1,) marks the readings that belong to the group of the previous one. The first
    and last group may be incomplete and are not used if there are others.
    """
    first = np.flatnonzero(np.append(True, ~is_joined))
    sizes = np.diff(np.append(first, len(stamps)))
    if len(sizes) < 3:
        period_s = float(np.ptp(stamps)) / NS or float('inf')
        return int(sizes.max()), period_s, float('nan')
    period_s = float(np.median(np.diff(stamps[first]))) / NS
    complete = first[1:]
    return round(float(np.median(sizes[1:-1]))), period_s, \
        float(np.ptp(stamps[complete])) / NS / int(complete[-1] - complete[0])


def latest_interval_s(stamps: IntArray) -> float:
    """Median [s] of the latest intervals of `stamps` (n,) [ns], robust to a few lost readings; 0 if
    there are too few."""
    intervals = np.diff(stamps[-N_INTERVALS - 1:])
    return max(float(np.median(intervals)) / NS, 0.0) if len(intervals) == N_INTERVALS else 0.0
