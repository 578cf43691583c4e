"""Estimation of measurement times from a device's counter and its messages' arrival times.

A message arrives after a fixed minimum delay plus a random, non-negative delay. All points
(device time, arrival - device time) therefore lie above a line whose slope is the drift of the
device's oscillator. The estimate is the line under all points of the window that is closest to
them on average: the edge of their lower convex hull that contains their mean abscissa.

Source: Moon, Skelly & Towsley, 'Estimation and removal of clock skew from network delay
measurements', IEEE INFOCOM 1999. Differences: only the lowest point of each short block of device
time is kept; the window slides; and the estimated slope is the slope nearest to the previous
estimate among all slopes that are about as likely as the best slope. If the delays are exponential,
Moon's line is the maximum-likelihood line. Lowering a line by 1/K of the mean height of the K
points above it reduces its likelihood by a factor of e. Slopes within that range are considered
about as likely.
"""

import itertools
import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from mag_tracking.drivers.reading import DeviceDate
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param
from mag_tracking.units import NS, TIME_UNITS, unit_since_1970

Point: TypeAlias = tuple[float, float]


def lower_hull(points: Sequence[Point]) -> list[Point]:
    """Vertices of the lower convex hull; points and vertices ascend in x, then y."""
    hull: list[Point] = []
    for x, y in points:
        while len(hull) > 1:
            (u, v), (w, z) = hull[-2:]
            if (w - u) * (y - v) > (z - v) * (x - u):
                break
            hull.pop()
        hull.append((x, y))
    return hull


def slope_range(points: Sequence[Point]) -> tuple[float, float]:
    """Smallest and largest slope about as likely as that of the best line under the points.

    At least three points ascend in x, then y, with at least two values of x. Both slopes are equal
    if all points are on the best line.
    """
    hull = lower_hull(points)
    middle = sum(x for x, _ in points) / len(points)
    for (u, v), (x, y) in itertools.pairwise(hull):
        if x >= middle:
            slope = (y - v) / (x - u)
            height = v + slope * (middle - u)
            break
    # Two points are always on the line. The median is insensitive to stalls of the link.
    heights = sorted(y - height - slope * (x - middle) for x, y in points)[2:]
    floor = height - heights[len(heights) // 2] / math.log(2.0) / len(points)
    low = max((y - floor) / (x - middle) for x, y in hull if x < middle)
    high = min((y - floor) / (x - middle) for x, y in hull if x > middle)
    return min(low, slope), max(high, slope)


NO_TICKS = 'readings without a device time'
OUT_OF_RANGE = 'device times outside the counter range'
NO_FIT = 'device times that do not fit the clock'
STANDING = 'device times that hardly advance, replaced by the time of arrival'

RESET = 'device resets'
STEP_FORWARD = 'device clock steps forward'
STEP_BACK = 'device clock steps back'
LOST = 'clock restarts after a long interval without a fitting reading'

_MAX_BLOCKS = 64
_MIN_BLOCK_FRACTION = 1.0 / 16.0
"""Length of the first blocks after a start, as a fraction of the final block length."""
_MIN_POINTS = 5
"""Minimum number of points for estimating the slope; with fewer, only the height is estimated."""
_MIN_AGREEING = 3
"""Minimum number of different device times that must agree before a new clock starts."""
_MIN_STANDING_RUNS = 3
"""Minimum number of consecutive intervals longer than `min_step_s` in which a clock stands."""
_MIN_ADVANCE = 0.01
"""Minimum advance of the device time relative to the time of arrival."""
_EARLY_TOLERANCE_NS = 1e6
"""[ns] Distance below the line up to which a message is always accepted."""


@dataclass(frozen=True)
class ClockSettings:
    """Settings of a device's clock."""

    tick_s: float = param(
        1e-6, 'Nominal duration of a tick. With `stamp_by: sequence`, set it to 1 / sampling rate.',
        's', (1e-10, 60.0))
    wrap: int = param(
        2**32, 'Number of ticks at which the counter returns to 0; 0 if it never does.', '',
        (0, 2**63 - 1))
    min_delay_s: float = param(
        0.0, 'Delay of the fastest message from measurement to arrival (transmission time, '
        'filter delay). It is not observable from arrival times.', 's', (0.0, 60.0))
    max_delay_s: float = param(
        5.0, 'Maximum delay of a message. A message delayed by more indicates a step of the device '
        'clock.', 's', (0.01, 3600.0))
    min_step_s: float = param(
        0.1, 'Minimum detectable clock step, in addition to the spread of the delays. The '
        'device clock is considered to have stepped if a device time goes back by more, or remains '
        'late by more for max_delay_s.', 's', (1e-3, 60.0))
    window_s: float = param(
        120.0, 'Length of the estimation window. The drift is estimated only if at least five '
        'readings are in the window.', 's', (1.0, 86400.0))
    max_drift_ppm: float = param(
        500.0, 'Maximum relative error of tick_s. Crystals stay within 100 ppm, unlike the RC '
        'oscillators of low-cost boards.', 'ppm', (1.0, 50_000.0))


class ArrivalClock:
    """Clock that timestamps readings by their arrival, with the interface of `DeviceClock`."""

    drift_ppm = spread_s = stamp_std = math.nan

    def __init__(self, settings: ClockSettings) -> None:
        self.counts: Counter[str] = Counter()
        self.restarts: Counter[str] = Counter()
        self.examples: dict[str, str] = {}
        self._min_delay_ns = round(settings.min_delay_s * 1e9)

    def stamp(self, ticks: float | None, arrival_ns: int) -> int:
        """Monotonic time of arrival minus the minimum delay, ns."""
        return arrival_ns - self._min_delay_ns


class _ClockCandidate:
    """Candidate for a new clock: readings that do not fit the present clock."""

    def __init__(self, ticks: float, arrival_ns: int, last_fit_ns: int, is_near: bool) -> None:
        self.since_ns, self.last_fit_ns, self._is_near = arrival_ns, last_fit_ns, is_near
        self.first, self.agreeing, self.total, self._n_fitted = (ticks, arrival_ns), 1, 0, 0
        self._last = ticks

    def add(self, ticks: float, arrival_ns: int, tick_ns: float, wrap: int,
            tolerance_ns: float) -> int:
        """Add a reading; return the time since the first agreeing reading [ns]."""
        first, first_ns = self.first
        span = arrival_ns - first_ns
        n_wraps = round((span / tick_ns - (ticks - first)) / wrap) if wrap else 0
        if abs((ticks - first + n_wraps * wrap) * tick_ns - span) > tolerance_ns:
            self.first, self.agreeing, span = (ticks, arrival_ns), 1, 0
        elif ticks != self._last:
            self.agreeing += 1
        self._last = ticks
        self.total += 1
        return span

    def is_refuted(self) -> bool:
        """Count a reading that fits the old clock; return whether to discard the candidate."""
        # Slightly faster messages may alternate with messages of unchanged delay.
        self._n_fitted += 1
        return not self._is_near or self._n_fitted > 4 * self.total


class _StandingClock:
    """Detects device times that do not advance with the readings: whole seconds, a wrong tick."""

    def __init__(self, settings: ClockSettings) -> None:
        self._limits_ns = settings.min_step_s * 1e9, settings.max_delay_s * 1e9
        self._tick_ns = settings.tick_s * 1e9
        self._ticks, self._first_ns, self._last_ns, self._n_runs = math.nan, 0, 0, 0

    def add(self, ticks: float, arrival_ns: int) -> bool:
        """Add a reading; return whether the clock stands too long."""
        min_step_ns, max_delay_ns = self._limits_ns
        run_ns = arrival_ns - self._first_ns
        # The counter may wrap any number of times during a pause.
        has_paused = arrival_ns - self._last_ns > max_delay_ns
        if has_paused or not abs(ticks - self._ticks) * self._tick_ns <= _MIN_ADVANCE * run_ns:
            is_long = self._last_ns - self._first_ns > min_step_ns
            self._n_runs = self._n_runs + 1 if is_long else 0
            self._ticks, self._first_ns, run_ns = ticks, arrival_ns, 0
        self._last_ns = arrival_ns
        return self._n_runs >= _MIN_STANDING_RUNS or run_ns > max_delay_ns


def _advice(ticks: float, tick_ns: float) -> str:
    unit = unit_since_1970(ticks)
    if isinstance(ticks, DeviceDate) or unit and TIME_UNITS[unit] == tick_ns:
        return f'{ticks:.15g}: send decimals of the second, or set stamp_by: arrival'
    if unit:
        return (f'{ticks:.15g}: it is a time in {unit} since 1970; set clock: '
                f'{{tick_s: {TIME_UNITS[unit] / NS:g}, wrap: 0}}')
    return (f'{ticks:.15g}: set clock: {{tick_s: ..., wrap: ...}} to the length of a tick and the '
            'number of ticks at which the counter returns to 0 (0 = never)')


class DeviceClock:
    """Estimates times of measurement on the host's monotonic clock, for all sensors of a device.

    Until a few points are available, the line passes through the lowest point, with the nominal
    tick or with the drift estimated before a restart. A reading that does not fit the clock gets no
    timestamp. A new clock starts when three consecutive different device times agree on it for
    longer than the delivery of queued messages could explain, or when no reading has fitted the old
    clock for `window_s`. If readings of two clocks alternate, the older clock is kept. The rounding
    error of float64 is below 1 ns for 30 days, and below 0.1 µs for ten years.

    Attributes
    ----------
    counts : number of readings without a timestamp, by cause
    restarts : number of clocks started after the first, by cause
    examples : first device time and what to change, by cause; the dict is replaced, never changed
    drift_ppm : ratio of the true to the nominal tick, minus 1, ppm; positive for a slow device
    spread_s : 95th percentile of the delays of recent messages, relative to the fastest
    stamp_std : error of a timestamp [s] due to delays and changes of the drift, without that of
        `min_delay_s`: 90th percentile of the height of the lowest points above the line
    """

    def __init__(self, settings: ClockSettings) -> None:
        self._tick_ns, self._wrap = settings.tick_s * 1e9, settings.wrap
        self._counter_limit = settings.wrap or math.inf
        self._min_delay_ns = round(settings.min_delay_s * 1e9)
        self._max_delay_ns = settings.max_delay_s * 1e9
        self._step_ns = self._tolerance_ns = settings.min_step_s * 1e9
        self._window_ns, self._max_drift = settings.window_s * 1e9, settings.max_drift_ppm * 1e-6
        if settings.min_step_s > settings.max_delay_s:
            raise SettingsError(f'min_step_s: {settings.min_step_s:g} s is longer than '
                                f'max_delay_s, {settings.max_delay_s:g} s')
        if 0 < settings.wrap * settings.tick_s < 4.0 * settings.min_step_s:
            raise SettingsError(
                f'wrap: the counter wraps every {settings.wrap * settings.tick_s:g} s; expected at '
                f'least {4.0 * settings.min_step_s:g} s, four times min_step_s')
        self.counts: Counter[str] = Counter()
        self.restarts: Counter[str] = Counter()
        self.drift_ppm = self.spread_s = self.stamp_std = math.nan
        self._delays: deque[float] = deque(maxlen=256)
        self._slope, self._has_begun = 0.0, False
        self.examples: dict[str, str] = {}
        self._standing = _StandingClock(settings)

    def _begin(self, ticks: float, arrival_ns: int) -> None:
        """Start a new clock at its first point, with the previous drift estimate."""
        self._ticks, self._arrival_ns, self._last_ns = ticks, arrival_ns, arrival_ns
        self._height = self._middle = self._newest = self._lowest = 0.0
        self._points: list[Point] = []
        self._lowest_point: Point = (0.0, 0.0)
        self._block_length = self._block_end = self._window_ns / _MAX_BLOCKS * _MIN_BLOCK_FRACTION
        self._early_tolerance_ns, self.stamp_std = self._max_delay_ns, math.nan
        self._candidate: _ClockCandidate | None = None
        self._has_begun, self._drift_bound = True, self._max_drift

    def stamp(self, ticks: float | None, arrival_ns: int) -> int | None:
        """Update the clock with a reading; return its monotonic measurement time, ns, at most
        `arrival_ns` minus the minimum delay, or None."""
        if ticks is None:
            self.counts[NO_TICKS] += 1
            return None
        if not 0 <= ticks < self._counter_limit:
            self._count(OUT_OF_RANGE, ticks)
            return None
        if self._standing.add(ticks, arrival_ns):
            self._count(STANDING, ticks)
            return arrival_ns - self._min_delay_ns
        if not self._has_begun:
            self._begin(ticks, arrival_ns)
        elapsed = arrival_ns - self._arrival_ns
        t = self._device_time(ticks, elapsed)
        detrended = elapsed - t - self._slope * (t - self._middle)
        delay = detrended - self._height
        fits = (delay <= self._max_delay_ns and t >= self._newest - self._tolerance_ns
                and (delay >= 0.0 or -delay <= self._early_limit(t, arrival_ns)))
        if not fits or delay > self._tolerance_ns + self._drift_bound * t:
            if self._candidate is None:
                self._candidate = _ClockCandidate(ticks, arrival_ns, self._last_ns,
                                                  abs(delay) <= self._tolerance_ns)
            if self._has_stepped(ticks, arrival_ns, fits, self._candidate):
                self._restart(ticks, arrival_ns, delay, self._candidate)
                return arrival_ns - self._min_delay_ns
            if not fits:
                self.counts[NO_FIT] += 1
                return None
        elif self._candidate is not None and self._candidate.is_refuted():
            self._candidate = None
        return arrival_ns - self._min_delay_ns - self._add_point(
            t, elapsed - t, detrended, arrival_ns)

    def _count(self, cause: str, ticks: float) -> None:
        if cause not in self.examples:
            self.examples = {**self.examples, cause: _advice(ticks, self._tick_ns)}
        self.counts[cause] += 1

    def _device_time(self, ticks: float, elapsed: int) -> float:
        """Nominal time since the first reading [ns]; the arrival time resolves counter wraps."""
        count = ticks - self._ticks
        if self._wrap:
            t = (elapsed - self._height + self._slope * self._middle) / (1.0 + self._slope)
            count += round((t / self._tick_ns - count) / self._wrap) * self._wrap
        return count * self._tick_ns

    def _add_point(self, t: float, offset: float, detrended: float, arrival_ns: int) -> int:
        """Add a point that fits the clock; return its delay relative to the line [ns]."""
        if t >= self._block_end:
            self._close_block(t)
            detrended = offset - self._slope * (t - self._middle)
        if detrended < self._lowest:
            self._lowest, self._lowest_point = detrended, (t, offset)
        self._height = min(self._height, detrended)
        self._newest, self._last_ns = max(self._newest, t), arrival_ns
        self._delays.append(detrended - self._height)
        return int(detrended - self._height + 0.5)

    def _early_limit(self, t: float, arrival_ns: int) -> float:
        """Maximum distance below the line at which a message is accepted [ns]."""
        # All first messages may have been delayed in the buffer of a port that was opened late.
        if arrival_ns - self._arrival_ns < self._max_delay_ns:
            return self._max_delay_ns
        elapsed = t - (self._points[-1][0] if self._points else 0.0)
        return self._early_tolerance_ns + self._max_drift * elapsed

    def _restart(self, ticks: float, arrival_ns: int, delay: float,
                 candidate: _ClockCandidate) -> None:
        """Start a new clock and count the cause; `delay` is relative to the old line [ns]."""
        first, first_ns = candidate.first
        silence = first_ns - candidate.last_fit_ns
        if silence > self._window_ns:
            cause = LOST
        # The counter started at 0 after the last fitting reading.
        elif first * self._tick_ns < silence + self._tolerance_ns:
            cause = RESET
        else:
            cause = STEP_BACK if delay > 0.0 else STEP_FORWARD
        self.restarts[cause] += 1
        self._begin(ticks, arrival_ns)

    def _has_stepped(self, ticks: float, arrival_ns: int, fits: bool,
                     candidate: _ClockCandidate) -> bool:
        """Add a reading to the candidate; return whether the device clock has stepped."""
        wait = arrival_ns - candidate.since_ns
        duration = candidate.add(ticks, arrival_ns, self._tick_ns, self._wrap,
                                 self._tolerance_ns + self._max_drift * wait)
        # Queued messages arrive all at once, or at intervals unlike the measurement intervals.
        min_duration = self._max_delay_ns if fits else 2.0 * self._tolerance_ns
        return (candidate.agreeing >= _MIN_AGREEING and duration >= min_duration
                or candidate.total >= _MIN_AGREEING and wait > self._window_ns)

    def _close_block(self, t: float) -> None:
        """Store the lowest point of the completed block; update the line and the tolerance."""
        points, longest = self._points, self._window_ns / _MAX_BLOCKS
        points.append(self._lowest_point)
        if t - self._newest > self._window_ns:
            self._block_length = longest * _MIN_BLOCK_FRACTION
        while points[0][0] < t - self._window_ns and len(points) > 1:
            del points[0]
        if len(points) >= _MAX_BLOCKS and self._block_length < longest:
            self._block_length *= 2.0
            self._points = points = [min(points[i:i + 2], key=self._height_above)
                                     for i in range(0, len(points), 2)]
        # A message that overtook another may be the lowest point of a later block.
        points.sort()
        self._update_line(points)
        self._block_end, self._lowest = t + self._block_length, math.inf
        delays = sorted(self._delays)
        self.spread_s = delays[int(0.95 * (len(delays) - 1))] * 1e-9
        # Late messages of a new clock must not widen the tolerance by which they are detected.
        if self._candidate is None:
            self._tolerance_ns = self._step_ns + 2e9 * self.spread_s

    def _height_above(self, point: Point) -> float:
        """Height of a point above the line [ns]."""
        return point[1] - self._height - self._slope * (point[0] - self._middle)

    def _update_line(self, points: list[Point]) -> None:
        """Estimate the height and slope of the line under the points, and the timestamp error."""
        self._middle = sum(t for t, _ in points) / len(points)
        if len(points) >= _MIN_POINTS and points[0][0] < points[-1][0]:
            min_slope, max_slope = slope_range(points)
            slope = min(max(self._slope, min_slope), max_slope)
            self._slope = min(max(slope, -self._max_drift), self._max_drift)
            self.drift_ppm = self._slope * 1e6
        self._height = 0.0
        heights = sorted(map(self._height_above, points))
        self._height = heights[0]
        if len(points) >= _MIN_POINTS:
            error = heights[int(0.9 * (len(heights) - 1))] - heights[0]
            self.stamp_std = error * 1e-9
            self._early_tolerance_ns, self._drift_bound = _EARLY_TOLERANCE_NS + 8.0 * error, 0.0
