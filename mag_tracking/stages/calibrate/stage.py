"""Calibrate: check a sample, remove the background, attach the noise."""

from collections import Counter
from collections.abc import Collection, Mapping
from math import isnan

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.decimation import Decimator
from mag_tracking.calibration.ordinary import LIMITS, NEVER, new_sensors, take_ordinary
from mag_tracking.calibration.screening import SPIKE, STUCK, Repetition, SpikeFilter
from mag_tracking.errors import NetworkError
from mag_tracking.network import SensorNetwork
from mag_tracking.records import MagSample, Readings, plain
from mag_tracking.stages.calibrate.raw_sample import corrected, fault_of
from mag_tracking.stages.calibrate.restoration import BackgroundRestoration, Kept, to_keep
from mag_tracking.stages.calibrate.settings import CalibrateSettings
from mag_tracking.stages.calibrate.timestamps import JumpAheadCheck
from mag_tracking.units import NS

AT_ONCE = 16
"""The blocks of so many sensors may end at once; those of more would hold up the readings."""


class Calibrate:
    """Raw samples to calibrated ones: background removed, covariance known.

    The clock offset and the hard and soft iron of the network file are applied first. The field
    stays in the sensor's frame. The covariance is the sample's own if it has one, else the
    configured one, else the estimated one.

    Valid readings pass through compiled code (`calibration.ordinary`), one or many at once.
    """

    def __init__(self, network: SensorNetwork, settings: CalibrateSettings) -> None:
        self.counts: Counter[str] = Counter()
        self._per_sensor: dict[str, Counter[str]] = {name: Counter() for name in network.names}
        self._settings = settings
        self._sensors = new_sensors(len(network))
        self._rows, self._limits = np.arange(len(network)), np.zeros(1, LIMITS)
        self._limits[0] = (settings.max_field, settings.jump_ahead_s * NS, settings.reject_stuck,
                           settings.spike_std)
        # The noise of each sensor, once it may take the compiled way.
        self._noise = np.full((len(network), 3, 3), np.nan)
        self._index = {name: i for i, name in enumerate(network.names)}
        self._network = network
        self._clock_ns: list[int] = []
        self._background: dict[str, RunningBackground] = {}
        self._repetition = {name: Repetition(self._of(name)) for name in network.names}
        self._spikes: dict[str, SpikeFilter[MagSample]] = {
            name: SpikeFilter(settings.spike_std, self._of(name)) for name in network.names}
        self._jumps_ahead = JumpAheadCheck(settings.jump_ahead_s * NS)
        self._restoration = BackgroundRestoration(settings.resume_s)
        self.renew(network)

    def renew(self, network: SensorNetwork) -> None:
        """Go on with another calibration of the same sensors.

        A background is learnt anew where the sensor's own offset or correction is
        another; else it stays, also a frozen one: a target that stands there must not
        become the background by this. Raises NetworkError where the sensors are others.
        """
        if network.names != tuple(self._index):
            raise NetworkError(f'a network of {", ".join(network.names)} in place of one of '
                               f'{", ".join(self._index)}')
        before = self._network if self._background else None
        clock_before, self._network = self._clock_ns, network
        self._clock_ns = [round(s * NS) for s in network.clock_offset]
        self._decimators = {name: Decimator(self._settings.decimate_to_hz)
                            for name in network.names}
        for i, name in enumerate(network.names):
            same = before is not None and _same(before.offset[i], network.offset[i]) \
                and _same(before.correction[i], network.correction[i])
            if before is not None and (not same or self._clock_ns[i] != clock_before[i]):
                self._restoration.forget(name)
            if not same or self._clock_ns[i] != clock_before[i]:
                self._give_up(name, 'another calibration came')
            if not same:
                self._background[name] = self._new_background(i)
            if before is not None:
                # The same readings have other stamps from now on.
                self._shift(i, clock_before[i] - self._clock_ns[i])
            self._note(i)

    def _of(self, name: str) -> StructArray:
        """(1,) SENSOR of a sensor."""
        i = self._index[name]
        return self._sensors[i:i + 1]

    def _shift(self, i: int, by_ns: int) -> None:
        """The readings of sensor `i` have later stamps from now on."""
        s, name = self._sensors[i], self._network.names[i]
        if s['last_ns'] != NEVER:
            s['first_ns'] += by_ns
            s['last_ns'] += by_ns
        self._jumps_ahead.shift(name, by_ns)

    def _note(self, i: int) -> None:
        """Whether the readings of sensor `i` may take the compiled way, and what it has to know."""
        s, name = self._sensors[i], self._network.names[i]
        background, offset, C = (self._background[name], self._network.offset[i],
                                 self._network.correction[i])
        line = background.line
        s['is_ordinary'] = (
            line is not None and background.ready and background.is_whole
            and s['last_ns'] != NEVER and not np.isnan(line[1]).any()
            and not self._settings.decimate_to_hz and not self._spikes[name].n_held
            and name not in self._jumps_ahead and name not in self._restoration)
        if line is not None and s['is_ordinary']:
            s['centre'], s['mean'], s['slope'], s['horizon'] = line
            s['noise_std'], self._noise[i] = background.noise_std, background.covariance
            s['clock_ns'], s['offset'] = self._clock_ns[i], 0.0 if offset is None else offset
            s['is_turned'] = C is not None
            if C is not None:
                s['correction'] = C

    def _new_background(self, i: int) -> RunningBackground:
        """Of sensor `i`, from what the network file says of it."""
        s, network = self._settings, self._network
        return RunningBackground(s.learn_s, s.memory_s, s.guard_s, s.block_s, s.freeze_std,
                                 s.relearn_s, network.background[i], network.noise_std[i],
                                 phase=i / len(network) if len(network) > AT_ONCE else None,
                                 sensors=self._sensors[i:i + 1])

    def counts_of(self, sensor: str) -> 'Counter[str]':
        """What was `accepted` and `rejected` of a sensor, and why."""
        return self._per_sensor[sensor] + Counter(accepted=int(self._of(sensor)[0]['accepted']))

    def feed(self, sample: MagSample) -> list[MagSample]:
        """A raw `MagSample` gives the calibrated ones that are now known to be whole."""
        i = self._index.get(sample.sensor)
        if i is None:
            return self._feed_any(sample)
        if sample.covariance is None:
            stamp, field = np.empty(1, dtype=np.int64), np.empty((1, 3))
            if take_ordinary(self._sensors, self._limits, self._rows[i:i + 1],
                             np.array([sample.stamp_ns]), np.array([sample.field], dtype=float),
                             0, stamp, field):
                self.counts['calibrated'] += 1
                return [MagSample(int(stamp[0]), sample.sensor, field[0],
                                  self._background[sample.sensor].covariance)]
        out = self._feed_any(sample)
        self._note(i)
        return out

    def feed_many(self, readings: Readings) -> Readings:
        """Raw `Readings` give the calibrated ones that are now known to be whole."""
        index, n, i = self._index, len(readings), 0
        parts: list[Readings] = []
        rows = readings.rows(index)
        if readings.covariance is not None:
            # What one says of its own covariance is looked at one by one.
            rows = np.where(np.isnan(readings.covariance).all(axis=(1, 2)), rows, -1)
        stamps, fields = np.empty(n, dtype=np.int64), np.empty((n, 3))
        raw = plain(readings.stamp_ns, np.int64), plain(readings.field)
        while i < n:
            odd = take_ordinary(self._sensors, self._limits, rows, *raw, i, stamps, fields)
            if odd > i:
                self.counts['calibrated'] += odd - i
                parts.append(Readings(self._network.names, rows[i:odd], stamps[i:odd],
                                      fields[i:odd], self._noise[rows[i:odd]]))
            if odd < n:
                sample = readings.sample(odd)
                parts.append(Readings.of(self._feed_any(sample)))
                if sample.sensor in index:
                    self._note(index[sample.sensor])
            i = odd + 1
        return Readings.joined(parts)

    def _feed_any(self, sample: MagSample) -> list[MagSample]:
        """As `feed`, of a sample that may be odd."""
        if sample.sensor not in self._background:
            return self._reject(sample, f'unknown sensor {sample.sensor}')
        self._background[sample.sensor].settle()
        cause = fault_of(sample, self._settings.max_field)
        if cause:
            return self._reject(sample, cause)
        raw, i = sample, self._index[sample.sensor]
        sample = corrected(sample, self._clock_ns[i], self._network.offset[i],
                           self._network.correction[i])
        if sample is not raw and np.isnan(sample.field).all():
            return self._reject(sample, 'an axis is missing that the correction needs')
        cause = self._misplaced(sample)
        if cause:
            return self._reject(sample, cause)
        return self._used(self._screened(sample))

    def _used(self, samples: list[MagSample]) -> list[MagSample]:
        """What is made of whole samples: counted, thinned out and calibrated."""
        out: list[MagSample] = []
        for whole in samples:
            self._sensors[self._index[whole.sensor]]['accepted'] += 1
            for s in self._thinned(whole) if self._settings.decimate_to_hz else (whole,):
                out += self._calibrated(s)
        return out

    def _screened(self, sample: MagSample) -> list[MagSample]:
        """The samples that are known by now to be whole; the others are counted or wait."""
        name, field = sample.sensor, sample.field.tolist()
        if self._settings.reject_stuck and self._repetition[name].is_stuck(field):
            return self._reject(sample, STUCK)
        known = [(sample, False)]
        if self._settings.spike_std:
            background = self._background[name]
            known = self._spikes[name].feed(
                sample, sample.stamp_ns, field,
                background.noise_std if background.ready else None)
        for s, is_spike in known:
            if is_spike:
                self._reject(s, SPIKE)
        return [s for s, is_spike in known if not is_spike]

    @property
    def n_held(self) -> int:
        """How many readings wait for the next."""
        return sum(s.n_held for s in self._spikes.values())

    def _give_up(self, name: str, why: str) -> None:
        """Nothing that comes tells any more whether what is held of a sensor was a spike."""
        for held, _ in self._spikes[name].flush():
            self._reject(held, f'may have been a spike when {why}')

    def _misplaced(self, sample: MagSample) -> str | None:
        """Why the stamp of a sample cannot be used, or None; a restart is one to go on from."""
        last, state = self.last_stamp_ns(sample.sensor), self._of(sample.sensor)[0]
        if last is not None and self._jumps_ahead.is_ahead(sample.sensor, sample.stamp_ns, last):
            return 'stamp too far ahead'
        if last is not None and sample.stamp_ns <= last:
            if last - sample.stamp_ns <= self._settings.jump_back_s * NS:
                return 'duplicate stamp' if sample.stamp_ns == last else 'out of order'
            self._background[sample.sensor].forget()
            self._give_up(sample.sensor, 'time jumped back')
            self.counts['time jumped back'] += 1
            state['first_ns'] = NEVER
        state['last_ns'] = sample.stamp_ns
        if state['first_ns'] == NEVER:
            state['first_ns'] = sample.stamp_ns
        if sample.sensor in self._restoration:
            self.counts[self._restoration.take_up(
                sample.sensor, sample.stamp_ns, self._background[sample.sensor])] += 1
        return None

    def resume(self, kept: Mapping[str, Kept]) -> None:
        """Go on from {sensor: `Kept`}, where the first reading of a sensor comes soon after."""
        self._restoration.offer(kept)
        for i in range(len(self._network)):
            self._note(i)

    def kept(self, sensor: str) -> Kept | None:
        """What `resume` wants of a sensor; None before its background is known."""
        background = self._background[sensor]
        last = self.last_stamp_ns(sensor)
        if not background.ready or last is None:
            return None
        return to_keep(background, last, self.background(sensor))

    def _thinned(self, sample: MagSample) -> list[MagSample]:
        """The samples that are left of a fast sensor."""
        decimator = self._decimators[sample.sensor]
        found = decimator.feed(sample.stamp_ns, sample.field)
        self.counts['thinned out'] += 1 - len(found)
        C = sample.covariance
        return [MagSample(stamp_ns, sample.sensor, field,
                          None if C is None else C * decimator.noise_gain())
                for stamp_ns, field in found]

    def _calibrated(self, sample: MagSample) -> list[MagSample]:
        """A sample that is to be used gives at most one calibrated."""
        background = self._background[sample.sensor]
        # Counted from the first sample: seconds since 1970 leave a float few digits.
        time = (sample.stamp_ns - int(self._of(sample.sensor)[0]['first_ns'])) / NS
        background.add(time, sample.field)
        if not background.ready:
            self.counts['held back while learning'] += 1
            return []
        departure = background.departure(time, sample.field.tolist())
        covariance, is_whole = sample.covariance, background.is_whole
        if covariance is None:
            covariance = background.covariance
        else:
            is_whole = not isnan(covariance.trace())
        field = np.array(departure)
        if is_whole and not isnan(sum(departure)):
            self.counts['calibrated'] += 1
            return [MagSample(sample.stamp_ns, sample.sensor, field, covariance)]
        assert covariance is not None
        unknown = ~np.isnan(field) & np.isnan(np.diagonal(covariance))
        if unknown.any() or (np.isnan(field) & ~np.isnan(sample.field)).any():
            # It has only just begun to report this axis: nothing is known of it yet.
            field = np.where(unknown, np.nan, field)
            self.counts['axes held back while learning'] += 1
        if np.isnan(field).all():
            return []
        self.counts['calibrated'] += 1
        return [MagSample(sample.stamp_ns, sample.sensor, field, covariance)]

    def idle(self) -> None:
        """Learn from complete blocks; without this call the sensor's next reading does it.

        The result is the same: in a large network the reading that completes a block is
        calibrated with what was known before.
        """
        for i in np.flatnonzero(self._sensors['is_full']):
            self._background[self._network.names[i]].settle()
            self._note(i)

    def flush(self) -> list[MagSample]:
        """What waited for the next reading."""
        return self._used([s for spikes in self._spikes.values() for s, _ in spikes.flush()])

    def _reject(self, sample: MagSample, cause: str) -> list[MagSample]:
        """Count the rejection."""
        self.counts[f'rejected: {cause}'] += 1
        if sample.sensor in self._per_sensor:
            self._per_sensor[sample.sensor]['rejected'] += 1
            self._per_sensor[sample.sensor][f'rejected: {cause}'] += 1
        return []

    def forget(self, sensors: Collection[str] = ()) -> None:
        """Learn the backgrounds of `sensors` (all if empty) anew.

        Raises NetworkError for a sensor that is not in the network.
        """
        for name in sensors:
            self._network.index(name)
        for name in sensors or self._network.names:
            self._background[name].forget()
            self._restoration.forget(name)
            self._note(self._index[name])

    def last_stamp_ns(self, sensor: str) -> int | None:
        """Stamp of the latest accepted sample of `sensor`, or None."""
        last = int(self._of(sensor)[0]['last_ns'])
        return None if last == NEVER else last

    def background(self, sensor: str) -> FloatArray:
        """(3,) [T] background of `sensor` at its latest sample; ValueError before it is ready."""
        state = self._of(sensor)[0]
        return self._background[sensor].level(int(state['last_ns'] - state['first_ns']) / NS)

    def backgrounds(self) -> dict[str, RunningBackground]:
        """{sensor: RunningBackground}, to look at."""
        return dict(self._background)


def _same(a: FloatArray | None, b: FloatArray | None) -> bool:
    """Whether two arrays, or None, are the same."""
    return a is b if a is None or b is None else np.array_equal(a, b)
