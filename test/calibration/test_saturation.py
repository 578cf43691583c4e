"""Detection and exclusion of saturated readings."""

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.apps.pass_collector import PassCollector
from mag_tracking.calibration.saturation import N_MARGIN, saturated_readings
from mag_tracking.pipeline import settings_for
from support.passes import ROAD, measured, random_path, unknowns_at
from support.samples import MagSample, one


def curve(n=200):
    return 500.0 * np.exp(-((np.arange(n) - 90.0) / 15.0)**2)


def test_saturation_is_detected_in_noise():
    noisy = curve() + np.random.default_rng(1).standard_normal(200)
    clipped = np.minimum(noisy, 300.0)
    expected = np.convolve(noisy >= 300.0, np.ones(2 * N_MARGIN + 1), 'same') > 0.0
    assert expected.sum() < 60
    assert np.array_equal(saturated_readings(clipped), expected)
    assert np.array_equal(saturated_readings(-clipped), expected)
    assert not saturated_readings(noisy).any()


@pytest.mark.parametrize('step', [1.0, 5.0, 20.0])
def test_coarse_steps_are_not_saturation(step):
    assert not saturated_readings(np.round(curve() / step) * step).any()


def test_saturation_requires_three_equal_readings():
    assert saturated_readings([0.0, 1.0, 5.0, 5.0, 5.0, 1.0, 0.0]).all()
    assert not saturated_readings([0.0, 1.0, 5.0, 5.0, 1.0]).any() \
        and not saturated_readings([]).any()


def test_missing_or_stuck_readings_are_not_saturation():
    clipped = np.minimum(curve() + np.random.default_rng(1).standard_normal(200), 300.0)
    clipped[::7] = np.nan
    found = saturated_readings(clipped)
    assert found.any() and not found[::7].any()
    assert not saturated_readings(np.full(50, 3.0)).any() \
        and not saturated_readings(np.full(5, np.nan)).any()


def test_a_saturated_segment_is_excluded_from_a_pass_and_reported():
    """The fit to a pass clipped at a third of its peak is correct within its covariance."""
    from mag_tracking.analysis.pass_fit import fit_pass

    rng = np.random.default_rng(11)
    path, moments = random_path(rng, 1, True)
    path[3:6] = [8.0, 0.0, 0.0]
    data = measured(ROAD, path, moments, rng, seconds=16.0)
    limit = np.abs(data.field[data.sensor == 0]).max() / 3.0
    field = np.where((data.sensor == 0)[:, None], np.clip(data.field, -limit, limit), data.field)
    collector, passes = PassCollector(ROAD, settings_for('vehicle')), []
    for k in np.argsort(data.t, kind='stable'):
        passes += collector.feed(one(MagSample(int(round(1e9 * (20.0 + data.t[k]))),
                                               ROAD.names[data.sensor[k]], field[k] + 4e-5)))
    passes += collector.flush()
    (clipped, notes), = passes
    assert any('mag_1' in n and 'saturated' in n and 'not used' in n for n in notes)
    fit = fit_pass(clipped, 1)
    assert not fit.reason
    error = fit.x[:9] - unknowns_at(path, moments, fit.data.stamp_ns / 1e9 - 20.0)
    assert error @ np.linalg.solve(fit.covariance[:9, :9], error) < chi2.ppf(0.999, 9)
