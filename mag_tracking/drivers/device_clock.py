"""The time of measurement, from a device's counter and from when its messages came.

A message comes after a fixed shortest delay and a random, always positive one. So
all points (device time, arrival - device time) lie above a line, whose slope is the
drift of the device's oscillator. The line under all points of the last minutes that
is closest to them on average is the estimate: the edge of their lower convex hull
over their mean abscissa.

Source: Moon, Skelly & Towsley, 'Estimation and removal of clock skew from network
delay measurements', IEEE INFOCOM 1999. Departures: of each short block of device
time only the lowest point is kept, the window slides, and of the slopes about as
likely as the best the one nearest to the slope before is taken. For exponential
delays Moon's line is the most likely, and one that is lower by a K-th of the mean
height of K points above it is e times less so; slopes within that are about as likely.
"""

import math
from collections import Counter, deque
from dataclasses import dataclass

from mag_tracking.drivers.lower_line import Point, likely_slopes
from mag_tracking.errors import SettingsError
from mag_tracking.settings import param

NO_TICKS = 'readings without a device time'
OUTSIDE = 'stamps outside the counter'
NO_FIT = 'stamps that fit no clock'

RESET = 'resets of the device'
FORWARD = 'steps forward'
BACK = 'steps back'
LOST = 'long times without a reading that fits'

_MAX_BLOCKS = 64
_MIN_BLOCK = 1.0 / 16.0
"""The first blocks of an epoch, as a part of the later ones."""
_FEWEST_POINTS = 5
"""With fewer than these only the height of the line is estimated."""
_CONFIRMING = 3
"""Different device times that must agree upon a new clock."""
_EARLY_NS = 1e6
"""How far below the line a message is always believed."""


@dataclass(frozen=True)
class ClockSettings:
    """Settings of a device's clock."""

    tick_s: float = param(
        1e-6, 'Nominal length of a tick; of a sequence number used as a clock, 1 / rate.',
        's', (1e-10, 60.0))
    wrap: int = param(
        2**32, 'Ticks at which the counter goes back to 0; 0 = never.', '', (0, 2**63 - 1))
    min_delay_s: float = param(
        0.0, 'What the quickest message needs from measurement to arrival (bytes over baud rate, '
        'delay of the filter); arrivals alone cannot tell it.', 's', (0.0, 60.0))
    max_delay_s: float = param(
        5.0, 'A message that comes later than this is of a clock that has stepped.',
        's', (0.01, 3600.0))
    min_step_s: float = param(
        0.1, 'Beyond the spread of the delays: a device time that goes back by more than this, or '
        'that stays late by more than this for max_delay_s, is of a clock that has stepped.',
        's', (1e-3, 60.0))
    window_s: float = param(
        120.0, 'Memory of the estimate; for the drift it must hold five readings.',
        's', (1.0, 86400.0))
    max_drift_ppm: float = param(
        500.0, 'The true tick differs from tick_s by no more; crystals stay within 100, the RC '
        'oscillators of cheap boards do not.', 'ppm', (1.0, 50_000.0))


class ArrivalClock:
    """For a device without a counter; otherwise as `DeviceClock`, what is not known NaN."""

    drift_ppm = spread_s = stamp_std = math.nan

    def __init__(self, settings: ClockSettings) -> None:
        self.counts: Counter[str] = Counter()
        self.restarts: Counter[str] = Counter()
        self._shortest_ns = round(settings.min_delay_s * 1e9)

    def stamp(self, ticks: float | None, arrival_ns: int) -> int:
        """`arrival_ns` less the shortest delay, whatever `ticks` is."""
        return arrival_ns - self._shortest_ns


class _Suspect:
    """Readings that may be the beginning of a new clock."""

    def __init__(self, ticks: float, arrival_ns: int, heard_ns: int, near: bool) -> None:
        self.since_ns, self.heard_ns, self._near = arrival_ns, heard_ns, near
        self.first, self.agreeing, self.total, self._fitted = (ticks, arrival_ns), 1, 0, 0
        self._last = ticks

    def add(self, ticks: float, arrival_ns: int, tick_ns: float, wrap: int,
            tolerance_ns: float) -> int:
        """Take a reading; returns how long those that agree have lasted [ns]."""
        first, first_ns = self.first
        span = arrival_ns - first_ns
        turns = round((span / tick_ns - (ticks - first)) / wrap) if wrap else 0
        if abs((ticks - first + turns * wrap) * tick_ns - span) > tolerance_ns:
            self.first, self.agreeing, span = (ticks, arrival_ns), 1, 0
        elif ticks != self._last:
            self.agreeing += 1
        self._last = ticks
        self.total += 1
        return span

    def is_refuted(self) -> bool:
        """Whether a reading that fits the old clock is enough to forget these."""
        # Messages may have become a little quicker, and come between others that have not.
        self._fitted += 1
        return not self._near or self._fitted > 4 * self.total


class DeviceClock:
    """Times of measurement on the host's monotonic clock; one for all sensors of a device.

    Until there are a few points, the line is under the lowest with the nominal tick, or
    with the drift before a restart. A reading that fits no clock has no time. A new one
    begins when three different device times in a row agree upon it, for so long that it
    cannot be a queue that empties; or when nothing has fitted for `window_s`. Of two
    clocks in turn the one that was there first goes on.

    float64 keeps stamps within 1 ns for 30 days, and within 0.1 us for ten years.

    Attributes
    ----------
    counts : Counter
        Readings that got no time, by cause.
    restarts : Counter
        Clocks begun after the first, by cause.
    drift_ppm : float [ppm]
        True over nominal tick, less 1: positive of a slow device. NaN = not yet known.
    spread_s : float [s]
        95 of 100 recent messages came less than this after the quickest; NaN as above.
    stamp_std : float [s]
        How far a stamp may be off by the delays and by a drift that changes: nine in ten
        lowest points of blocks are closer to the line. What min_delay_s is off by
        comes on top. NaN until known, also after a restart.
    """

    def __init__(self, settings: ClockSettings) -> None:
        """Raises SettingsError where the settings contradict each other."""
        self._tick_ns, self._wrap = settings.tick_s * 1e9, settings.wrap
        self._top = settings.wrap or math.inf
        self._shortest_ns = round(settings.min_delay_s * 1e9)
        self._longest_ns = settings.max_delay_s * 1e9
        self._step_ns = self._tolerance_ns = settings.min_step_s * 1e9
        self._window_ns, self._most = settings.window_s * 1e9, settings.max_drift_ppm * 1e-6
        if settings.min_step_s > settings.max_delay_s:
            raise SettingsError(f'min_step_s: {settings.min_step_s:g} s is more than '
                                f'max_delay_s, {settings.max_delay_s:g} s')
        if 0 < settings.wrap * settings.tick_s < 4.0 * settings.min_step_s:
            raise SettingsError(
                f'wrap: the counter goes round in {settings.wrap * settings.tick_s:g} s, less than '
                f'four times min_step_s, {settings.min_step_s:g} s')
        self.counts: Counter[str] = Counter()
        self.restarts: Counter[str] = Counter()
        self.drift_ppm = self.spread_s = self.stamp_std = math.nan
        self._delays: deque[float] = deque(maxlen=256)
        self._slope, self._begun = 0.0, False

    def _begin(self, ticks: float, arrival_ns: int) -> None:
        """Begin a new clock with its first point; what is known of the drift remains."""
        self._ticks, self._arrival_ns, self._last_ns = ticks, arrival_ns, arrival_ns
        self._height = self._middle = self._newest = self._lowest = 0.0
        self._points: list[Point] = []
        self._point: Point = (0.0, 0.0)
        self._block = self._block_end = self._window_ns / _MAX_BLOCKS * _MIN_BLOCK
        self._early_ns, self.stamp_std = self._longest_ns, math.nan
        self._suspect: _Suspect | None = None
        self._begun, self._unsure = True, self._most

    def stamp(self, ticks: float | None, arrival_ns: int) -> int | None:
        """When a reading was measured.

        Parameters
        ----------
        ticks : int or float
            The device's counter, 0 .. wrap; equal and slightly earlier ones are fine.
        arrival_ns : int
            `time.monotonic_ns()` when it came.

        Returns
        -------
        int or None
            Time [ns], at most `arrival_ns` less the shortest delay; None = unknown, counted.
        """
        if ticks is None:
            self.counts[NO_TICKS] += 1
            return None
        if not 0 <= ticks < self._top:
            self.counts[OUTSIDE] += 1
            return None
        if not self._begun:
            self._begin(ticks, arrival_ns)
        elapsed = arrival_ns - self._arrival_ns
        t = self._device_time(ticks, elapsed)
        low = elapsed - t - self._slope * (t - self._middle)
        delay = low - self._height
        fits = (delay <= self._longest_ns and t >= self._newest - self._tolerance_ns
                and (delay >= 0.0 or -delay <= self._earliest(t, arrival_ns)))
        if not fits or delay > self._tolerance_ns + self._unsure * t:
            if self._suspect is None:
                self._suspect = _Suspect(ticks, arrival_ns, self._last_ns,
                                         abs(delay) <= self._tolerance_ns)
            if self._has_stepped(ticks, arrival_ns, fits, self._suspect):
                self._restart(ticks, arrival_ns, delay, self._suspect)
                return arrival_ns - self._shortest_ns
            if not fits:
                self.counts[NO_FIT] += 1
                return None
        elif self._suspect is not None and self._suspect.is_refuted():
            self._suspect = None
        return arrival_ns - self._shortest_ns - self._take(t, elapsed - t, low, arrival_ns)

    def _device_time(self, ticks: float, elapsed: int) -> float:
        """Nominal time since the first reading [ns], by as many turns as the arrival says."""
        count = ticks - self._ticks
        if self._wrap:
            t = (elapsed - self._height + self._slope * self._middle) / (1.0 + self._slope)
            count += round((t / self._tick_ns - count) / self._wrap) * self._wrap
        return count * self._tick_ns

    def _take(self, t: float, offset: float, low: float, arrival_ns: int) -> int:
        """Use a point that fits; returns its delay [ns]."""
        if t >= self._block_end:
            self._close_block(t)
            low = offset - self._slope * (t - self._middle)
        if low < self._lowest:
            self._lowest, self._point = low, (t, offset)
        self._height = min(self._height, low)
        self._newest, self._last_ns = max(self._newest, t), arrival_ns
        self._delays.append(low - self._height)
        return int(low - self._height + 0.5)

    def _earliest(self, t: float, arrival_ns: int) -> float:
        """How far below the line a message is believed [ns]."""
        # The first messages may all have waited, in a port that was opened late.
        if arrival_ns - self._arrival_ns < self._longest_ns:
            return self._longest_ns
        since = t - (self._points[-1][0] if self._points else 0.0)
        return self._early_ns + self._most * since

    def _restart(self, ticks: float, arrival_ns: int, delay: float, suspect: _Suspect) -> None:
        """Begin a new clock where `delay` after the line of the old one was too much."""
        first, first_ns = suspect.first
        silence = first_ns - suspect.heard_ns
        if silence > self._window_ns:
            cause = LOST
        # It was counting from 0 only since it was last heard.
        elif first * self._tick_ns < silence + self._tolerance_ns:
            cause = RESET
        else:
            cause = BACK if delay > 0.0 else FORWARD
        self.restarts[cause] += 1
        self._begin(ticks, arrival_ns)

    def _has_stepped(self, ticks: float, arrival_ns: int, fits: bool,
                     suspect: _Suspect) -> bool:
        """Hold a reading against the clock; whether it is one too many."""
        wait = arrival_ns - suspect.since_ns
        lasted = suspect.add(ticks, arrival_ns, self._tick_ns, self._wrap,
                             self._tolerance_ns + self._most * wait)
        # A queue that empties comes all at once, or in other steps than it was measured.
        needed = self._longest_ns if fits else 2.0 * self._tolerance_ns
        return (suspect.agreeing >= _CONFIRMING and lasted >= needed
                or suspect.total >= _CONFIRMING and wait > self._window_ns)

    def _close_block(self, t: float) -> None:
        """Keep the lowest point of the block that ends, and estimate again."""
        points, longest = self._points, self._window_ns / _MAX_BLOCKS
        points.append(self._point)
        if t - self._newest > self._window_ns:
            self._block = longest * _MIN_BLOCK
        while points[0][0] < t - self._window_ns and len(points) > 1:
            del points[0]
        if len(points) >= _MAX_BLOCKS and self._block < longest:
            self._block *= 2.0
            self._points = points = [min(points[i:i + 2], key=self._above)
                                     for i in range(0, len(points), 2)]
        # A message that overtook another may be the lowest of a later block.
        points.sort()
        self._estimate(points)
        self._block_end, self._lowest = t + self._block, math.inf
        delays = sorted(self._delays)
        self.spread_s = delays[int(0.95 * (len(delays) - 1))] * 1e-9
        # What is late may be of another clock, and must not excuse itself.
        if self._suspect is None:
            self._tolerance_ns = self._step_ns + 2e9 * self.spread_s

    def _above(self, point: Point) -> float:
        """Height of a point above the line [ns]."""
        return point[1] - self._height - self._slope * (point[0] - self._middle)

    def _estimate(self, points: list[Point]) -> None:
        """The line under the points."""
        self._middle = sum(t for t, _ in points) / len(points)
        if len(points) >= _FEWEST_POINTS and points[0][0] < points[-1][0]:
            low, high = likely_slopes(points)
            slope = min(max(self._slope, low), high)
            self._slope = min(max(slope, -self._most), self._most)
            self.drift_ppm = self._slope * 1e6
        self._height = 0.0
        above = sorted(map(self._above, points))
        self._height = above[0]
        if len(points) >= _FEWEST_POINTS:
            error = above[int(0.9 * (len(above) - 1))] - above[0]
            self.stamp_std = error * 1e-9
            self._early_ns, self._unsure = _EARLY_NS + 8.0 * error, 0.0
