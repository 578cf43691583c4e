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
from mag_tracking.settings import param
from mag_tracking.stages.stage import NS


@dataclass(frozen=True)
class CalibrateSettings:
    """Settings of the calibration."""

    learn_s: float = param(
        3.0, 'Quiet time needed before a sensor is used, unless its calibration is given.',
        's', (0.1, 3600.0))
    memory_s: float = param(
        20.0, 'Length of the quiet stretch that level, drift and noise are fitted to.',
        's', (1.0, 36000.0))
    guard_s: float = param(
        1.5, 'How far the background stays behind, so that a slow approach does not enter it.',
        's', (0.0, 600.0))
    block_s: float = param(
        0.25, 'Samples are judged in blocks of this length.', 's', (0.01, 60.0))
    freeze_std: float = param(
        2.0, 'A block whose mean is off by this many noise deviations freezes the background.',
        '', (0.5, 1000.0))
    relearn_s: float = param(
        60.0, 'After so long frozen on a steady level, that level becomes the background '
        '(a parked car); 0 = never.', 's', (0.0, 86400.0))
    max_field: float = param(
        1e-3, 'A reading above this is rejected: gauss or microtesla published as tesla is the '
        'commonest fault. Near magnets millitesla are legitimate.', 'T', (1e-6, 10.0))
    jump_ahead_s: float = param(
        60.0, 'A stamp that is ahead by more than this has to be confirmed by the next one, else '
        'it is taken for corrupt.', 's', (1e-3, 1e9))
    spike_std: float = param(
        30.0, 'A reading, or up to three, that is off those around it by more noise deviations '
        'than this is rejected as a spike; what may be one waits for the next. Below 30 Hz, where '
        'a vehicle changes much from one to the next, it has to be larger. 0 = never.',
        '', (0.0, 1e6))
    reject_stuck: bool = param(
        True, 'Readings that stay the same, from a sensor that does not repeat itself otherwise, '
        'are rejected. Simulated sensors without noise need this to be false.')
    decimate_to_hz: float = param(
        0.0, 'Samples of a faster sensor are low-pass filtered and thinned to about this rate '
        '(a whole share of its own; 60 dB against folding, four intervals late). 0 = no: frames '
        'average anyway.',
        'Hz', (0.0, 10000.0))
    jump_back_s: float = param(
        1.0, 'A stamp that goes back by more than this is a restart (a looped recording): '
        'what was learnt is forgotten.', 's', (0.0, 3600.0))


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
        self._index = {name: i for i, name in enumerate(network.names)}
        self._network, self._clock_ns, self._background = None, [], {}
        self._repetition = {name: Repetition() for name in network.names}
        self._spikes = {name: SpikeFilter(settings.spike_std) for name in network.names}
        self._first_ns, self._last_ns, self._ahead_ns = {}, {}, {}
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
                                 s.relearn_s, network.background[i], network.noise_std[i])

    def feed(self, sample):
        """A raw `MagSample` gives the calibrated ones that are now known to be whole."""
        if sample.sensor not in self._background:
            return self._reject(sample, f'unknown sensor {sample.sensor}')
        cause = self._fault(sample)
        if cause:
            return self._reject(sample, cause)
        sample = self._corrected(sample)
        if isnan(sample.field[0]) and np.isnan(sample.field).all():
            return self._reject(sample, 'an axis is missing that the correction needs')
        cause = self._misplaced(sample)
        if cause:
            return self._reject(sample, cause)
        return [c for whole in self._screened(sample) for s in self._thinned(whole)
                for c in self._calibrated(s)]

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
        return self._accepted([s for s, is_spike in known if not is_spike])

    def _accepted(self, samples):
        """Count `samples`."""
        for s in samples:
            self.per_sensor[s.sensor]['accepted'] += 1
        return samples

    def _give_up(self, name, why):
        """Nothing that comes tells any more whether what is held of a sensor was a spike."""
        for held, _ in self._spikes[name].flush():
            self._reject(held, f'may have been a spike when {why}')

    def _misplaced(self, sample):
        """Why the stamp of a sample cannot be used, or None; a restart is one to go on from."""
        last = self._last_ns.get(sample.sensor)
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
        return None

    def _thinned(self, sample):
        """The samples that are left of a fast sensor; the sample itself without decimation."""
        if not self._settings.decimate_to_hz:
            return [sample]
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
        covariance = background.covariance if sample.covariance is None else sample.covariance
        field = sample.field - background.level(time)
        if not isnan(field.sum() + covariance.trace()):
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
        held = [s for spikes in self._spikes.values() for s, _ in spikes.flush()]
        return [c for whole in self._accepted(held) for s in self._thinned(whole)
                for c in self._calibrated(s)]

    def _is_ahead(self, sample, last):
        """Whether a stamp is far ahead of the `last`, and of the one that was so before it."""
        limit = self._settings.jump_ahead_s * NS
        if sample.stamp_ns - last <= limit:
            self._ahead_ns.pop(sample.sensor, None)
            return False
        before = self._ahead_ns.get(sample.sensor)
        self._ahead_ns[sample.sensor] = sample.stamp_ns
        return before is None or not 0 < sample.stamp_ns - before <= limit

    def _fault(self, sample):
        """Why the sample cannot be used, or None."""
        # Of three numbers Python's own functions are several times as fast as NumPy's.
        values = [abs(v) for v in sample.field.tolist() if not isnan(v)]
        if not values:
            return 'no axis reported (all NaN)'
        largest = max(values)
        if largest == inf:
            return 'infinite value'
        if largest > self._settings.max_field:
            return f'above {self._settings.max_field:g} T (gauss or microtesla as tesla?)'
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
