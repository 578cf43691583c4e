"""Calibrate: check readings, subtract the background, and attach the noise covariance."""

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from mag_tracking.arrays import FloatArray, Record, are_equal
from mag_tracking.calibration import core, doubtful_times
from mag_tracking.calibration.agreement import SurveySettings
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.decimation import Decimator
from mag_tracking.calibration.frequent_level import MostFrequentLevel
from mag_tracking.calibration.level_change import SharedChanges
from mag_tracking.calibration.reading_faults import ReadingFaults
from mag_tracking.calibration.sensor_state import clear_spikes, new_sensors
from mag_tracking.errors import NetworkError
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Readings, plain
from mag_tracking.stages.calibrate import rejections
from mag_tracking.stages.calibrate.field_comparison import FieldComparison
from mag_tracking.stages.calibrate.output_buffer import OutputBuffer
from mag_tracking.stages.health.clocks import ClockSpan, TimestampMonitor, corrected
from mag_tracking.stages.health.diagnosis import Cause
from mag_tracking.stages.settings import CalibrateSettings
from mag_tracking.stages.stage import MAX_BACKWARD_JUMP_S
from mag_tracking.units import NEVER, NS

MEMORY_S = 20.0
"""[s] Duration of the quiet interval to which level, drift and noise are fitted."""
GUARD_S = 1.5
"""[s] Delay before a reading is included in the background, which excludes slow approaches."""
BLOCK_S = 0.25
"""[s] Duration of a block. The quietness of a sensor is evaluated block by block."""
FREEZE_STD = 2.0
"""Deviation of the mean of a block that freezes the background, in noise stds."""
MAX_FORWARD_JUMP_S = 60.0
"""[s] Maximum forward jump of a timestamp, unless the next timestamp confirms it."""
MAX_SYNCHRONOUS = 16
"""Maximum number of sensors whose blocks may end at the same time. In larger networks, the blocks
are staggered, because evaluating all blocks at once would delay the readings."""
FAULTS_FOUND = 'faults of drivers found'
"""Key in the counts for the events after which `driver_faults` are others."""


@dataclass(frozen=True)
class StoredBackground:
    """Stored background of one sensor, to be restored after a restart."""

    stamp_ns: int
    background: FloatArray
    """(3,) T, sensor frame. NaN for an axis that is not reported."""
    covariance: FloatArray
    """Noise covariance of one sample, (3, 3) T², sensor frame."""


class Calibrate:
    """Subtracts the background from raw readings, and attaches a noise covariance.

    The corrections in the network file are applied first; the field remains in the sensor frame.
    The covariance is that of the reading (unless the measured noise contradicts it), that of the
    network file, or an estimate. The rules are in `calibration/readings.hpp`; this class handles
    the events that the compiled code reports. `rejections` are {sensor: {(cause, description):
    number}}.
    """

    def __init__(self, network: SensorNetwork, settings: CalibrateSettings,
                 background_type: type[RunningBackground] = RunningBackground,
                 survey: SurveySettings | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self.rejections = {name: Counter[tuple[Cause, str]]() for name in network.names}
        self.settings, self._sensors = settings, new_sensors(len(network))
        self._batches = np.zeros(1, core.BATCH)
        self.driver_faults = rejections.DriverFaults(network.names, self._sensors)
        self._limits = np.array([(
            settings.max_field, MAX_FORWARD_JUMP_S * NS, MAX_BACKWARD_JUMP_S * NS,
            settings.reject_stuck, settings.spike_std, settings.decimate_to_hz > 0.0,
            settings.trust_covariances)], core.LIMITS)
        self._causes = {**rejections.REJECTIONS, core.TOO_LARGE: (
            Cause.TOO_LARGE, f'above {settings.max_field:g} T (gauss or microtesla published as '
            'tesla?)')}
        self._network, self._background_type = network, background_type
        self._index = {name: i for i, name in enumerate(network.names)}
        self._background: dict[str, RunningBackground] = {}
        self._changes = SharedChanges()
        self._stored: dict[str, StoredBackground] = {}
        self.timestamps = TimestampMonitor(network.names)
        self.comparison = FieldComparison(network, survey or SurveySettings())
        self.update_network(network)

    def update_network(self, network: SensorNetwork) -> None:
        """Apply a new calibration of the same sensors, and learn changed backgrounds again; raises
        NetworkError if their names differ."""
        if network.names != tuple(self._index):
            raise NetworkError(f'the new network has the sensors {", ".join(network.names)}; '
                               f'expected {", ".join(self._index)}')
        previous, self._network = self._network if self._background else None, network
        self.comparison.use(network)
        self._decimators = {name: Decimator(self.settings.decimate_to_hz) for name in network.names}
        for i, name in enumerate(network.names):
            is_unchanged = previous is not None \
                and are_equal(previous.offset[i], network.offset[i]) \
                and are_equal(previous.correction[i], network.correction[i])
            shift = int(self._sensors[i]['clock_offset_ns'] - network.clock_offset_ns[i])
            if previous is not None and (not is_unchanged or shift):
                self._stored.pop(name, None)
            if not is_unchanged or shift:
                self._reject_held(i, 'the calibration changed')
            if not is_unchanged:
                self._background[name] = self._new_background(i)
            self._configure(i, shift)
        self._mark_restorable()

    def _configure(self, i: int, shift: int) -> None:
        """Apply the network file to sensor `i`; add `shift` [ns] to its stored timestamps."""
        s, network = self._sensors[i], self._network
        for name in ('first_ns', 'last_ns', 'unconfirmed_ns'):
            if s[name] != NEVER:
                s[name] += shift
        background = self._background[network.names[i]]
        background.doubtful_times = doubtful_times.shifted(background.doubtful_times, shift)
        self.comparison.shift(network.names[i], shift)
        offset, correction = network.offset[i], network.correction[i]
        s['clock_offset_ns'] = network.clock_offset_ns[i]
        s['offset'] = 0.0 if offset is None else offset
        s['has_correction'] = correction is not None
        s['correction'] = np.eye(3) if correction is None else correction

    def _new_background(self, i: int) -> RunningBackground:
        """Create the background estimator of sensor `i` from the settings and the network file."""
        s, network = self.settings, self._network
        return self._background_type(
            s.learn_s, MEMORY_S, GUARD_S, BLOCK_S, FREEZE_STD, s.relearn_s,
            network.background[i], network.noise_std[i],
            phase=i / len(network) if len(network) > MAX_SYNCHRONOUS else None,
            sensors=self._sensors[i:i + 1],
            evaluate_change=partial(self._changes.evaluate_change, i))

    def unready(self) -> list[str]:
        """Names of the sensors whose background is not known yet."""
        return [name for name, b in self._background.items() if not b.ready]

    def input_doubts(self) -> dict[str, dict[str, doubtful_times.DoubtfulTimes]]:
        """{reason: {sensor: intervals}} in which backgrounds or timestamps were doubtful."""
        out = {doubtful_times.DOUBTFUL_BACKGROUND: {
                   n: b.doubtful_times for n, b in self._background.items() if b.doubtful_times},
               doubtful_times.CONTRADICTS_EARTH_FIELD: self.comparison.doubtful_times(),
               doubtful_times.WRONG_TIMESTAMPS: self.timestamps.doubtful_times()}
        return {reason: by_sensor for reason, by_sensor in out.items() if by_sensor}

    def latest_doubt(self, sensor: str) -> tuple[int, int | None] | None:
        """Latest interval [ns] of doubt about a sensor, if any, preferably an open one."""
        times = [interval for by_sensor in (
            self._background[sensor].doubtful_times, self.comparison.times_of(sensor),
            self.timestamps.doubtful_times().get(sensor, ()))
            for interval in by_sensor[-1:]]
        return max(times, key=lambda t: (t[1] is None, t[0]), default=None)

    def counts_of(self, sensor: str) -> 'Counter[str]':
        """Number of accepted and rejected readings of a sensor, the latter also by cause."""
        rejected = self.rejections[sensor]
        counts = Counter({f'rejected: {text}': n for (_, text), n in rejected.items()})
        return counts + Counter(rejected=rejected.total(),
                                accepted=int(self._state_of(sensor)['accepted']))

    def lowest_rate(self, sensor: str) -> float:
        """Lowest rate [Hz] of a sensor so far, without repetitions; inf if unknown."""
        return self.timestamps.lowest_rate(sensor) / self.driver_faults.of(sensor).repetition

    def _state_of(self, sensor: str) -> Record:
        """State of a sensor: its element of the array that compiled code updates."""
        return self._sensors[self._index[sensor]]

    def feed(self, readings: Readings) -> list[Readings]:
        """Calibrate raw readings, and return those that are no longer held as at most one batch."""
        rows = readings.rows(self._index)
        validity, covariances = rejections.own_covariances(readings)
        stamps, fields = plain(readings.stamp_ns, np.int64), plain(readings.field)
        self.timestamps.add(rows, stamps - self._network.clock_offset_ns[rows], fields)
        out, batch = self._new_output(len(readings)), self._batches[0]
        batch['next'] = 0
        while reason := core.calibrate_readings(
                self._sensors, self._limits, rows, stamps, fields, validity, covariances,
                self._batches, *out.arrays):
            if reason == core.UNKNOWN_SENSOR:
                name = readings.names[readings.sensor[batch['next'] - 1]]
                self.counts[f'rejected: unknown sensor {name}'] += 1
            else:
                self._handle(reason, int(batch['row']), out)
        return out.finish(self.counts)

    def _new_output(self, n: int) -> OutputBuffer:
        """Create a buffer for the output of `n` raw readings."""
        capacity = n + self.n_held
        if self.settings.decimate_to_hz:
            capacity += sum(d.n_waiting for d in self._decimators.values())
        return OutputBuffer(self._network.names, capacity, self._batches[0])

    def _handle(self, reason: int, i: int, out: OutputBuffer) -> None:
        """Handle an event of sensor `i` that the compiled code has reported."""
        batch, name = self._batches[0], self._network.names[i]
        if batch['n_spikes']:
            self._reject(name, (Cause.SPIKES, 'spike'), int(batch['n_spikes']))
            batch['n_spikes'] = 0
        if reason == core.BLOCK_COMPLETE:
            self._evaluate_block(i)
        elif reason == core.WINDOW_COMPLETE:
            self._examine_window(i)
        elif reason == core.JUMPED_BACK:
            self._background[name].forget()
            self._reject_held(i, 'time jumped back')
            self.counts['time jumped back'] += 1
            self._sensors[i]['first_ns'] = self._sensors[i]['last_ns'] = NEVER
        elif reason == core.RESTORABLE:
            stored, self._sensors[i]['is_restorable'] = self._stored.pop(name), False
            age_ns = int(batch['stamp_ns']) - stored.stamp_ns
            is_recent = 0 < age_ns <= self.settings.max_resume_gap_s * NS
            if is_recent:
                self._background[name].resume(stored.background, stored.covariance)
            self.counts['backgrounds restored' if is_recent else
                        'outdated backgrounds not restored'] += 1
        elif reason == core.PASSED:
            self._calibrate_released(i, out)
        elif reason != core.SPIKES:
            self._reject(name, self._causes[reason] if reason in self._causes
                         else self.driver_faults.rejection(name, reason))

    def _examine_window(self, i: int) -> None:
        """Search the latest raw readings of sensor `i` for faults of its driver."""
        name, stamp_ns = self._network.names[i], int(self._batches[0]['stamp_ns'])
        marked_fraction = self.driver_faults.examine(name, stamp_ns)
        if marked_fraction >= 0.0:
            self._reject_held(i, 'a fault of the driver was found')
            self.counts[FAULTS_FOUND] += 1
            if marked_fraction > rejections.MAX_MARKED:
                # The background has been learnt from the marks.
                self._background[name].forget()

    def _calibrate_released(self, i: int, out: OutputBuffer) -> None:
        """Calibrate the readings of sensor `i` that the spike filter has released."""
        s, name = self._sensors[i], self._network.names[i]
        for k in range(int(s['n_released'])):
            stamp, validity = int(s['held_ns'][k]), int(s['held_own'][k])
            field, covariance = s['held_field'][k].copy(), s['held_covariance'][k]
            if not self.settings.decimate_to_hz:
                self._calibrate_reading(i, stamp, field, validity, covariance, out)
                continue
            decimator = self._decimators[name]
            decimated = decimator.feed(stamp, field)
            self.counts['removed by decimation'] += 1 - len(decimated)
            s['n_averaged'] = decimator.factor or 1
            for stamp, field in decimated:
                self._calibrate_reading(i, stamp, field, validity,
                                        covariance * decimator.noise_gain(), out)
        s['n_held'] = s['n_released'] = 0

    def _calibrate_reading(self, i: int, stamp: int, field: FloatArray, validity: int,
                           covariance: FloatArray, out: OutputBuffer) -> None:
        """Calibrate one reading of sensor `i`, and append the result to `out`."""
        self._evaluate_block(i)
        while not core.use_reading(self._sensors, self._limits, self._batches, i, stamp,
                                   plain(field), validity, plain(covariance), *out.arrays):
            self._evaluate_block(i)

    def _evaluate_block(self, i: int) -> None:
        """Evaluate the latest complete block of sensor `i`, unless it has been evaluated."""
        name, s = self._network.names[i], self._sensors[i]
        if s['is_full']:
            self._background[name].evaluate_block()
            if self._background[name].ready:
                self.comparison.update(i, self.background(name), int(s['first_ns']),
                                        int(s['last_ns']))

    @property
    def n_held(self) -> int:
        """Number of readings that are held until the next reading of their sensor."""
        return int(self._sensors['n_held'].sum())

    def _reject_held(self, i: int, event: str) -> None:
        """Reject the held readings of sensor `i`, which no reading after `event` can confirm."""
        self._reject(self._network.names[i], (Cause.SPIKES, f'possible spike when {event}'),
                     int(self._sensors[i]['n_held']))
        clear_spikes(self._sensors[i])

    def start_from(self, levels: Mapping[str, MostFrequentLevel],
                   steps: Mapping[str, FloatArray], faults: Mapping[str, ReadingFaults]) -> None:
        """Initialise the stage with a first pass: `levels`, and `steps` (3,) [T] of the axes."""
        for name, found in faults.items():
            if found:
                self.driver_faults.store(name, found)
                self.counts[FAULTS_FOUND] += 1
        for name, step in steps.items():
            self._state_of(name)['step'] = step
        for name, quiet in levels.items():
            self._background[name].start_from(quiet.level, quiet.covariance)

    def compare_clocks(self, clocks: Mapping[str, ClockSpan]) -> None:
        """Report sensors whose raw timestamps differ from those of other sensors as doubtful."""
        self.timestamps.compare_clocks(corrected(clocks, self._network))

    def resume(self, stored: Mapping[str, StoredBackground]) -> None:
        """Provide stored backgrounds, which are restored at the first reading of each sensor."""
        self._stored = dict(stored)
        self._mark_restorable()

    def _mark_restorable(self) -> None:
        """Mark sensors with a stored background: compiled code then reports their first reading."""
        self._sensors['is_restorable'] = [name in self._stored for name in self._index]

    def stored(self, sensor: str) -> StoredBackground | None:
        """Background of a sensor for `resume`; None while it is unknown or doubtful."""
        background, last = self._background[sensor], self.last_stamp_ns(sensor)
        C = background.covariance
        if not background.certain or last is None or C is None:
            return None
        # An axis that has just started to report has a level but no noise variance yet.
        level = np.where(np.isnan(np.diagonal(C)), np.nan, self.background(sensor))
        return None if np.isnan(level).all() else StoredBackground(last, level, C)

    def idle(self) -> None:
        """Evaluate the completed blocks, which only in a large network are deferred; the reading
        that completes one is calibrated with the previous background."""
        for i in np.flatnonzero(self._sensors['is_full']):
            self._evaluate_block(int(i))

    def flush(self) -> list[Readings]:
        """Calibrate and return the readings that are still held."""
        out = self._new_output(0)
        for i in np.flatnonzero(self._sensors['n_held']):
            s = self._sensors[i]
            s['n_released'] = s['n_held']
            s['accepted'] += s['n_held']
            self._calibrate_released(int(i), out)
        for s in self._sensors:
            clear_spikes(s)
        return out.finish(self.counts)

    def _reject(self, sensor: str, cause: tuple[Cause, str], n: int = 1) -> None:
        """Count `n` rejected readings of a sensor by cause and description."""
        if n:
            self.counts[f'rejected: {cause[1]}'] += n
            self.rejections[sensor][cause] += n

    def forget(self, sensors: Collection[str] = ()) -> None:
        """Learn backgrounds again, by default all; raises NetworkError for an unknown sensor."""
        for name in sensors:
            self._network.index(name)
        for name in sensors or self._network.names:
            self._background[name].forget()
            self._stored.pop(name, None)
        self._mark_restorable()

    def last_stamp_ns(self, sensor: str) -> int | None:
        """Timestamp of the latest accepted reading of a sensor."""
        last = int(self._state_of(sensor)['last_ns'])
        return None if last == NEVER else last

    def background(self, sensor: str) -> FloatArray:
        """Background (3,) [T] at the latest reading of a sensor; ValueError if unknown."""
        state = self._state_of(sensor)
        return self._background[sensor].level(int(state['last_ns'] - state['first_ns']) / NS)

    def overruled_covariances(self, sensor: str) -> tuple[int, FloatArray, FloatArray]:
        """Number of message covariances of a sensor that contradict its measured noise, the std
        (3,) [T] in the latest message, and the measured std (3,) [T]; NaN if unknown."""
        s = self._state_of(sensor)
        return int(s['n_overruled']), s['stated_std'].copy(), s['noise_std'].copy()

    def backgrounds(self) -> dict[str, RunningBackground]:
        """Background estimators of all sensors, for inspection."""
        return dict(self._background)
