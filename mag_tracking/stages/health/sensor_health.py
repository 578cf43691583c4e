"""Health: detect faults in the readings of a sensor, and advise how to fix them."""

from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration import reading_faults, timestamps
from mag_tracking.calibration.sensor_state import COARSE_FRACTION, MIN_CHANGES, smallest_steps
from mag_tracking.quantities import occurrences
from mag_tracking.stages.health.clocks import ClockSpan, timestamp_finding
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.health.window import median_field, quantiles, sample_noise_std
from mag_tracking.units import NEVER, NS

WINDOW = 512
"""Number of latest readings from which rates, noise and delays are computed."""
UPDATE_INTERVAL = 64
"""Number of new readings after which the statistics are updated."""
CLOCK_STEP_S = 0.25
"""[s] Minimum jump of a timestamp that counts as a clock step if the time of receipt is regular."""
MAX_LIVE_DELAY_S = 86400.0
"""[s] Maximum age of live timestamps. Older timestamps come from a replay or an unsynchronised
clock; `apps.doctor` compares the clocks of the sensors."""
GAP_RATIO = 1.5
"""Readings are counted as lost if the ratio of an interval to the median interval exceeds this."""
MAX_JITTER = 0.3
"""Maximum relative deviation of the intervals up to which lost readings are counted."""
STUCK_S = 1.0
"""[s] A sensor is stuck if its readings are identical for longer than this."""
MIN_STUCK_READINGS = 8
"""A slow sensor is stuck if more than this number of readings are identical."""
MAX_PLATEAU_S = 0.5
"""[s] Maximum time for which a target that passes saturates a sensor."""
MIN_MOVED_STEPS = 10.0
"""Steps by which a target that changes an axis changes every other axis by a step."""
SPIKE_STD = 30.0
"""Minimum difference of a spike from its neighbours, in stds (see `isolated_readings`)."""


class SensorHealth:
    """Monitors the latest readings of one sensor, without the marks and repetitions of `faults`;
    statistics are updated every `update_interval` readings, and for each batch or query."""

    def __init__(self, update_interval: int = UPDATE_INTERVAL,
                 faults: reading_faults.ReadingFaults = reading_faults.NO_FAULTS) -> None:
        self.faults, self._update_interval = faults, update_interval
        self._counts: Counter[str] = Counter()
        self._largest_step_s = 0.0
        self._buffered: list[tuple[int, FloatArray, int]] = []
        self._stamps: IntArray = np.zeros(0, dtype=np.int64)
        self._received: IntArray = np.zeros(0, dtype=np.int64)
        self._field_stamps: IntArray = np.zeros(0, dtype=np.int64)
        self._raw_fields: FloatArray = np.zeros((0, 3))
        # Latest reading; window of the readings without marks and repetitions.
        self._latest: FloatArray = np.zeros((0, 3))
        self._fields: FloatArray = np.zeros((0, 3))
        self._is_saturated: BoolArray = np.zeros(0, dtype=bool)
        self._interval_ns, self._jitter = float('nan'), float('inf')
        self._timestamp_fault: timestamps.TimestampFault | None = None
        self._noise: FloatArray = np.full(3, np.nan)
        # Results for the current window; cleared when readings are added.
        self._cache: dict[str, FloatArray] = {}
        self._delays: list[float] | None = None
        # Start of the current run of identical readings; number of readings after a stuck one.
        self._unchanged_since_ns: int | None = None
        self._n_since_stuck = WINDOW
        # Length of the current run; repeated and changed readings; axes that have ever changed.
        self._run_length, self._n_repeated, self._n_changed = 0, 0, 0
        self._has_changed = np.zeros(3, dtype=bool)
        self._steps: FloatArray = np.full(3, np.inf)

    def add(self, stamp_ns: int, field: FloatArray, received_ns: int | None = None) -> None:
        """Add a reading, without calibration; `received_ns` is by the clock of the host."""
        self._buffered.append((stamp_ns, field, NEVER if received_ns is None else received_ns))
        if len(self._buffered) == self._update_interval:
            self.update()

    @property
    def counts(self) -> 'Counter[str]':
        """Numbers of `readings`, of missing axes (`x`, `y`, `z`), and of faults: `lost`,
        `duplicates`, `backward timestamps`, `clock steps`, `spikes`, `saturated`, `without any
        axis`, `stuck readings`."""
        self.update()
        return self._counts

    def update(self) -> None:
        """Add the buffered readings to the window, and update the statistics."""
        if self._buffered:
            stamps, fields, received = zip(*self._buffered, strict=True)
            self._buffered = []
            self.add_batch(np.array(stamps, dtype=np.int64), np.array(fields, dtype=float),
                           np.array(received, dtype=np.int64))

    def add_batch(self, stamps: IntArray, fields: FloatArray, received: IntArray) -> None:
        """Add at most `WINDOW` readings directly to the window, with times of receipt or `NEVER`,
        and update the statistics; not together with `add`."""
        n, self._cache, self._delays = len(stamps), {}, None
        if not n:
            return
        self._stamps = np.append(self._stamps, stamps)[-WINDOW:]
        self._received = np.append(self._received, received)[-WINDOW:]
        self._raw_fields = np.append(self._raw_fields, fields, axis=0)[-timestamps.WINDOW:]
        self._counts['readings'] += n
        self._check_timestamps(n)
        missing = np.isnan(fields)
        for axis, count in zip('xyz', missing.sum(axis=0).tolist(), strict=True):
            self._counts[axis] += count
        self._counts['without any axis'] += int(missing.all(axis=1).sum())
        kept = self.faults.without(np.append(self._latest, fields, axis=0))[-n:]
        kept = np.where(np.isinf(kept), np.nan, kept)
        self._latest = fields[-1:].copy()
        is_kept = ~np.isnan(kept).all(axis=1) | missing.all(axis=1)
        self._field_stamps = np.append(self._field_stamps, stamps[is_kept])[-WINDOW:]
        self._fields = np.append(self._fields, kept[is_kept], axis=0)[-WINDOW:]
        if is_kept.any():
            self._check_fields(int(is_kept.sum()))

    def _check_timestamps(self, n: int) -> None:
        """Count the faults in the timestamps of the `n` latest readings."""
        # The first interval begins at the preceding reading, if there is one.
        intervals = np.diff(self._stamps[-n - 1:])
        self._counts['duplicates'] += int((intervals == 0).sum())
        self._counts['backward timestamps'] += int((intervals < 0).sum())
        fault = timestamps.timestamp_fault(self._stamps[-timestamps.WINDOW:], self._raw_fields)
        if fault is not None:
            # The intervals of such timestamps show neither lost readings nor clock steps.
            self._timestamp_fault = fault.after(self._timestamp_fault)
            self._interval_ns, self._jitter = fault.interval_s * NS, float('inf')
            return
        is_received = self._received[-n - 1:] != NEVER
        receipts = np.diff(np.where(is_received, self._received[-n - 1:], 0)) / NS
        steps = receipts - intervals / NS
        median_s = 0.0 if np.isnan(self._interval_ns) else self._interval_ns / NS
        # In a clock step, the timestamp is irregular but the time of receipt is regular. A host
        # that stalls and then reads a burst causes no step.
        is_step = is_received[1:] & is_received[:-1] & (np.abs(steps) > CLOCK_STEP_S) \
            & (np.abs(receipts - median_s) < CLOCK_STEP_S) \
            & (np.abs(intervals / NS - median_s) > CLOCK_STEP_S)
        if is_step.any():
            self._counts['clock steps'] += int(is_step.sum())
            self._largest_step_s = max(self._largest_step_s, *steps[is_step].tolist(), key=abs)
        if self._jitter < MAX_JITTER:
            # Intervals like the latest ones are those of another rate.
            latest_ns = timestamps.latest_interval_s(self._stamps) * NS
            is_other_rate = (latest_ns > GAP_RATIO * self._interval_ns) \
                & (np.abs(intervals - latest_ns) < 0.2 * latest_ns)
            gaps = self._are_gaps(intervals) & (intervals < 3600 * NS) & ~is_step & ~is_other_rate
            self._counts['lost'] += int(np.sum(np.round(intervals[gaps] / self._interval_ns) - 1))
        forward = np.diff(self._stamps)
        forward = forward[forward > 0]
        if len(forward) >= 8:
            self._interval_ns = quantiles(forward, 0.5)[0]
            self._jitter = quantiles(np.abs(forward - self._interval_ns), 0.5)[0] \
                / self._interval_ns

    def _are_gaps(self, intervals: IntArray) -> BoolArray:
        """Whether intervals [ns] lack readings; the adjacent ones may compensate delays."""
        n, dt = len(intervals), self._interval_ns
        nearby = np.concatenate([[dt], np.diff(self._stamps), [dt]])[-n - 2:]
        spans = nearby[:-2] + intervals + nearby[2:]
        are_gaps: BoolArray = (intervals > GAP_RATIO * dt) & (spans > (2.0 + GAP_RATIO) * dt)
        return are_gaps

    def _check_fields(self, n: int) -> None:
        """Count the faults in the fields of the `n` latest readings."""
        self._check_stuck(n)
        # A spike is found two readings later, with the two readings before it.
        fields = self._fields[-n - 4:]
        self._steps = np.minimum(self._steps, smallest_steps(fields))
        # A comparison with NaN is false: while the noise is unknown, no spikes are counted.
        noise = np.maximum(self._noise, self._steps / np.sqrt(12.0))
        spikes = list(map(reading_faults.isolated_readings, fields.T, SPIKE_STD * noise))
        self._counts['spikes'] += len(np.unique(np.concatenate(spikes)))
        if self._n_since_stuck >= WINDOW:
            self._noise = self._cache['noise'] = sample_noise_std(self._fields)
        # A limit is recognised only after the excursion.
        known = np.append(self._is_saturated, np.zeros(n, dtype=bool))[-len(self._fields):]
        self._is_saturated = known | reading_faults.saturated_readings(
            self._fields, MAX_PLATEAU_S * NS / self._interval_ns).any(axis=1)
        self._counts['saturated'] += int(np.count_nonzero(self._is_saturated & ~known))

    def _check_stuck(self, n: int) -> None:
        """Count the stuck readings among the `n` latest readings."""
        stamps, fields = self._field_stamps[-n:], self._fields[-n - 1:]
        equal = (fields[1:] == fields[:-1]) | np.isnan(fields[1:]) & np.isnan(fields[:-1])
        self._has_changed |= (~equal & ~np.isnan(fields[1:]) & ~np.isnan(fields[:-1])).any(axis=0)
        is_repeated = equal.all(axis=1)
        if len(is_repeated) < n:
            is_repeated = np.append(False, is_repeated)
        # Index of the first reading of each run of identical readings; -1 = in an earlier batch.
        run_start = np.maximum.accumulate(np.where(is_repeated, -1, np.arange(n)))
        unchanged_since = np.where(run_start < 0, self._unchanged_since_ns or 0, stamps[run_start])
        min_duration = np.nanmax([STUCK_S * NS, MIN_STUCK_READINGS * self._interval_ns])
        stuck = np.flatnonzero(stamps - unchanged_since > min_duration)
        self._unchanged_since_ns = int(unchanged_since[-1])
        self._count_runs(is_repeated, unchanged_since, stamps)
        if not self.is_coarse:
            self._counts['stuck readings'] += len(stuck)
        self._n_since_stuck = n - 1 - int(stuck[-1]) if len(stuck) else self._n_since_stuck + n

    def _count_runs(self, is_repeated: BoolArray, unchanged_since: IntArray,
                    stamps: IntArray) -> None:
        """Count repeated and changed readings, with the starts [ns] of equal runs."""
        changed = np.flatnonzero(~is_repeated)
        if not len(changed):
            self._run_length += len(is_repeated)
            return
        lengths = np.diff(changed) - 1
        is_stuck = stamps[changed[1:] - 1] - unchanged_since[changed[1:] - 1] > STUCK_S * NS
        # A faulty run counts as one repetition, because it is not representative.
        self._n_repeated += int(np.where(is_stuck, 1, lengths).sum())
        first = self._run_length + int(changed[0])
        max_length = STUCK_S * NS / self._interval_ns if self._interval_ns > 0 else np.inf
        self._n_repeated += 1 if first > max_length else first
        self._n_changed += len(changed)
        self._run_length = len(is_repeated) - 1 - int(changed[-1])

    @property
    def is_coarse(self) -> bool:
        """Whether the sensor repeats readings at rest, or readings changed too rarely to decide."""
        return self._n_changed < MIN_CHANGES \
            or self._n_repeated >= COARSE_FRACTION * (self._n_repeated + self._n_changed)

    @property
    def unchanged_since_ns(self) -> int | None:
        """Timestamp [ns] since which the reading has not changed; None before the first reading."""
        self.update()
        return self._unchanged_since_ns

    @property
    def rate(self) -> float:
        """Sampling rate [Hz] from the median interval of the window; NaN for too few readings."""
        self.update()
        return NS / self._interval_ns

    @property
    def noise_std(self) -> FloatArray:
        """Noise std (3,) [T], as by `sample_noise_std`."""
        return self._cached('noise', sample_noise_std)

    @property
    def field(self) -> FloatArray:
        """Median of the latest readings, (3,) T; NaN for a missing axis."""
        return self._cached('median', median_field)

    def _cached(self, name: str, compute: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Return the cached result of `compute` for the fields in the window."""
        self.update()
        if name not in self._cache:
            self._cache[name] = compute(self._fields)
        return self._cache[name]

    @property
    def dead_axes(self) -> str:
        """Axes, such as 'xz', that did not change within the window (with coarse resolution: ever)
        although another axis changed."""
        self.update()
        if len(self._fields) < WINDOW:
            return ''
        present = ~np.isnan(self._fields).any(axis=0)
        unchanged = present & (self._fields == self._fields[0]).all(axis=0)
        if self.is_coarse:
            moves = np.ptp(self._fields, axis=0) > MIN_MOVED_STEPS * smallest_steps(self._fields)
            unchanged &= ~self._has_changed & (moves & present).any()
        return ''.join(np.array(list('xyz'))[unchanged]) if unchanged.sum() < present.sum() else ''

    @property
    def clock(self) -> ClockSpan | None:
        """Timestamps and times of receipt of the window; None if no time of receipt is known."""
        self.update()
        is_received = self._received != NEVER
        return ClockSpan.of(self._stamps[is_received], self._received[is_received]) \
            if is_received.any() else None

    @property
    def delay_s(self) -> list[float]:
        """Delay [s] from timestamp to receipt: median, 5 % and 95 % quantiles; NaN if unknown."""
        self.update()
        if self._delays is None:
            is_received = self._received != NEVER
            delays = (self._received - self._stamps)[is_received] / NS
            self._delays = quantiles(delays, 0.5, 0.05, 0.95)
        return self._delays

    def findings(self, name: str, noise_std: FloatArray | None = None,
                 max_field: float = 1e-3, is_live: bool = True) -> list[Finding]:
        """Faults of the sensor `name`, without ranking; `noise_std` (3,) [T] is that of the
        calibration, and clocks are checked only if `is_live`."""
        n = self.counts['readings']
        if not n:
            return [Finding(True, name, 'no reading', 'check its cable, its driver and the topic '
                            'in the network file', Cause.NO_MESSAGES)]
        found = [*self._time_findings(name, n, is_live), *self._value_findings(name, n, max_field)]
        if noise_std is not None and not np.nanmax(np.abs(self.field), initial=0.0) > max_field:
            noise_ratio = self.noise_std / noise_std
            if np.nanmax(noise_ratio, initial=0.0) > 3.0:
                axis = int(np.nanargmax(noise_ratio))
                found.append(Finding(False, name, f'{"xyz"[axis]} is {noise_ratio[axis]:.0f} times '
                                     'as noisy as at its calibration', 'look for a new source of '
                                     'interference nearby (a motor, a cable), or calibrate again',
                                     Cause.NOISY))
        return found

    def _time_findings(self, name: str, n: int, is_live: bool) -> Iterator[Finding]:
        """Yield findings about timestamps, lost readings and delays."""
        c, (median, low, high) = self.counts, self.delay_s
        if c['clock steps'] and is_live:
            yield Finding(True, name, f'its clock stepped {occurrences(c["clock steps"])} relative '
                          f'to the host, by up to {self._largest_step_s:+.2f} s', 'synchronise the '
                          'clocks (chrony, PTP), and take timestamps from a monotonic clock',
                          Cause.CLOCK_STEPPED)
        if c['backward timestamps'] and is_live:
            yield Finding(True, name, 'timestamps went back '
                          f'{occurrences(c["backward timestamps"])}', 'check for two publishers on '
                          'one topic, a clock that was set, or a looped replay',
                          Cause.BACKWARD_STAMPS)
        if self._timestamp_fault is not None:
            yield timestamp_finding(name, self._timestamp_fault)
        if c['duplicates'] > 0.001 * n:
            yield Finding(False, name, f'{c["duplicates"]} of {n} readings repeat the previous '
                          'timestamp', 'check whether the driver publishes readings twice, or '
                          'whether its timestamps are too coarse', Cause.DUPLICATE_STAMPS)
        if c['lost'] > 0.01 * n:
            yield Finding(c['lost'] > 0.2 * n, name, f'{c["lost"]} readings were lost, {n} were '
                          'received', 'check the link, and the queue size of the recorder',
                          Cause.LOST)
        if c['clock steps'] or abs(median) > MAX_LIVE_DELAY_S:
            return
        # On a slow computer the delay of a wrong clock varies, too.
        if abs(median) > 1.0 and high - low < 0.1 * abs(median):
            yield Finding(False, name, f'the delay from timestamp to receipt is {median:.1f} s',
                          'synchronise the clocks of sensor and host (chrony, PTP)', Cause.DELAYED)
        elif high - low > 0.05:
            yield Finding(False, name, f'readings take {1e3 * low:.0f} to {1e3 * high:.0f} ms to '
                          'arrive', 'use timestamps of the sensor instead of the time of receipt',
                          Cause.DELAY_VARIES)

    def _value_findings(self, name: str, n: int, max_field: float) -> Iterator[Finding]:
        """Yield findings about the values and the axes of the readings."""
        c = self.counts
        largest = float(np.nanmax(np.abs(self.field), initial=0.0))
        if largest > max_field:
            yield Finding(True, name, f'a field component of {largest:.3g} T exceeds the limit of '
                          f'{max_field:g} T', 'check the unit (gauss or microtesla published as '
                          'tesla?), or near a magnet raise calibrate.max_field', Cause.WRONG_UNIT)
        if c['without any axis'] > 0.01 * n:
            yield Finding(True, name, f'{c["without any axis"]} of {n} readings have no valid '
                          'axis', 'check the sensor and its driver', Cause.NO_AXIS)
        if dead := self.dead_axes:
            verb = 'does' if len(dead) == 1 else 'do'
            yield Finding(True, name, f'{" and ".join(dead)} {verb} not change', 'the axis is '
                          'dead: check the sensor and its driver', Cause.DEAD_AXIS)
        if missing := ', '.join(f'{axis} is missing in {c[axis]}' for axis in 'xyz'
                                if 0.01 * n < c[axis] - c['without any axis']
                                and c[axis] < 0.99 * n):
            yield Finding(False, name, f'{missing} of {n} readings',
                          'check the sensor and its driver', Cause.MISSING_AXIS)
        if c['stuck readings']:
            yield Finding(True, name, f'{c["stuck readings"]} readings are identical to all '
                          f'readings of the previous {STUCK_S:g} s',
                          'the sensor or its driver is stuck: restart it', Cause.STUCK)
        if c['saturated'] > 0.001 * n:
            yield Finding(True, name, f'{c["saturated"]} of {n} readings are at the end of the '
                          'range of the sensor', 'select a larger measuring range, or move the '
                          'sensor further away from the targets', Cause.SATURATED)
        if c['spikes'] > 0.001 * n:
            yield Finding(False, name, f'{c["spikes"]} of {n} readings are spikes', 'check '
                          'connectors, power supply and checksums', Cause.SPIKES)
