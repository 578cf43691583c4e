"""The compiled way of readings that nothing is odd about: it does what the other one does."""

import numpy as np
import pytest

from mag_tracking.records import MagSample, Readings
from mag_tracking.stages.calibrate import stage as calibrate
from mag_tracking.stages.calibrate.settings import CalibrateSettings
from mag_tracking.stages.calibrate.stage import Calibrate
from support.faulty_streams import FAULTS, stream
from support.networks import line_network


class Slow(Calibrate):
    """All that comes goes the way of what is odd."""

    def _note(self, i):
        super()._note(i)
        self._sensors[i]['is_ordinary'] = False


class Idling(Calibrate):
    """Learns behind what it gives out, now and then, as the node does; not when it is told to."""

    n_calls = 0

    def feed(self, sample):
        return self._then_idle(super().feed(sample))

    def feed_many(self, readings):
        return self._then_idle(super().feed_many(readings))

    def _then_idle(self, out):
        self.n_calls += 1
        if self.n_calls % 3:
            self.idle()
        return out


KEPT = ('accepted', 'first_ns', 'last_ns', 'now', 'is_full', 'n', 'end', 'time', 'origin', 'count',
        'sum')
SCREENED = ('last', 'run', 'repeats', 'changes', 'before_ns', 'before', 'n_steps')
"""What both ways have to have made of the readings, and where they are screened."""


def samples_alike(found, expected):
    """Whether two lists of samples are the same, but for rounding."""
    assert [(s.stamp_ns, s.sensor) for s in found] == [(s.stamp_ns, s.sensor) for s in expected]
    for name in ('field', 'covariance'):
        a, b = (np.array([getattr(s, name) for s in some]) for some in (found, expected))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-16 if name == 'field' else 1e-30)


def batches(samples, size, rng):
    """The same as `Readings` of about `size`."""
    ends = np.cumsum(rng.integers(1, 2 * size, len(samples)))
    return [Readings.of(list(some)) for some in np.split(
        np.array(samples, dtype=object), ends[ends < len(samples)])]


def calibrated_in_three_ways(network, samples, size=20, **settings):
    """(stage that went the slow way, one by one, in batches), which have given the same."""
    slow, single, many = (kind(network, CalibrateSettings(**settings))
                          for kind in (Slow, Idling, Idling))
    expected = [c for s in samples for c in slow.feed(s)] + slow.flush()
    samples_alike([c for s in samples for c in single.feed(s)] + single.flush(), expected)
    samples_alike([c for b in batches(samples, size, np.random.default_rng(0))
                   for c in many.feed_many(b).samples()] + many.flush(), expected)
    slow.idle()
    for stage in (single, many):
        stage.idle()
        assert stage.counts == slow.counts
        for name in (*KEPT, *(() if settings.get('spike_std') == 0.0 else SCREENED)):
            np.testing.assert_allclose(stage._sensors[name], slow._sensors[name], rtol=1e-9,
                                       atol=1e-20, err_msg=name)
        for name in network.names:
            assert stage.counts_of(name) == slow.counts_of(name)
            assert stage.last_stamp_ns(name) == slow.last_stamp_ns(name)
    return slow, single, many


@pytest.mark.parametrize('is_large', [False, True])
@pytest.mark.parametrize('is_corrected', [False, True])
@pytest.mark.parametrize('fault', [None, *FAULTS])
def test_a_pass_with_a_fault(monkeypatch, fault, is_corrected, is_large):
    if is_large:
        monkeypatch.setattr(calibrate, 'AT_ONCE', 1)
    network, samples, *_ = stream(4, 3, fault)
    if is_corrected:
        network = corrected(network)
    slow, _, many = calibrated_in_three_ways(network, samples)
    assert slow.counts['calibrated'] > 1000
    assert (many._sensors['is_ordinary'] == 1).any()


def corrected(network):
    """With clocks, offsets and soft iron of all sensors but the first."""
    rng, n = np.random.default_rng(5), len(network)
    return type(network)(**{
        **{f: getattr(network, f) for f in network.__dataclass_fields__},
        'clock_offset': np.array([0.0, *rng.uniform(-0.02, 0.02, n - 1)]),
        'offset': (None, *(2e-6 * rng.standard_normal(3) for _ in range(n - 1))),
        'correction': (None, *(np.eye(3) + 0.02 * rng.standard_normal((3, 3))
                               for _ in range(n - 1)))})


def odd_ones(samples, rng):
    """With axes that are missing, covariances of their own, and sensors that nobody knows."""
    for s in samples:
        kind = rng.integers(60)
        field = s.field.copy()
        if kind == 0:
            field[rng.integers(3)] = np.nan
        C = 1e-16 * np.eye(3) if kind == 1 else None
        yield MagSample(s.stamp_ns, 'stranger' if kind == 2 else s.sensor, field, C)
        if kind == 3:
            yield MagSample(s.stamp_ns - 5_000_000, s.sensor, field)


def test_corrected_sensors_and_odd_readings():
    network, samples, *_ = stream(4, 7)
    samples = list(odd_ones(samples, np.random.default_rng(1)))
    network = corrected(network)
    calibrated_in_three_ways(network, samples)
    calibrated_in_three_ways(network, samples, reject_stuck=False, spike_std=0.0)
    calibrated_in_three_ways(network, samples, decimate_to_hz=20.0)


def test_another_calibration_and_learning_anew_in_the_middle():
    network, samples, *_ = stream(2, 9)
    stages, out = [Slow(network, CalibrateSettings()), Calibrate(network, CalibrateSettings())], []
    for stage in stages:
        found = []
        for k, s in enumerate(samples):
            if k == 800:
                stage.renew(corrected(network))
            if k == 1600:
                stage.forget(['mag_1'])
            found += stage.feed(s)
        out.append(found)
    samples_alike(*out)
    assert stages[0].counts == stages[1].counts


def test_what_is_given_out_does_not_change_later():
    network, samples, *_ = stream(2, 9)
    stage = Calibrate(network, CalibrateSettings())
    given = [stage.feed_many(b) for b in batches(samples, 30, np.random.default_rng(0))]
    kept = [(g.field.copy(), None if g.covariance is None else g.covariance.copy())
            for g in given]
    stage.feed_many(Readings.of(samples[-2:]))
    for g, (field, C) in zip(given, kept, strict=True):
        np.testing.assert_array_equal(g.field, field)
        assert C is None or np.array_equal(g.covariance, C, equal_nan=True)


def test_nearly_all_readings_take_it(monkeypatch):
    network, samples, *_ = stream(4, 3)
    stage, odd = Calibrate(network, CalibrateSettings()), []
    feed_any = stage._feed_any
    monkeypatch.setattr(stage, '_feed_any', lambda s: odd.append(s) or feed_any(s))
    for b in batches(samples, 20, np.random.default_rng(0)):
        stage.feed_many(b)
    # Three seconds of learning, and behind one in 25 a block is judged.
    learning = stage.counts['held back while learning']
    assert len(odd) - learning < 0.1 * (len(samples) - learning)


@pytest.mark.parametrize('seed', range(4))
def test_a_corrected_sensor_that_is_stuck(seed):
    """Its readings are alike to the last bit whichever way they go."""
    rng, network = np.random.default_rng(seed), corrected(line_network(2))
    fields = np.array([2e-6, 1.55e-5, -4.9e-5]) + 1.2e-8 * rng.standard_normal((1600, 3))
    fields[400:] = fields[400]
    samples = [MagSample(10**18 + k * 25_000_000, 'mag_2', f) for k, f in enumerate(fields)]
    slow, *_ = calibrated_in_three_ways(network, samples)
    assert slow.counts['rejected: the same reading over and over'] > 1100


def test_a_background_without_an_axis_is_no_ordinary_one():
    network, rng = line_network(1), np.random.default_rng(0)
    fields = np.array([2e-6, 1.55e-5, -4.9e-5]) + 1.2e-8 * rng.standard_normal((1000, 3))
    fields[:600, 1] = np.nan
    calibrated_in_three_ways(network, [MagSample(10**18 + k * 10**7, 'mag_1', f)
                                       for k, f in enumerate(fields)])


def test_arrays_of_other_kinds_are_readings_too():
    network, samples, *_ = stream(2, 9)
    readings = Readings.of(samples)
    stage, other = (Calibrate(network, CalibrateSettings()) for _ in range(2))
    field = np.asfortranarray(readings.field)
    field.flags.writeable = False
    odd = Readings(readings.names, readings.sensor.astype(np.uint16),
                   readings.stamp_ns.astype(np.uint64), field)
    np.testing.assert_array_equal(other.feed_many(odd).field, stage.feed_many(readings).field)


def test_coarse_steps_repeat_themselves():
    network, rng = line_network(1), np.random.default_rng(2)
    fields = np.round(1.2e-8 * rng.standard_normal((2000, 3)) / 1.5e-8) * 1.5e-8 + 1e-5
    slow, *_ = calibrated_in_three_ways(network, [MagSample(10**18 + k * 10**7, 'mag_1', f)
                                                  for k, f in enumerate(fields)])
    assert slow._sensors['repeats'][0] > 50
