"""Health: what is wrong with the readings of a sensor, and what to do about it.

It only looks: nothing is changed or held back. Memory is bounded by a window of readings.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.resolution import smallest_steps
from mag_tracking.calibration.saturation import saturated_readings
from mag_tracking.calibration.screening import COARSE, MIN_CHANGES
from mag_tracking.stages.health.window import median_field, noise_of, quantiles
from mag_tracking.units import NEVER, NS

WINDOW = 512
"""Readings that rates, noise and delays are of; the latest."""
EVERY = 64
"""So often they are looked at as a whole."""
STEP_S = 0.25
"""[s] A clock has stepped where a stamp is off by more while the reading came in time."""
REPLAYED_S = 86400.0
"""[s] Older stamps are of a replay (or of another clock: `apps.doctor` compares sensors)."""
LOST = 1.5
"""An interval longer than so many usual ones has lost readings in it."""
IRREGULAR = 0.3
"""Where intervals scatter by more than this share, nobody can count what is lost."""
STUCK_S = 1.0
"""[s] Readings that stay the same for longer are of a sensor that is stuck."""
MOVED = 10.0
"""[steps] A target that moves one axis by so many moves the others by one at least."""
SPIKE = 30.0
"""A reading that is off both its neighbours, the same way, by so many noise deviations."""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong."""

    serious: bool
    """What comes of it is wrong, not only worse."""
    subject: str
    """The sensor, or the stage."""
    what: str
    advice: str

    def __str__(self) -> str:
        return f'{self.subject}: {self.what}; {self.advice}'


class SensorHealth:
    """Looks at the readings of one sensor as they come.

    That is whenever `every` so many have come, and before each answer; or when many are
    given at once.
    """

    def __init__(self, every: int = EVERY) -> None:
        self._every = every
        self._counts: Counter[str] = Counter()
        self._largest_step_s = 0.0
        self._new: list[tuple[int, FloatArray, int]] = []
        self._stamps: IntArray = np.zeros(0, dtype=np.int64)
        self._received: IntArray = np.zeros(0, dtype=np.int64)
        self._fields: FloatArray = np.zeros((0, 3))
        self._interval_ns, self._spread = float('nan'), float('inf')
        self._noise: FloatArray = np.full(3, np.nan)
        # What was made of the window, until new readings are taken into it.
        self._made: dict[str, FloatArray] = {}
        self._delays: list[float] | None = None
        # Since when the reading has been what it is, and how long ago one was stuck.
        self._since_ns: int | None = None
        self._stuck_ago = WINDOW
        # Length of the present run of equal readings, and how often readings were equal to the one
        # before, or were not; of each axis whether it has ever changed.
        self._run, self._repeats, self._changes = 0, 0, 0
        self._has_changed = np.zeros(3, dtype=bool)
        self._steps: FloatArray = np.full(3, np.inf)

    def add(self, stamp_ns: int, field: FloatArray, received_ns: int | None = None) -> None:
        """A reading: `field` (3,) [T] as the sensor gave it; `received_ns` by the host's clock."""
        self._new.append((stamp_ns, field, NEVER if received_ns is None else received_ns))
        if len(self._new) == self._every:
            self.look()

    @property
    def counts(self) -> 'Counter[str]':
        """`readings`, `lost`, `duplicates`, `stamps that went back`, `clock steps`, `spikes`,
        `saturated`, `without any axis`, `stuck readings`; and `x`, `y`, `z` missing."""
        self.look()
        return self._counts

    def look(self) -> None:
        """Take the new readings into the window."""
        if self._new:
            stamps, fields, received = zip(*self._new, strict=True)
            self._new = []
            self.take(np.array(stamps, dtype=np.int64), np.array(fields, dtype=float),
                      np.array(received, dtype=np.int64))

    def take(self, stamps: IntArray, fields: FloatArray, received: IntArray) -> None:
        """Take readings into the window: (n,) [ns], (n, 3) [T], and (n,) [ns] or `NEVER`.

        No more than `WINDOW` at once; they may be changed later. Those of `add` are not waited
        for: it is either the one or the other.
        """
        n, self._made, self._delays = len(stamps), {}, None
        if not n:
            return
        self._stamps = np.append(self._stamps, stamps)[-WINDOW:]
        self._received = np.append(self._received, received)[-WINDOW:]
        self._fields = np.append(self._fields, fields, axis=0)[-WINDOW:]
        self._counts['readings'] += n
        self._in_time(n)
        self._values(n)

    def _in_time(self, n: int) -> None:
        """Count what is wrong with the stamps of the `n` latest."""
        # With the one before them, where there is one.
        intervals = np.diff(self._stamps[-n - 1:])
        known = self._received[-n - 1:] != NEVER
        receipts = np.diff(np.where(known, self._received[-n - 1:], 0)) / NS
        steps = receipts - intervals / NS
        usual = 0.0 if np.isnan(self._interval_ns) else self._interval_ns / NS
        # Of the two the stamp has to be the odd one: a host that stalls, and what it reads in a
        # burst then, are no step.
        stepped = known[1:] & known[:-1] & (np.abs(steps) > STEP_S) \
            & (np.abs(receipts - usual) < STEP_S) & (np.abs(intervals / NS - usual) > STEP_S)
        if stepped.any():
            self._counts['clock steps'] += int(stepped.sum())
            self._largest_step_s = max(self._largest_step_s, *steps[stepped].tolist(), key=abs)
        self._counts['duplicates'] += int((intervals == 0).sum())
        self._counts['stamps that went back'] += int((intervals < 0).sum())
        if self._spread < IRREGULAR:
            long = (intervals > LOST * self._interval_ns) & (intervals < 3600 * NS) & ~stepped
            self._counts['lost'] += int(np.sum(np.round(intervals[long] / self._interval_ns) - 1))
        forward = np.diff(self._stamps)
        forward = forward[forward > 0]
        if len(forward) >= 8:
            self._interval_ns = quantiles(forward, 0.5)[0]
            self._spread = quantiles(np.abs(forward - self._interval_ns), 0.5)[0] \
                / self._interval_ns

    def _values(self, n: int) -> None:
        """Count what is wrong with the fields of the `n` latest."""
        missing = np.isnan(self._fields[-n:])
        for axis, count in zip('xyz', missing.sum(axis=0).tolist(), strict=True):
            self._counts[axis] += count
        self._counts['without any axis'] += int(missing.all(axis=1).sum())
        self._stuck(n)
        # With the two before them; the last one's neighbour is still to come.
        fields = self._fields[-n - 2:]
        before, after = np.diff(fields, axis=0)[:-1], -np.diff(fields, axis=0)[1:]
        self._steps = np.minimum(self._steps, smallest_steps(fields))
        # A comparison with NaN is false: without a known noise there is no spike.
        noise = np.maximum(self._noise, self._steps / np.sqrt(12.0))
        alone = (np.minimum(np.abs(before), np.abs(after)) > SPIKE * noise) & (before * after > 0.0)
        self._counts['spikes'] += int(alone.any(axis=1).sum())
        if self._stuck_ago >= WINDOW:
            self._noise = self._made['noise'] = noise_of(self._fields)
        cut = np.array([saturated_readings(axis) for axis in self._fields.T])[:, -n:]
        self._counts['saturated'] += int(np.count_nonzero(cut.any(axis=0)))

    def _stuck(self, n: int) -> None:
        """Count those of the `n` latest that have been the same for too long."""
        stamps, fields = self._stamps[-n:], self._fields[-n - 1:]
        equal = (fields[1:] == fields[:-1]) | np.isnan(fields[1:]) & np.isnan(fields[:-1])
        self._has_changed |= (~equal & ~np.isnan(fields[1:]) & ~np.isnan(fields[:-1])).any(axis=0)
        same = equal.all(axis=1)
        if len(same) < n:
            same = np.append(False, same)
        # Of each reading the place of the one that it repeats; -1: from before these.
        origin = np.maximum.accumulate(np.where(same, -1, np.arange(n)))
        since = np.where(origin < 0, self._since_ns or 0, stamps[origin])
        stuck = np.flatnonzero(stamps - since > STUCK_S * NS)
        self._since_ns = int(since[-1])
        self._count_runs(same, since, stamps)
        if not self.is_coarse:
            self._counts['stuck readings'] += len(stuck)
        self._stuck_ago = n - 1 - int(stuck[-1]) if len(stuck) else self._stuck_ago + n

    def _count_runs(self, same: BoolArray, since: IntArray, stamps: IntArray) -> None:
        """Count repetitions: (n,) whether a reading equals the one before, since when [ns]."""
        changed = np.flatnonzero(~same)
        if not len(changed):
            self._run += len(same)
            return
        lengths = np.diff(changed) - 1
        lasting = stamps[changed[1:] - 1] - since[changed[1:] - 1] > STUCK_S * NS
        # A run that is a fault says little about what is usual.
        self._repeats += int(np.where(lasting, 1, lengths).sum())
        first = self._run + int(changed[0])
        usual = STUCK_S * NS / self._interval_ns if self._interval_ns > 0 else np.inf
        self._repeats += 1 if first > usual else first
        self._changes += len(changed)
        self._run = len(same) - 1 - int(changed[-1])

    @property
    def is_coarse(self) -> bool:
        """Whether the sensor repeats itself at rest, or has not changed often enough to tell."""
        return self._changes < MIN_CHANGES \
            or self._repeats >= COARSE * (self._repeats + self._changes)

    @property
    def unchanged_since_ns(self) -> int | None:
        """Timestamp since which the reading has been what it is; None without a reading."""
        self.look()
        return self._since_ns

    @property
    def rate(self) -> float:
        """[Hz] of the latest readings; NaN before there are enough."""
        self.look()
        return NS / self._interval_ns

    @property
    def noise_std(self) -> FloatArray:
        """(3,) [T] by differences of neighbours, so that a target that passes is not in it."""
        return self._once('noise', noise_of)

    @property
    def field(self) -> FloatArray:
        """(3,) [T] median of the latest readings; NaN of an axis that none has."""
        return self._once('median', median_field)

    def _once(self, name: str, make: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """`make` of the fields in the window; once, however often it is asked for."""
        self.look()
        if name not in self._made:
            self._made[name] = make(self._fields)
        return self._made[name]

    @property
    def dead_axes(self) -> str:
        """Such as 'xz': axes that have not changed in a window in which another one did.

        Of a sensor with coarse steps those that have never changed, while another one moved by
        more than `MOVED` of its steps.
        """
        self.look()
        if len(self._fields) < WINDOW:
            return ''
        there = ~np.isnan(self._fields).any(axis=0)
        still = there & (self._fields == self._fields[0]).all(axis=0)
        if self.is_coarse:
            moved = np.ptp(self._fields, axis=0) > MOVED * smallest_steps(self._fields)
            still &= ~self._has_changed & (moved & there).any()
        return ''.join(np.array(list('xyz'))[still]) if still.sum() < there.sum() else ''

    @property
    def delay_s(self) -> list[float]:
        """(median, 5 %, 95 %) [s] from stamp to receipt; NaN where receipts are not known."""
        self.look()
        if self._delays is None:
            known = self._received != NEVER
            delays = (self._received - self._stamps)[known] / NS
            self._delays = quantiles(delays, 0.5, 0.05, 0.95)
        return self._delays

    def findings(self, name: str, noise_std: FloatArray | None = None,
                 max_field: float = 1e-3, is_live: bool = True) -> list[Finding]:
        """What is wrong, the worst first: list of `Finding`.

        Parameters
        ----------
        name : str
            Of the sensor.
        noise_std : (3,) [T], optional
            That it was calibrated to.
        max_field : float [T]
            Beyond this it is rejected.
        is_live : bool
            False for a recording that is played, perhaps over and over: its clock is no fault.
        """
        n = self.counts['readings']
        if not n:
            return [Finding(True, name, 'no reading', 'look at its cable, its driver and the topic '
                            'in the network file')]
        found = [*(self._clock_findings(name) if is_live else ()),
                 *self._time_findings(name, n), *self._value_findings(name, n, max_field)]
        if noise_std is not None and not np.nanmax(np.abs(self.field), initial=0.0) > max_field:
            worse = self.noise_std / noise_std
            if np.nanmax(worse, initial=0.0) > 3.0:
                axis = int(np.nanargmax(worse))
                found.append(Finding(False, name, f'{"xyz"[axis]} is {worse[axis]:.0f} times as '
                                     'noisy as it was calibrated', 'look for a new source beside '
                                     'it (a motor, a cable), or calibrate anew'))
        return sorted(found, key=lambda f: not f.serious)

    def _clock_findings(self, name: str) -> Iterator[Finding]:
        """Faults of the clock."""
        if n := self.counts['clock steps']:
            yield Finding(True, name, f'its clock stepped {n} times against the '
                          f'host\'s, by up to {self._largest_step_s:+.2f} s', 'let the clocks '
                          'follow one source (chrony, PTP), and stamp by a monotonic one')
        if n := self.counts['stamps that went back']:
            yield Finding(True, name, f'stamps went back {n} times',
                          'two publishers on one topic, a clock that was set, or a looped replay')

    def _time_findings(self, name: str, n: int) -> Iterator[Finding]:
        """Faults of the timestamps."""
        c = self.counts
        middle, low, high = self.delay_s
        if c['duplicates'] > 0.001 * n:
            yield Finding(False, name, f'{c["duplicates"]} of {n} readings have the stamp of the '
                          'one before', 'the driver publishes readings twice, or stamps too '
                          'coarsely')
        if c['lost'] > 0.01 * n:
            yield Finding(c['lost'] > 0.2 * n, name, f'{c["lost"]} readings are missing between '
                          f'{n}', 'look at the link, and at the queue of whoever records')
        if c['clock steps'] or abs(middle) > REPLAYED_S:
            return
        if high - low > 0.05:
            yield Finding(False, name, f'readings take {1e3 * low:.0f} to {1e3 * high:.0f} ms to '
                          'come', 'stamps by the sensor itself would be truer than by receipt')
        elif abs(middle) > 1.0:
            yield Finding(False, name, f'stamps are {middle:.1f} s before they are received',
                          'the clocks of sensor and host disagree; calibrate with knocks')

    def _value_findings(self, name: str, n: int, max_field: float) -> Iterator[Finding]:
        """What is wrong with fields."""
        c = self.counts
        size = float(np.sqrt(np.nansum(self.field**2)))
        if size > max_field:
            yield Finding(True, name, f'a field of {size:.3g} T is rejected, the limit is '
                          f'{max_field:g} T', 'gauss or microtesla published as tesla? Near a '
                          'magnet raise calibrate.max_field')
        if c['without any axis'] > 0.01 * n:
            yield Finding(True, name, f'{c["without any axis"]} of {n} readings have no axis at '
                          'all', 'look at the sensor and its driver')
        for axis in self.dead_axes:
            yield Finding(True, name, f'{axis} does not change', 'the axis is dead: look at the '
                          'sensor and its driver')
        for axis in 'xyz':
            if 0.01 * n < c[axis] - c['without any axis'] and c[axis] < 0.99 * n:
                yield Finding(False, name, f'{axis} is missing in {c[axis]} of {n} readings',
                              'look at the sensor and its driver')
        if c['stuck readings']:
            yield Finding(True, name, f'{c["stuck readings"]} readings are the same as all for '
                          f'more than {STUCK_S:g} s before', 'the sensor or its driver is stuck: '
                          'switch it off and on')
        if c['saturated'] > 0.001 * n:
            yield Finding(True, name, f'{c["saturated"]} of {n} readings stand at the end of the '
                          'range', 'set a larger range, or move the sensor away')
        if c['spikes'] > 0.001 * n:
            yield Finding(False, name, f'{c["spikes"]} of {n} readings are spikes', 'look at '
                          'plugs, supply and checksums')
