"""Trusted quantities of a fit: residuals of real vehicles, and the limit of each quantity."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.analysis.pass_description import SensorErrors
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.pass_result import PassFit
from mag_tracking.analysis.pass_trust import (
    FittedRow,
    reach,
    residual_elsewhere,
    trusted_quantities,
)
from mag_tracking.apps.fit import fit
from mag_tracking.results.fit_folder import fit_row
from support.bundled import VEHICLES, vehicle_path
from support.close_pairs import estimates_of, pass_of, readings_of
from support.passes import NOISE, ROAD, measured, random_path, superposed

PATH = np.array([0.0, -2.0, 0.5, 10.0, 0.0, 0.0, 3.0])


def test_reach_covers_the_residuals_of_published_vehicles():
    """The costs are those of TSP14 Tables I and II, at 4.5 m. A cost means that (cost - 1) / 87 of
    the energy is unexplained; for trucks, (cost - 1) / (20 · 87)."""
    cars, trucks = (10, 14, 17), ((302.6, 9.09), (76.7, 11.25))
    for cost in cars:
        assert 1.0 < 4.5 * np.sqrt((cost - 1.0) / 87.0) <= reach(1, 0.0)
    for cost, length in ((1.6, 3.95), (1.5, 3.56), (1.5, 4.98), (1.3, 2.07)):
        assert 4.5 * np.sqrt((cost - 1.0) / 87.0) <= reach(3, length)
    for cost, length in trucks:
        assert 4.5 * np.sqrt((cost - 1.0) / (20.0 * 87.0)) <= reach(3, length)


def noisy_data_and_field(seed=3):
    rng = np.random.default_rng(seed)
    moments = 150.0 * rng.standard_normal((3, 3))
    noisy = measured(ROAD, PATH, moments, rng)
    clean = measured(ROAD, PATH, moments, rng, noise=0.0)
    return noisy, clean.field


def test_residuals_near_the_vehicle_are_not_elsewhere():
    data, field = noisy_data_and_field()
    W = data.whitening
    position = PATH[:3] + data.t[:, None] * PATH[3:6] - data.positions
    scale = np.minimum(1.0, 0.3 / np.linalg.norm(position, axis=1))[:, None]
    for residual, low, high in ((0.0 * field, 0.0, 0.0), (scale * field, 0.0, 1e-6),
                                (0.3 * field, 0.001, 0.2)):
        fraction = residual_elsewhere(data, [FittedRow(3, PATH, field)],
                                      np.einsum('nij,nj->ni', W, residual))
        assert low <= fraction <= high
    # The same residual at another time, as caused by a second vehicle.
    shifted_field = np.roll(field, 150, axis=0)
    fraction = residual_elsewhere(data, [FittedRow(3, PATH, field)],
                                  np.einsum('nij,nj->ni', W, 0.2 * shifted_field))
    assert fraction > 0.02


def test_noise_is_not_counted_as_residual_elsewhere():
    data, field = noisy_data_and_field()
    residual = np.random.default_rng(0).standard_normal(field.shape)
    weak = 1e-3 * field
    assert residual_elsewhere(data, [FittedRow(3, PATH, field)], residual) < 1e-6
    assert residual_elsewhere(data, [FittedRow(3, PATH, weak)], residual) < 0.05


@pytest.mark.parametrize('seed', [34, 36])
def test_speed_and_direction_are_trusted_without_the_length(seed):
    fit, (_, truth, _) = fit_pass(pass_of(seed), 3), readings_of(seed)
    assert 'not determined: a length' in fit.reason
    assert fit.trusted == ('speed', 'direction', 'time')
    assert abs(fit.speed[0] - abs(truth)) < 3.0 * fit.speed[1] < 0.5 * abs(truth)
    assert np.cos(fit.heading[0]) * truth > 0.0
    row = fit_row(fit)
    assert row['speed'] == fit.speed[0] and row['sd_heading_deg'] > 0.0 and row['sd_cpa_time'] > 0.0
    assert row['trusted'] == 'speed direction time' and np.isnan(row['x']) and np.isnan(row['mx'])


def test_a_single_fit_of_two_vehicles_is_not_trusted():
    rng = np.random.default_rng(2)
    first_path, m1 = random_path(rng, 3, True)
    second_path, m2 = random_path(rng, 3, True)
    first_path[:7] = 0.0, -1.75, 0.5, 9.0, 0.0, 0.0, 3.0
    second_path[:7] = 6.0, 1.75, 0.5, -11.0, 0.0, 0.0, 3.0
    both = superposed(measured(ROAD, first_path, m1, rng),
                      measured(ROAD, second_path, m2, rng, noise=1e-15))
    fit = fit_pass(both, 3)
    assert 'one target' in fit.reason and fit.trusted == ()


def test_a_near_vehicle_is_not_rejected_for_its_residuals():
    """At a distance of 0.8 m, correct fits leave 2.4 to 11.9 % of the energy unexplained."""
    for seed in (2, 9, 20):
        velocity, std = estimates_of(seed).fit
        assert abs(velocity / estimates_of(seed).truth - 1.0) < 0.1 and std < 0.25 * abs(velocity)


@pytest.mark.parametrize('errors', [SensorErrors(), SensorErrors(np.deg2rad(4.0), 0.03)])
def test_covariance_includes_the_errors_of_the_sensors(errors):
    """The mean normalised squared error is about one for the assumed rotations and gains."""
    z = []
    for seed in range(12):
        rng = np.random.default_rng([seed, 40])
        path, moments = random_path(rng, 1, True)
        data = measured(ROAD, path, moments, rng)
        field = data.field.copy()
        for j in range(2):
            a, b, c = errors.rotation_std * rng.standard_normal(3)
            rotation = np.array([[1.0, -c, b], [c, 1.0, -a], [-b, a, 1.0]])
            sensor_mask = data.sensor == j
            field[sensor_mask] = field[sensor_mask] @ rotation * (
                1.0 + errors.gain_std * rng.standard_normal(3))
        fit = fit_pass(replace(data, field=field), 1, errors=errors)
        without_errors = fit_pass(data, 1, errors=SensorErrors(0.0, 0.0))
        assert fit.speed[1] > 1.2 * without_errors.speed[1]
        true = path[:6] + np.r_[fit.data.stamp_ns / 1e9 * path[3:6], np.zeros(3)]
        P = fit.robust_covariance[:6, :6]
        e = fit.x[:6] - true
        z.append(e @ np.linalg.solve(P, e) / 6.0)
    # The limits are the 0.1 % and 99.9 % quantiles of chi-square over its mean, for 12 x 6 values.
    assert 0.4 < np.mean(z) < 1.7, np.round(z, 2)


def test_repeated_readings_of_a_coarse_sensor_are_counted_as_fractions():
    data, _ = noisy_data_and_field()
    scaled_covariance = data.covariance.copy()
    scaled_covariance[::2] *= 60.0
    assert data.n_independent == data.n_values
    coarse_data = replace(data, covariance=scaled_covariance)
    assert coarse_data.n_independent == pytest.approx(data.n_values / 2.0 * (1.0 + 1.0 / 60.0))
    np.testing.assert_allclose(coarse_data.whitening[0], data.whitening[0] / np.sqrt(60.0))
    np.testing.assert_allclose(coarse_data.whitening[1], np.eye(3) / NOISE)
    # Small variations of the noise estimate do not reduce the number of independent values.
    varied_covariance = data.covariance * np.linspace(1.0, 1.3, len(data.t))[:, None, None]
    assert replace(data, covariance=varied_covariance).n_independent == data.n_values


def point_fit(std_speed, std_heading, change=0.0):
    """Create the `PassFit` of a point with given stds of speed [m/s] and heading [rad].

    `change` is the apparent relative change of the velocity.
    """
    data, _ = noisy_data_and_field()
    x = np.concatenate([[0.0, -2.0, 0.5], [10.0, 0.0, 0.0], np.ones(9)])
    P = 1e-4 * np.eye(len(x))
    P[3, 3], P[4, 4] = std_speed**2, (10.0 * std_heading)**2
    return PassFit(1, data, '', True, tuple('u' * len(x)), x, P, P, 1.0, 1.0, 1.0,
                   velocity_change=change, velocity_change_std=0.05, residual_elsewhere=0.0)


def test_each_quantity_is_trusted_according_to_its_own_std():
    assert trusted_quantities(point_fit(0.5, 0.1)) == ('speed', 'direction', 'time')
    assert 'speed' not in trusted_quantities(point_fit(2.6, 0.1))
    # The direction is unknown if the speed does not differ significantly from zero.
    assert 'direction' not in trusted_quantities(point_fit(5.1, 0.1))
    assert 'direction' not in trusted_quantities(point_fit(0.5, 0.6)) \
        and 'speed' in trusted_quantities(point_fit(0.5, 0.6))
    uncertain_position = point_fit(0.5, 0.1)
    uncertain_position.robust_covariance[0, 0] = 4.0
    assert trusted_quantities(uncertain_position) == ('speed', 'direction')
    assert trusted_quantities(point_fit(0.5, 0.1, change=0.5)) == ()
    assert trusted_quantities(replace(point_fit(0.5, 0.1), residual_elsewhere=0.01)) == ()


@pytest.mark.parametrize('name', [n for n in VEHICLES if 'turns' in n])
def test_no_fit_of_a_turn_is_trusted(name, road_network):
    (fitted_pass,) = fit(vehicle_path(name), road_network).passes
    assert fitted_pass.chosen is None and fitted_pass.reported is None
