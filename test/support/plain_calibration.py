"""Rules of the calibration in plain Python, sample by sample, as an oracle for the compiled rules.

The background estimator is taken from the package; the rules for updating it are implemented here.
"""

from collections import Counter

import numpy as np

from mag_tracking.calibration.decimation import Decimator
from mag_tracking.stages.calibrate import stage as calibrate
from support.fed_background import FedBackground
from support.samples import MagSample

NS = 1_000_000_000


class Repetition:
    """Detector of a stuck sensor: a run of equal readings with a probability below 1e-9."""

    def __init__(self):
        self.last, self.run, self.repeats, self.changes = None, 0, 0.0, 0.0

    def is_stuck(self, field):
        same = self.last is not None and np.array_equal(field, self.last, equal_nan=True)
        self.last = field
        if same:
            self.run += 1
            return self.is_too_long()
        if self.run:
            self.repeats += 1.0 if self.is_too_long() else self.run
        self.run, self.changes = 0, self.changes + 1.0
        if self.repeats + self.changes > 20_000:
            self.repeats, self.changes = 0.5 * self.repeats, 0.5 * self.changes
        return False

    def is_too_long(self):
        usual = (self.repeats + 1.0) / (self.repeats + self.changes + 2.0)
        return (self.run >= 4 and self.changes >= 50 and usual < 0.05
                and usual ** self.run < 1e-9)


class Spikes:
    """Spike detector. It holds up to three samples after a step far above the previous eight
    steps."""

    def __init__(self, threshold):
        self.threshold = threshold
        self.clear()

    def clear(self):
        self.held, self.before, self.steps = [], None, []

    def feed(self, sample, noise_std, step):
        """Add a sample; return [(sample, is a spike)] of all samples that are now classified."""
        if self.before is None:
            return self.release(sample)
        steps = np.abs(sample.field - self.before.field)
        if noise_std is None and self.steps:
            recent = np.nan_to_num(self.steps[-8:])
            step = np.where(np.isfinite(step), step, min(*step, 1.5e-6))
            noise_std = np.fmax(recent.max(axis=0) / 2.4, step / np.sqrt(12.0))
        if self.held:
            largest = np.nan_to_num(np.array([s for _, s in self.held])).max(axis=0)
            axis = int(np.argmax(largest))
            if steps[axis] <= 0.3 * largest[axis]:
                known, self.held = [(h, True) for h, _ in self.held], []
                return known + self.judge(sample, steps, noise_std)
            if len(self.held) < 3:
                self.held.append((sample, steps))
                return []
            self.steps = []
            return self.release(sample)
        return self.judge(sample, steps, noise_std)

    def judge(self, sample, steps, noise_std):
        if len(self.steps) >= 8 and self.is_steep(sample, steps, noise_std):
            self.held.append((sample, steps))
            return []
        self.before = sample
        self.steps.append(steps)
        return [(sample, False)]

    def is_steep(self, sample, steps, noise_std):
        interval = 30.0 * (sample.stamp_ns - self.before.stamp_ns) * 1e-9
        steeper = max(8.0, 130.0 * interval ** 3)
        for axis in range(3):
            recent = [s[axis] for s in self.steps[-8:] if not np.isnan(s[axis])]
            if recent and steps[axis] > self.threshold * noise_std[axis] \
                    and steps[axis] > steeper * max(*recent, noise_std[axis]):
                return True
        return False

    def release(self, sample):
        """Return the held samples and `sample` as valid; the next sample is compared with
        `sample`."""
        known = [(h, False) for h, _ in self.held] + [(sample, False)]
        self.held, self.before = [], sample
        return known


class PlainCalibration:
    """Plain `Calibrate` that supports neither stored backgrounds nor a changed calibration."""

    def __init__(self, network, settings):
        self.network, self.settings = network, settings
        self.counts, self.accepted, self.last_ns = Counter(), Counter(), {}
        self.first_ns, self.unconfirmed = {}, {}
        self.repetition = {n: Repetition() for n in network.names}
        self.spikes = {n: Spikes(settings.spike_std) for n in network.names}
        self.decimators = {n: Decimator(settings.decimate_to_hz) for n in network.names}
        s, n = settings, len(network)
        self.backgrounds = {name: FedBackground(
            s.learn_s, calibrate.MEMORY_S, calibrate.GUARD_S, calibrate.BLOCK_S,
            calibrate.FREEZE_STD, s.relearn_s,
            network.background[i], network.noise_std[i],
            phase=i / n if n > calibrate.MAX_SYNCHRONOUS else None)
            for i, name in enumerate(network.names)}

    def feed(self, sample):
        name = sample.sensor
        if name not in self.backgrounds:
            return self.reject(f'unknown sensor {name}')
        self.backgrounds[name].evaluate_block()
        cause = self.fault(sample)
        if cause:
            return self.reject(cause)
        raw, sample = sample.field, self.corrected(sample)
        if np.isnan(sample.field).all():
            return self.reject('an axis that the correction needs is missing')
        cause = self.timestamp_fault(sample)
        if cause:
            return self.reject(cause)
        if self.settings.reject_stuck and self.repetition[name].is_stuck(sample.field):
            return self.reject('stuck sensor (repeated reading)')
        known = [(sample, False)]
        if self.settings.spike_std:
            background = self.backgrounds[name]
            known = self.spikes[name].feed(
                sample, np.sqrt(np.diagonal(background.covariance)) if background.ready else None,
                background.sensors[0]['step'])
        if known and not known[-1][1]:
            self.backgrounds[name].note(sample.stamp_ns, raw)
        for _, is_spike in known:
            if is_spike:
                self.reject('spike')
        return self.accept([s for s, is_spike in known if not is_spike])

    def reject(self, cause):
        self.counts[f'rejected: {cause}'] += 1
        return []

    def fault(self, sample):
        values, limit = np.abs(sample.field[~np.isnan(sample.field)]), self.settings.max_field
        if not len(values):
            return 'no axis reported (all NaN)'
        if np.isinf(values).any():
            return 'infinite value'
        if values.max() > limit:
            return f'above {limit:g} T (gauss or microtesla published as tesla?)'
        if sample.covariance is not None and self.settings.trust_covariances:
            present = ~np.isnan(sample.field)
            C = sample.covariance[np.ix_(present, present)]
            if not np.isfinite(C).all() or not np.allclose(C, C.T, atol=1e-6 * np.abs(C).max()) \
                    or not np.linalg.eigvalsh(C).min() > 0.0:
                return 'covariance is not positive definite'
        return None

    def corrected(self, sample):
        i = self.network.index(sample.sensor)
        offset, C = self.network.offset[i], self.network.correction[i]
        field, covariance = sample.field, sample.covariance
        field = field - (0.0 if offset is None else offset)
        if C is not None:
            missing = np.isnan(field)
            x, y, z = np.where(missing, 0.0, field)
            field = np.where((C != 0.0) @ missing, np.nan, C[:, 0] * x + C[:, 1] * y + C[:, 2] * z)
            covariance = None if covariance is None else C @ covariance @ C.T
        return MagSample(sample.stamp_ns - round(self.network.clock_offset[i] * NS),
                         sample.sensor, field, covariance)

    def timestamp_fault(self, sample):
        name, stamp, last = sample.sensor, sample.stamp_ns, self.last_ns.get(sample.sensor)
        if last is not None:
            longest = calibrate.MAX_FORWARD_JUMP_S * NS
            before = self.unconfirmed.pop(name, None)
            if stamp - last > longest:
                self.unconfirmed[name] = stamp
                if before is None or not 0 < stamp - before <= longest:
                    return 'timestamp too far ahead'
            if stamp <= last and last - stamp <= calibrate.MAX_BACKWARD_JUMP_S * NS:
                return 'duplicate timestamp' if stamp == last else 'out of order'
            if stamp <= last:
                self.backgrounds[name].forget()
                for _ in self.spikes[name].held:
                    self.reject('possible spike when time jumped back')
                self.spikes[name].clear()
                self.counts['time jumped back'] += 1
                self.first_ns.pop(name)
        self.last_ns[name] = stamp
        self.first_ns.setdefault(name, stamp)
        return None

    def accept(self, samples):
        out = []
        for s in samples:
            self.accepted[s.sensor] += 1
            decimated = [s]
            if self.settings.decimate_to_hz:
                decimator = self.decimators[s.sensor]
                decimated = [MagSample(stamp, s.sensor, field, None if s.covariance is None
                                       else s.covariance * decimator.noise_gain())
                             for stamp, field in decimator.feed(s.stamp_ns, s.field)]
                self.counts['removed by decimation'] += 1 - len(decimated)
                self.backgrounds[s.sensor].sensors[0]['n_averaged'] = decimator.factor or 1
            out += [c for d in decimated for c in self.calibrated(d)]
        return out

    def calibrated(self, sample):
        background = self.backgrounds[sample.sensor]
        time = (sample.stamp_ns - self.first_ns[sample.sensor]) / NS
        background.collect(time, sample.field)
        if not background.ready:
            self.counts['held back while learning'] += 1
            return []
        C = self.covariance(background, sample.covariance)
        field = sample.field - background.level(time)
        unknown = ~np.isnan(sample.field) & (np.isnan(field) | np.isnan(np.diagonal(C)))
        self.counts['axes held back while learning'] += bool(unknown.any())
        field = np.where(unknown, np.nan, field)
        if np.isnan(field).all():
            return []
        self.counts['calibrated'] += 1
        return [MagSample(sample.stamp_ns, sample.sensor, field, C)]

    def is_credible(self, own, noise):
        """Whether the covariance `own` is positive definite and its variances are within a factor
        of 25 of `noise`, with similar correlations."""
        present = ~np.isnan(noise.diagonal())
        own, noise = own[np.ix_(present, present)], noise[np.ix_(present, present)]
        if not np.isfinite(own).all() \
                or not np.allclose(own, own.T, atol=1e-6 * np.abs(own).max()) \
                or not np.linalg.eigvalsh(own).min() > 0.0:
            return False
        s, k = np.sqrt(own.diagonal()), np.sqrt(noise.diagonal())
        ratio = np.square(s / k)
        return (ratio <= 25.0).all() and (ratio >= 1.0 / 25.0).all() and np.abs(
            own / np.outer(s, s) - noise / np.outer(k, k)).max() <= 0.7

    def covariance(self, background, own):
        noise, s = background.covariance, background.sensors[0]
        if self.settings.trust_covariances and own is not None:
            return own
        if own is not None:
            if not self.is_credible(own, noise):
                self.counts['message covariances overruled by the measured noise'] += 1
                own = None
        C = noise - np.diag(s['step_variance']) if own is None else own
        return C + np.diag(s['step_variance'] * s['n_rest'] / s['n_averaged'])

    def flush(self):
        held = [h for s in self.spikes.values() for h, _ in s.held]
        for s in self.spikes.values():
            s.clear()
        return self.accept(held)
