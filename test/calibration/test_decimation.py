"""Decimation: frequency response, timestamps, noise and restarts."""

import numpy as np
import pytest
from scipy.signal import freqz

from mag_tracking.calibration.decimation import Decimator, lowpass
from mag_tracking.settings import replace
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from support.networks import line_network
from support.samples import MagSample, fed

NS = 10**9


def run(decimator, t, field):
    """Timestamps [s] and fields after decimation."""
    out = [o for s, f in zip(t, field, strict=True)
           for o in decimator.feed(int(round(s * NS)), f)]
    return np.array([s / NS for s, _ in out]), np.array([f for _, f in out]).reshape(-1, 3)


@pytest.mark.parametrize('factor', [2, 4, 8, 10])
def test_lowpass_preserves_the_pass_band_and_suppresses_aliases(factor):
    taps = lowpass(factor)
    assert len(taps) % 2 and taps.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(taps, taps[::-1])
    w, h = freqz(taps, worN=8192)
    nyquist = np.pi / factor
    passed, aliased = w < 0.5 * nyquist, w > 1.5 * nyquist
    assert np.abs(np.abs(h[passed]) - 1.0).max() < 2e-3
    assert np.abs(h[aliased]).max() < 2e-3


def test_timestamps_compensate_the_delay_of_the_filter():
    t = 100.0 + np.arange(0.0, 4.0, 0.005)
    ramp = np.outer(t - 100.0, [1.0, -2.0, 0.5])
    stamps, fields = run(Decimator(25.0), t, ramp)
    assert len(stamps) > 60
    np.testing.assert_allclose(np.diff(stamps), 0.04, atol=2e-9)
    np.testing.assert_allclose(fields, np.outer(stamps - 100.0, [1.0, -2.0, 0.5]), atol=1e-8)


def test_a_hum_is_not_aliased():
    t = np.arange(0.0, 10.0, 1 / 400)
    # 52 Hz would be aliased to 2 Hz at 25 Hz.
    hum = np.outer(np.sin(2 * np.pi * 52.0 * t), np.ones(3))
    _, fields = run(Decimator(25.0), t, hum)
    assert np.abs(fields).max() < 2e-3 and len(fields) > 200
    assert np.abs(hum[::16]).max() > 0.9


def test_noise_is_reduced_by_the_noise_gain():
    rng = np.random.default_rng(0)
    d = Decimator(20.0)
    _, fields = run(d, np.arange(0.0, 300.0, 0.005), rng.standard_normal((60000, 3)))
    # The output of white noise is nearly white, so all values are independent.
    assert fields.var() == pytest.approx(d.noise_gain(), rel=4 * np.sqrt(2 / fields.size))
    assert d.noise_gain() < 0.12


def test_a_gap_or_a_clock_step_restarts_the_filter():
    t = np.arange(0.0, 6.0, 0.01)
    t[300:] += 1.0
    t[450:] -= 3.0
    level = np.zeros((600, 3))
    level[300:] = 1.0
    stamps, fields = run(Decimator(10.0), t, level)
    # No output mixes samples from both sides of a gap.
    assert set(np.round(fields[:, 0], 6)) <= {0.0, 1.0}
    before = stamps < 2.99
    assert 20 < before.sum() < len(stamps) - 10
    assert set(np.round(fields[stamps > 3.5, 0], 6)) == {1.0}


def test_a_slow_sensor_is_not_decimated():
    rng = np.random.default_rng(1)
    t, field = np.arange(0.0, 10.0, 0.1), rng.standard_normal((100, 3))
    d = Decimator(25.0)
    stamps, fields = run(d, t, field)
    assert d.factor == 1 and d.noise_gain() == 1.0
    np.testing.assert_array_equal(fields, field)
    np.testing.assert_allclose(stamps, t, atol=1e-9)


def test_a_missing_axis_stays_missing():
    field = np.ones((400, 3))
    field[:, 2] = np.nan
    _, fields = run(Decimator(10.0), np.arange(0.0, 4.0, 0.01), field)
    assert len(fields) and np.isnan(fields[:, 2]).all() and (np.abs(fields[:, :2] - 1) < 1e-9).all()


def test_stage_decimates_and_propagates_the_covariance():
    """The covariance is scaled by the noise gain; duplicate readings do not reach the filter."""
    network = line_network(1)
    stage = Calibrate(network, replace(CalibrateSettings(), {'decimate_to_hz': 20.0}))
    rng = np.random.default_rng(2)
    C, out = 1e-16 * np.eye(3), []
    for k in range(2000):
        sample = MagSample(k * 5_000_000, 'mag_1', 1e-5 + 1e-8 * rng.standard_normal(3), C)
        out += fed(stage, sample)
        if k % 3 == 0:
            out += fed(stage, sample)
    assert stage.counts['rejected: duplicate timestamp'] == 667
    assert stage.counts_of('mag_1')['accepted'] == 2000
    # There is no output until the background is known, after 200 samples.
    assert len(out) == stage.counts['calibrated'] > 120
    reference = Decimator(20.0)
    run(reference, np.arange(0.0, 1.0, 0.005), np.zeros((200, 3)))
    np.testing.assert_allclose(out[-1].covariance, C * reference.noise_gain())
    assert np.std([s.field for s in out]) < 1e-8 * np.sqrt(1.5 * reference.noise_gain())
