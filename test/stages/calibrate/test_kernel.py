"""Compiled calibration: results do not depend on batches, and match a Python implementation."""

import dataclasses

import numpy as np
import pytest

from mag_tracking.calibration import core
from mag_tracking.records import Readings
from mag_tracking.stages.calibrate import stage as calibrate
from mag_tracking.stages.calibrate.output_buffer import OVERRULED
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from support.counters import count_of
from support.faulty_streams import FAULTS, stream
from support.networks import line_network
from support.plain_calibration import PlainCalibration
from support.samples import MagSample, batch, one, samples_of


def assert_equal(found, expected):
    """Assert that two lists of samples are equal up to rounding errors."""
    assert [(s.stamp_ns, s.sensor) for s in found] == [(s.stamp_ns, s.sensor) for s in expected]
    for name in ('field', 'covariance'):
        a, b = (np.array([getattr(s, name) for s in some]) for some in (found, expected))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-16 if name == 'field' else 1e-30)


def batches(samples, size, rng):
    """Split samples into batches of `size` readings on average."""
    ends = np.cumsum(rng.integers(1, 2 * size, len(samples)))
    return [batch(list(some)) for some in np.split(
        np.array(samples, dtype=object), ends[ends < len(samples)])]


def calibrated(stage, items, idles=False):
    """Calibrate batches and flush the stage; return [MagSample].

    If `idles` is true, `idle` is called after two of three batches. Nodes call it between batches.
    """
    out = []
    for k, readings in enumerate(items):
        out += stage.feed(readings)
        if idles and k % 3:
            stage.idle()
    return samples_of(*out, *stage.flush())


def checked_stage(network, samples, size=20, **settings):
    """Assert that single readings and batches give the same results as plain Python.

    Returns the stage that processed the batches.
    """
    chosen = CalibrateSettings(**settings)
    plain, single, many = (PlainCalibration(network, chosen), Calibrate(network, chosen),
                           Calibrate(network, chosen))
    expected = [c for s in samples for c in plain.feed(s)] + plain.flush()
    assert_equal(calibrated(single, map(one, samples), idles=True), expected)
    assert_equal(calibrated(many, batches(samples, size, np.random.default_rng(0)), idles=True),
                 expected)
    for stage in (single, many):
        assert +stage.counts == +plain.counts
        for name in network.names:
            assert stage.counts_of(name)['accepted'] == plain.accepted[name]
            assert stage.last_stamp_ns(name) == plain.last_ns.get(name)
    return many


@pytest.mark.parametrize('is_large_and_corrected', [False, True])
@pytest.mark.parametrize('fault', [None, *FAULTS])
def test_a_pass_with_a_fault_matches_plain_python(monkeypatch, fault, is_large_and_corrected):
    network, samples, *_ = stream(2, 3, fault)
    if is_large_and_corrected:
        monkeypatch.setattr(calibrate, 'MAX_SYNCHRONOUS', 1)
        network = corrected(network)
    assert checked_stage(network, samples).counts['calibrated'] > 1000


def corrected(network):
    """Add clock offsets, hard iron and soft iron to all sensors of a network except the first."""
    rng, n = np.random.default_rng(5), len(network)
    return dataclasses.replace(
        network, clock_offset=np.array([0.0, *rng.uniform(-0.02, 0.02, n - 1)]),
        offset=(None, *(2e-6 * rng.standard_normal(3) for _ in range(n - 1))),
        correction=(None, *(np.eye(3) + 0.02 * rng.standard_normal((3, 3))
                            for _ in range(n - 1))))


def suspect_samples(samples, rng):
    """Yield samples, some with a missing axis, a covariance, an unknown sensor or an old timestamp.
    """
    for s in samples:
        kind = rng.integers(60)
        field = s.field.copy()
        if kind == 0:
            field[rng.integers(3)] = np.nan
        C = {1: 1e-16 * np.eye(3), 4: -1e-16 * np.eye(3)}.get(int(kind))
        yield MagSample(s.stamp_ns, 'stranger' if kind == 2 else s.sensor, field, C)
        if kind == 3:
            yield MagSample(s.stamp_ns - 5_000_000, s.sensor, field)


@pytest.mark.parametrize('settings', [
    {}, {'reject_stuck': False, 'spike_std': 0.0}, {'decimate_to_hz': 20.0},
    {'trust_covariances': True}])
def test_suspect_readings_of_corrected_sensors_match_plain_python(settings):
    network, samples, *_ = stream(4, 7)
    samples = list(suspect_samples(samples, np.random.default_rng(1)))
    stage = checked_stage(corrected(network), samples, **settings)
    n = stage.counts['rejected: covariance is not positive definite']
    assert n > 50 if 'trust_covariances' in settings else n == 0
    assert (stage.counts[OVERRULED] > 0) == ('trust_covariances' not in settings)


def test_a_new_calibration_and_relearning_do_not_depend_on_batches():
    network, samples, *_ = stream(2, 9)
    found = []
    for size in (1, 37):
        stage, out = Calibrate(network, CalibrateSettings()), []
        for k, part in enumerate((samples[:800], samples[800:1600], samples[1600:])):
            if k == 1:
                stage.update_network(corrected(network))
            if k == 2:
                stage.forget(['mag_1'])
            for i in range(0, len(part), size):
                out += stage.feed(batch(part[i:i + size]))
        found.append((samples_of(*out), stage.counts))
    assert_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]
    assert count_of(found[0][1], 'held back') > 2 * 300


def test_later_readings_do_not_modify_earlier_outputs():
    network, samples, *_ = stream(2, 9)
    stage = Calibrate(network, CalibrateSettings())
    outputs = [r for b in batches(samples, 30, np.random.default_rng(0)) for r in stage.feed(b)]
    copies = [(g.field.copy(), g.covariance.copy()) for g in outputs]
    stage.feed(batch(samples[-2:]))
    for g, (field, C) in zip(outputs, copies, strict=True):
        np.testing.assert_array_equal(g.field, field)
        np.testing.assert_array_equal(g.covariance, C)


def test_valid_readings_need_python_once_per_block(monkeypatch):
    """At 100 Hz a block has 25 readings; only its end and that of a window need Python."""
    network, samples, *_ = stream(2, 3)
    stage, reasons, compiled = Calibrate(network, CalibrateSettings()), [], \
        core.calibrate_readings
    monkeypatch.setattr(core, 'calibrate_readings',
                        lambda *a: reasons.append(compiled(*a)) or reasons[-1])
    parts = batches(samples, 100, np.random.default_rng(0))
    for b in parts:
        stage.feed(b)
    assert reasons.count(core.DONE) == len(parts)
    # The first 512 readings of a sensor are examined for faults of the driver in eight steps.
    assert len(reasons) - len(parts) <= len(samples) / 25 + 9 * len(network)


@pytest.mark.parametrize('seed', range(4))
def test_a_stuck_sensor_is_rejected_after_its_correction(seed):
    """The corrected readings of the sensor are bitwise identical."""
    rng, network = np.random.default_rng(seed), corrected(line_network(2))
    fields = np.array([2e-6, 1.55e-5, -4.9e-5]) + 1.2e-8 * rng.standard_normal((1600, 3))
    fields[400:] = fields[400]
    samples = [MagSample(10**18 + k * 25_000_000, 'mag_2', f) for k, f in enumerate(fields)]
    stage = checked_stage(network, samples)
    assert stage.counts['rejected: stuck sensor (repeated reading)'] > 1100


def test_an_axis_that_appears_later_is_held_back_while_learning():
    network, rng = line_network(1), np.random.default_rng(0)
    fields = np.array([2e-6, 1.55e-5, -4.9e-5]) + 1.2e-8 * rng.standard_normal((1000, 3))
    fields[:600, 1] = np.nan
    stage = checked_stage(network, [MagSample(10**18 + k * 10**7, 'mag_1', f)
                                    for k, f in enumerate(fields)])
    assert count_of(stage.counts, 'axes held') > 20


def test_arrays_of_other_types_and_layouts_are_accepted():
    network, samples, *_ = stream(2, 9)
    readings = batch(samples)
    stage, other = (Calibrate(network, CalibrateSettings()) for _ in range(2))
    field = np.asfortranarray(readings.field)
    field.flags.writeable = False
    converted = Readings(readings.names, readings.sensor.astype(np.uint16),
                         readings.stamp_ns.astype(np.uint64), field)
    (found,), (expected,) = other.feed(converted), stage.feed(readings)
    np.testing.assert_array_equal(found.field, expected.field)


def test_an_empty_batch_gives_no_output():
    stage = Calibrate(line_network(2), CalibrateSettings())
    assert stage.feed(batch([])) == [] and stage.flush() == [] and not stage.counts


def test_repeated_readings_of_a_coarse_sensor_match_plain_python():
    network, rng = line_network(1), np.random.default_rng(2)
    fields = np.round(1.2e-8 * rng.standard_normal((2000, 3)) / 1.5e-8) * 1.5e-8 + 1e-5
    assert np.count_nonzero((np.diff(fields, axis=0) == 0.0).all(axis=1)) > 50
    checked_stage(network, [MagSample(10**18 + k * 10**7, 'mag_1', f)
                            for k, f in enumerate(fields)])


@pytest.mark.parametrize('is_recalibrated', [False, True])
def test_decimated_samples_do_not_depend_on_batches(is_recalibrated):
    """A decimator measures the rate over 32 samples, and then returns these samples together."""
    network = dataclasses.replace(line_network(2), background=(np.zeros(3),) * 2,
                                  noise_std=(np.full(3, 1e-8),) * 2)
    rng = np.random.default_rng(0)
    samples = [MagSample(10**18 + k * 5 * 10**7, f'mag_{j}', 1e-8 * rng.standard_normal(3))
               for k in range(200) for j in (1, 2)]
    found = []
    for size in (1, 7, 400):
        stage, out = Calibrate(network, CalibrateSettings(decimate_to_hz=20.0)), []
        for i in range(0, 400, size):
            if is_recalibrated and i <= 40 < i + size:
                stage.update_network(dataclasses.replace(network, clock_offset=np.zeros(2)))
            out.append(sum(map(len, stage.feed(batch(samples[i:i + size])))))
        found.append((sum(out), stage.counts['calibrated']))
        assert size > 1 or max(out) == 32
    assert len(set(found)) == 1 or is_recalibrated


def test_corrupt_timestamps_do_not_confirm_each_other():
    """Each corrupt timestamp is followed by a valid one; two in a row would be a clock step."""
    stage = Calibrate(dataclasses.replace(line_network(1), background=(np.zeros(3),)),
                      CalibrateSettings())
    times_s = [1, 2, 1000, 3, 1001, 4, 1000.5, 5]
    for k, t in enumerate(times_s):
        stage.feed(one(MagSample(int(t * 1e9), 'mag_1', np.full(3, 1e-8 * (k + 1)))))
    assert count_of(stage.counts, 'ahead') == 3
    assert stage.counts['calibrated'] == 5


def test_a_clock_step_is_confirmed_once_even_with_a_stored_background():
    network = dataclasses.replace(line_network(1), background=(np.zeros(3),))
    first = Calibrate(network, CalibrateSettings())
    first.feed(one(MagSample(10**9, 'mag_1', np.full(3, 1e-8))))
    stored = first.stored('mag_1')
    stage = Calibrate(network, CalibrateSettings())
    for k, t in enumerate((0.0, 100.0, 100.1, 100.2)):
        if k == 1:
            stage.resume({'mag_1': stored})
        stage.feed(one(MagSample(int((t + 1.0) * 1e9), 'mag_1', np.full(3, 1e-8 * (k + 1)))))
    assert count_of(stage.counts, 'ahead') == 1


def test_flush_clears_the_history_of_spike_screening():
    network = dataclasses.replace(line_network(1), background=(np.zeros(3),))
    stage, rng = Calibrate(network, CalibrateSettings()), np.random.default_rng(0)

    def feed(k, offset=0.0):
        return len(samples_of(*stage.feed(one(MagSample(
            10**18 + k * 10**7, 'mag_1', offset + 1e-8 * rng.standard_normal(3))))))

    assert all(feed(k) for k in range(20))
    assert stage.flush() == []
    assert feed(20, 5e-6)


def test_a_covariance_needs_no_axis_that_the_correction_ignores():
    C = np.array([[1.02, 0.03, 0.0], [-0.01, 0.97, 0.0], [0.0, 0.0, 1.0]])
    network = dataclasses.replace(line_network(1), background=(np.zeros(3),), correction=(C,))
    stated = np.diag([1e-16, 2e-16, np.nan])
    (out,) = samples_of(*Calibrate(network, CalibrateSettings()).feed(one(
        MagSample(10**18, 'mag_1', np.array([1e-8, 2e-8, np.nan]), stated))))
    np.testing.assert_allclose(out.covariance[:2, :2], C[:2, :2] @ stated[:2, :2] @ C[:2, :2].T)
    assert np.isnan(out.field[2]) and not np.isnan(out.field[:2]).any()
