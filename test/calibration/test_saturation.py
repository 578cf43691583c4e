"""Detection and exclusion of saturated readings."""

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.calibration.reading_faults import N_MARGIN, saturated_readings, with_margin
from support.live_runs import passes_of
from support.passes import ROAD, measured, random_path, unknowns_at
from support.samples import MagSample, one


def curve(n=200):
    return 500.0 * np.exp(-((np.arange(n) - 90.0) / 15.0)**2)


def noise(seed=1, n=200):
    return np.random.default_rng(seed).standard_normal((n, 3))


def on_x(values):
    """Readings with `values` on x, and noise on the other axes."""
    fields = noise(2, len(values))
    fields[:, 0] = values
    return fields


def test_saturation_is_detected_in_noise():
    noisy = curve() + noise()[:, 0]
    clipped = np.minimum(noisy, 300.0)
    assert np.array_equal(saturated_readings(on_x(clipped))[:, 0], noisy >= 300.0)
    assert np.array_equal(saturated_readings(-on_x(clipped))[:, 0], noisy >= 300.0)
    assert not saturated_readings(on_x(clipped))[:, 1:].any()
    assert not saturated_readings(on_x(noisy)).any()


def test_the_readings_next_to_a_saturated_reading_are_excluded():
    is_saturated = saturated_readings(on_x(np.minimum(curve() + noise()[:, 0], 300.0)))
    expected = np.convolve(is_saturated[:, 0], np.ones(2 * N_MARGIN + 1), 'same') > 0.0
    excluded = with_margin(is_saturated)
    assert np.array_equal(excluded[:, 0], expected) and not excluded[:, 1:].any()


@pytest.mark.parametrize('step', [0.3, 0.85, 1.0, 1.5, 2.0, 3.0, 5.0, 20.0])
@pytest.mark.parametrize('seed', range(5))
def test_steps_in_noise_are_not_saturation(seed, step):
    """At rest, an axis repeats its extremes; the peak of a pass may be a few equal readings."""
    fields = curve()[:, None] * [1.0, 0.1, 0.0] + noise(seed)
    assert not saturated_readings(np.round(fields / step) * step).any()
    assert not saturated_readings(np.round(noise(seed, 2000) / step) * step).any()


@pytest.mark.parametrize('step', [0.3, 1.0, 2.0])
def test_a_limit_is_found_in_coarse_steps(step):
    clipped = np.minimum(np.round((curve() + noise()[:, 0]) / step) * step, 120.0 * step)
    found = saturated_readings(on_x(clipped))
    assert np.array_equal(found[:, 0], clipped == 120.0 * step)


def test_a_target_that_stands_is_not_saturation():
    """Its field is constant as well, and may begin and end as suddenly."""
    standing = np.concatenate([curve()[:90], np.full(100, 500.0), curve()[90:]])
    fields = np.round((standing + noise(3, 300)[:, 0]) / 3.0) * 3.0
    assert not saturated_readings(on_x(fields)).any()


def test_held_readings_are_not_saturation():
    fields = curve()[:, None] * [1.0, 0.7, -0.4] + noise()
    fields[88:96] = fields[88]
    assert not saturated_readings(fields).any()


def test_a_jump_to_a_value_is_not_saturation():
    """The end of the range is also a mark for a missing reading."""
    fields = noise()
    fields[50:60, 0] = 500.0
    assert not saturated_readings(fields).any()


def test_missing_or_stuck_readings_are_not_saturation():
    clipped = np.minimum(curve() + noise()[:, 0], 300.0)
    clipped[::7] = np.nan
    found = saturated_readings(on_x(clipped))
    assert found.any() and not found[::7].any()
    assert not saturated_readings(np.full((50, 3), 3.0)).any() \
        and not saturated_readings(np.full((5, 3), np.nan)).any() \
        and not saturated_readings(np.zeros((0, 3))).any()


def test_a_saturated_segment_is_excluded_from_a_pass_and_reported():
    """The fit to a pass clipped at a third of its peak is correct within its covariance."""
    from mag_tracking.analysis.pass_fit import fit_pass

    rng = np.random.default_rng(11)
    path, moments = random_path(rng, 1, True)
    path[3:6] = [8.0, 0.0, 0.0]
    data = measured(ROAD, path, moments, rng, seconds=16.0)
    limit = np.abs(data.field[data.sensor == 0]).max() / 3.0
    field = np.where((data.sensor == 0)[:, None], np.clip(data.field, -limit, limit), data.field)
    batches = (one(MagSample(int(round(1e9 * (20.0 + data.t[k]))), ROAD.names[data.sensor[k]],
                             field[k] + ROAD.R_sw[data.sensor[k]] @ ROAD.earth_field))
               for k in np.argsort(data.t, kind='stable'))
    (clipped, notes), = passes_of(ROAD, batches)
    assert any('mag_1' in n and 'saturated' in n and 'not used' in n for n in notes)
    fit = fit_pass(clipped, 1)
    assert not fit.reason
    error = fit.x[:9] - unknowns_at(path, moments, fit.data.stamp_ns / 1e9 - 20.0)
    assert error @ np.linalg.solve(fit.covariance[:9, :9], error) < chi2.ppf(0.999, 9)
