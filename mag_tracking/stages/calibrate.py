"""Calibrate: check a sample, remove the background, attach the noise."""

from collections import Counter
from dataclasses import dataclass
from math import inf, isnan

import numpy as np

from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.decimation import Decimator
from mag_tracking.calibration.screening import SPIKE, STUCK, Repetition, SpikeFilter
from mag_tracking.errors import NetworkError
from mag_tracking.records import MagSample
from mag_tracking.stages.stage import NS

AT_ONCE = 16
"""The blocks of so many sensors may end at once; those of more would hold up the readings."""


@dataclass(frozen=True)
class Kept:
    """The background of one sensor, to go on from after a restart."""

    stamp_ns: int
    background: np.ndarray
    """(3,) [T]; NaN = axis not reported."""
    covariance: np.ndarray
    """(3, 3) [T^2] noise of one sample."""


class Calibrate:
    """Raw samples to calibrated ones: background removed, covariance known.

    What the network file knows of a sensor is applied first: its clock's offset is
    taken from the stamp, its own hard and soft iron from the field. The field stays
    in the sensor's own frame, where a missing axis is a missing axis. The covariance
    is the sample's own if it carries one, else the configured one, else the
    estimated one.
    """

    def __init__(self, network, settings):
        self.counts = Counter()
        self.per_sensor = {name: Counter() for name in network.names}
        self._settings = settings
        self._longest_jump = settings.jump_ahead_s * NS
        self._index = {name: i for i, name in enumerate(network.names)}
        self._network, self._clock_ns, self._background = None, [], {}
        self._repetition = {name: Repetition() for name in network.names}
        self._spikes = {name: SpikeFilter(settings.spike_std) for name in network.names}
        self._first_ns, self._last_ns, self._ahead_ns = {}, {}, {}
        self._kept = {}
        self.renew(network)

    def renew(self, network):
        """Go on with another calibration of the same sensors.

        A background is learnt anew where the sensor's own offset or correction is
        another; else it stays, also a frozen one: a target that stands there must not
        become the background by this. Raises NetworkError where the sensors are others.
        """
        if network.names != tuple(self._index):
            raise NetworkError(f'a network of {", ".join(network.names)} in place of one of '
                               f'{", ".join(self._index)}')
        before, clock_before = self._network, self._clock_ns
        self._network = network
        self._clock_ns = [round(s * NS) for s in network.clock_offset]
        self._decimators = {name: Decimator(self._settings.decimate_to_hz)
                            for name in network.names}
        for i, name in enumerate(network.names):
            same = before is not None and _same(before.offset[i], network.offset[i]) \
                and _same(before.correction[i], network.correction[i])
            if before is not None and (not same or self._clock_ns[i] != clock_before[i]):
                self._kept.pop(name, None)
            if not same or self._clock_ns[i] != clock_before[i]:
                self._give_up(name, 'another calibration came')
            if not same:
                self._background[name] = self._new_background(i)
            else:
                # The same readings have other stamps from now on.
                for times in (self._first_ns, self._last_ns, self._ahead_ns):
                    if name in times:
                        times[name] -= self._clock_ns[i] - clock_before[i]

    def _new_background(self, i):
        """Of sensor `i`, from what the network file says of it."""
        s, network = self._settings, self._network
        return RunningBackground(s.learn_s, s.memory_s, s.guard_s, s.block_s, s.freeze_std,
                                 s.relearn_s, network.background[i], network.noise_std[i],
                                 phase=i / len(network) if len(network) > AT_ONCE else 0.0)

    def feed(self, sample):
        """A raw `MagSample` gives the calibrated ones that are now known to be whole."""
        if sample.sensor not in self._background:
            return self._reject(sample, f'unknown sensor {sample.sensor}')
        cause = self._fault(sample)
        if cause:
            return self._reject(sample, cause)
        raw, sample = sample, self._corrected(sample)
        if sample is not raw and np.isnan(sample.field).all():
            return self._reject(sample, 'an axis is missing that the correction needs')
        cause = self._misplaced(sample)
        if cause:
            return self._reject(sample, cause)
        return self._used(self._screened(sample))

    def _used(self, samples):
        """What is made of whole samples: counted, thinned out and calibrated."""
        out = []
        for whole in samples:
            self.per_sensor[whole.sensor]['accepted'] += 1
            for s in self._thinned(whole) if self._settings.decimate_to_hz else (whole,):
                out += self._calibrated(s)
        return out

    def _screened(self, sample):
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
    def n_held(self):
        """How many readings wait for the next."""
        return sum(s.n_held for s in self._spikes.values())

    def _give_up(self, name, why):
        """Nothing that comes tells any more whether what is held of a sensor was a spike."""
        for held, _ in self._spikes[name].flush():
            self._reject(held, f'may have been a spike when {why}')

    def _misplaced(self, sample):
        """Why the stamp of a sample cannot be used, or None; a restart is one to go on from."""
        last = self._last_ns.get(sample.sensor)
        if last is not None and 0 < sample.stamp_ns - last <= self._longest_jump \
                and sample.sensor not in self._ahead_ns:
            # As nearly all are.
            self._last_ns[sample.sensor] = sample.stamp_ns
            return None
        if last is not None and self._is_ahead(sample, last):
            return 'stamp too far ahead'
        if last is not None and sample.stamp_ns <= last:
            if last - sample.stamp_ns <= self._settings.jump_back_s * NS:
                return 'duplicate stamp' if sample.stamp_ns == last else 'out of order'
            self._background[sample.sensor].forget()
            self._give_up(sample.sensor, 'time jumped back')
            self.counts['time jumped back'] += 1
            self._first_ns.pop(sample.sensor)
        self._last_ns[sample.sensor] = sample.stamp_ns
        self._first_ns.setdefault(sample.sensor, sample.stamp_ns)
        if sample.sensor in self._kept:
            self._go_on_from(self._kept.pop(sample.sensor), sample)
        return None

    def resume(self, kept):
        """Go on from {sensor: `Kept`}, where the first reading of a sensor comes soon after."""
        self._kept = dict(kept)

    def kept(self, sensor):
        """What `resume` wants of a sensor; None before its background is known."""
        background = self._background[sensor]
        if not background.ready or sensor not in self._last_ns:
            return None
        C = background.covariance
        # An axis that has only just begun to report has a level, but no noise yet.
        level = np.where(np.isnan(np.diagonal(C)), np.nan, self.background(sensor))
        return None if np.isnan(level).all() else Kept(self._last_ns[sensor], level, C)

    def _go_on_from(self, kept, sample):
        """Take up a background at the first reading, if it is of a moment before."""
        if 0 < sample.stamp_ns - kept.stamp_ns <= self._settings.resume_s * NS:
            self._background[sample.sensor].resume(kept.background, kept.covariance)
            self.counts['backgrounds resumed'] += 1
        else:
            self.counts['backgrounds of another time not resumed'] += 1

    def _thinned(self, sample):
        """The samples that are left of a fast sensor."""
        decimator = self._decimators[sample.sensor]
        found = decimator.feed(sample.stamp_ns, sample.field)
        self.counts['thinned out'] += 1 - len(found)
        C = sample.covariance
        return [MagSample(stamp_ns, sample.sensor, field,
                          None if C is None else C * decimator.noise_gain())
                for stamp_ns, field in found]

    def _calibrated(self, sample):
        """A sample that is to be used gives at most one calibrated."""
        background = self._background[sample.sensor]
        # Counted from the first sample: seconds since 1970 leave a float few digits.
        time = (sample.stamp_ns - self._first_ns[sample.sensor]) / NS
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
        unknown = ~np.isnan(field) & np.isnan(np.diagonal(covariance))
        if unknown.any() or (np.isnan(field) & ~np.isnan(sample.field)).any():
            # It has only just begun to report this axis: nothing is known of it yet.
            field = np.where(unknown, np.nan, field)
            self.counts['axes held back while learning'] += 1
        if np.isnan(field).all():
            return []
        self.counts['calibrated'] += 1
        return [MagSample(sample.stamp_ns, sample.sensor, field, covariance)]

    def _corrected(self, sample):
        """The sample by the network's clock, without the sensor's own hard and soft iron."""
        i = self._index[sample.sensor]
        offset, C = self._network.offset[i], self._network.correction[i]
        if offset is None and C is None and not self._clock_ns[i]:
            return sample
        stamp_ns = sample.stamp_ns - self._clock_ns[i]
        field, covariance = sample.field, sample.covariance
        if offset is not None:
            field = field - offset
        if C is not None:
            missing = np.isnan(field)
            # An axis is missing where one is that it needs.
            field = np.where((C != 0.0) @ missing, np.nan, C @ np.where(missing, 0.0, field))
            covariance = None if covariance is None else C @ covariance @ C.T
        return MagSample(stamp_ns, sample.sensor, field, covariance)

    def flush(self):
        """What waited for the next reading."""
        return self._used([s for spikes in self._spikes.values() for s, _ in spikes.flush()])

    def _is_ahead(self, sample, last):
        """Whether a stamp is far ahead of the `last`, and of the one that was so before it."""
        limit = self._longest_jump
        if sample.stamp_ns - last <= limit:
            self._ahead_ns.pop(sample.sensor, None)
            return False
        before = self._ahead_ns.get(sample.sensor)
        self._ahead_ns[sample.sensor] = sample.stamp_ns
        return before is None or not 0 < sample.stamp_ns - before <= limit

    def _fault(self, sample):
        """Why the sample cannot be used, or None."""
        # Of three numbers Python's own functions are several times as fast as NumPy's.
        x, y, z = sample.field.tolist()
        most = self._settings.max_field
        if not (abs(x) <= most and abs(y) <= most and abs(z) <= most):
            # Or an axis is missing.
            values = [abs(v) for v in (x, y, z) if not isnan(v)]
            if not values:
                return 'no axis reported (all NaN)'
            if max(values) == inf:
                return 'infinite value'
            if max(values) > most:
                return f'above {most:g} T (gauss or microtesla as tesla?)'
        if sample.covariance is None:
            return None
        there = ~np.isnan(sample.field)
        if not (sample.covariance.shape == (3, 3)
                and _is_covariance(sample.covariance[np.ix_(there, there)])):
            return 'covariance is not positive definite'
        return None

    def _reject(self, sample, cause):
        """Count the rejection."""
        self.counts[f'rejected: {cause}'] += 1
        if sample.sensor in self.per_sensor:
            self.per_sensor[sample.sensor]['rejected'] += 1
            self.per_sensor[sample.sensor][f'rejected: {cause}'] += 1
        return []

    def forget(self, sensors=()):
        """Learn the backgrounds of `sensors` (all if empty) anew.

        Raises NetworkError for a sensor that is not in the network.
        """
        for name in sensors:
            self._network.index(name)
        for name in sensors or self._network.names:
            self._background[name].forget()
            self._kept.pop(name, None)

    def last_stamp_ns(self, sensor):
        """Stamp of the latest accepted sample of `sensor`, or None."""
        return self._last_ns.get(sensor)

    def background(self, sensor):
        """(3,) [T] background of `sensor` at its latest sample; ValueError before it is ready."""
        elapsed = self._last_ns[sensor] - self._first_ns[sensor]
        return self._background[sensor].level(elapsed / NS)

    def backgrounds(self):
        """{sensor: RunningBackground}, to look at."""
        return dict(self._background)


def _same(a, b):
    """Whether two arrays, or None, are the same."""
    return (a is None) == (b is None) and (a is None or np.array_equal(a, b))


def _is_covariance(C):
    """Whether C is finite, symmetric and positive definite."""
    if not np.isfinite(C).all() or np.abs(C - C.T).max() > 1e-6 * np.abs(C).max():
        return False
    return bool(np.linalg.eigvalsh(C)[0] > 0.0)
