"""Batch fit of a pass: model, global search, covariances, and rejected data."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from mag_tracking.analysis.fitted_pass import choose_order, order_criteria
from mag_tracking.analysis.pass_data import separable_problem
from mag_tracking.analysis.pass_description import SensorErrors
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.pass_result import MIN_CPA_FRACTION, PassFit, scaled_to_range
from mag_tracking.apps.fit import fit
from mag_tracking.inference.identification import hard_and_soft_iron
from mag_tracking.inference.least_squares import refine, score_sum_covariance
from mag_tracking.physics.dipole import MU0, dipole_field
from mag_tracking.physics.passes import RowPass
from support.bundled import VEHICLES, vehicle_path
from support.passes import (
    EARTH,
    NOISE,
    ROAD,
    measured,
    network_of,
    random_path,
    superposed,
    unknowns_at,
)

ORDERS = (1, 2, 3)


def random_row(n_dipoles, n=6, seed=4):
    """Create a random model with `n` samples, and random paths and linear parameters."""
    rng = np.random.default_rng(seed)
    M = rng.standard_normal((n, 3, 3))
    model = RowPass(rng.uniform(-1.0, 1.0, n), rng.uniform(-5.0, 5.0, (n, 3)), M, n_dipoles)
    theta = rng.uniform(1.0, 4.0, (5, len(model.names)))
    theta[:, 3] += 5.0
    return model, theta, rng.standard_normal((5, 3 * n_dipoles))


@pytest.mark.parametrize('n_dipoles', [1, 2, 3, 4])
def test_a_row_is_the_sum_of_its_dipoles(n_dipoles):
    model, theta, p = random_row(n_dipoles)
    moments = (model.combinations @ p[0]).reshape(-1, 3)
    direction = theta[0, 3:6] / np.linalg.norm(theta[0, 3:6])
    expected = np.zeros((6, 3))
    for i, m in enumerate(moments):
        ahead = (i - (n_dipoles - 1) / 2) * theta[0, 6] / (n_dipoles - 1) if n_dipoles > 1 else 0.0
        r = theta[0, :3] + model.t[:, None] * theta[0, 3:6] + ahead * direction
        expected += np.einsum('nij,nj->ni', model.M, dipole_field(model.positions - r, m))
    field = (model.basis(theta)[0] @ p[0]).reshape(-1, 3)
    np.testing.assert_allclose(field, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize('road', [True, False], ids=['road', 'any heading'])
@pytest.mark.parametrize('n_dipoles', ORDERS)
def test_the_search_finds_the_global_optimum(n_dipoles, road):
    """The cost does not exceed the minimum near the truth.

    `bench.pass_search` measures the same on more passes.
    """
    failures = []
    for seed in range(10):
        rng = np.random.default_rng([seed, n_dipoles, road])
        path, moments = random_path(rng, n_dipoles, road)
        data = measured(ROAD, path, moments, rng)
        fit = fit_pass(data, n_dipoles)
        problem = separable_problem(data, lambda *a: RowPass(*a, n_dipoles=n_dipoles))
        _, cost, _, _ = refine(problem.residual_and_jacobian, path[None], 100, 1e-8)
        if not fit.cost <= cost[0] * (1.0 + 1e-6):
            failures.append((seed, fit.cost, cost[0], fit.reason))
    assert not failures


@pytest.mark.parametrize('n_dipoles', ORDERS)
def test_errors_agree_with_the_covariance(n_dipoles):
    """NEES (TSP14 eq. (47)) and cost of 25 passes are within their chi-square bands."""
    nees, costs, n = [], [], 25
    for seed in range(n):
        rng = np.random.default_rng([seed, n_dipoles, 7])
        path, moments = random_path(rng, n_dipoles, True)
        fit = fit_pass(measured(ROAD, path, moments, rng), n_dipoles)
        true = unknowns_at(path, moments, (fit.data.stamp_ns) / 1e9)
        k = len(true)
        error = fit.x[:k] - true
        # Skip ambiguous rows, and rows that are too short for a linear model.
        if not fit.ambiguous and fit.length[1] < 0.3:
            nees.append(error @ np.linalg.solve(fit.covariance[:k, :k], error))
        costs.append(fit.cost)
    assert len(nees) >= 18
    low, high = chi2.ppf([0.0005, 0.9995], k * len(nees))
    assert low < sum(nees) < high
    low, high = chi2.ppf([0.0005, 0.9995], fit.degrees_of_freedom * n)
    assert low < sum(costs) < high


def test_stds_of_derived_quantities_agree_with_the_errors():
    """Normalised errors of heading, speed, CPA time and CPA range have a mean square of about 1."""
    squares, n = [], 30
    for seed in range(n):
        rng = np.random.default_rng([seed, 21])
        path, moments = random_path(rng, 1, False)
        # With a CPA far from time zero, errors in the derivatives would be significant.
        point = np.array([12.0, -9.0, 0.0])
        fit = fit_pass(measured(ROAD, path, moments, rng), 1)
        # The target is a dipole.
        fit = replace(fit, robust_covariance=fit.covariance, shape_covariance=np.zeros((3, 3)))
        true = unknowns_at(path, moments, fit.data.stamp_ns / 1e9)
        r, v = true[:3] - point, true[3:6]
        t = -(r @ v) / (v @ v)
        time, time_std, distance, distance_std = fit.closest_approach(point)
        heading = fit.heading[0] - np.arctan2(v[1], v[0])
        squares.append(np.square([
            np.arctan2(np.sin(heading), np.cos(heading)) / fit.heading[1],
            (fit.speed[0] - np.linalg.norm(v)) / fit.speed[1], (time - t) / time_std,
            (distance - np.linalg.norm(r + t * v)) / distance_std]))
    low, high = chi2.ppf([0.0005, 0.9995], n)
    total = np.sum(squares, axis=0)
    assert ((low < total) & (total < high)).all(), total


def test_a_misfit_of_all_orders_does_not_favour_a_higher_order():
    """The costs are normalised by the cost of the highest order."""
    data = measured(ROAD, *random_path(np.random.default_rng(1), 1, True),
                    np.random.default_rng(1))
    n = data.n_values

    def fit(n_dipoles, cost):
        k = 6 + 3 * n_dipoles + (n_dipoles > 1) + 6
        x = np.full(k, 2.0)
        return PassFit(n_dipoles, data, '', True, tuple('u' * k), x, np.eye(k) * 1e-4,
                       np.eye(k) * 1e-4, float(cost), 1.0, 2.0)

    # A cost reduction of 35 justifies four more unknowns if the remaining residual is noise ...
    assert choose_order([fit(1, n + 40.0), fit(2, n + 5.0)]).n_dipoles == 2
    # ... but not if the residual is ten times the noise.
    assert choose_order([fit(1, 10.0 * n + 40.0), fit(2, 10.0 * n + 5.0)]).n_dipoles == 1


def test_correlated_residuals_increase_the_covariance():
    """The Newey-West covariance of a straight-line fit accounts for correlated noise."""
    rng, n, correlation = np.random.default_rng(3), 3000, np.exp(-0.1)
    H = np.column_stack([np.ones(n), np.linspace(-1.0, 1.0, n)])
    P = np.linalg.inv(H.T @ H)
    estimated, errors = np.zeros((2, 2)), []
    for _ in range(300):
        e = lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation], rng.standard_normal(n))
        x = P @ (H.T @ e)
        errors.append(x)
        estimated += P @ score_sum_covariance(H * (e - H @ x)[:, None], 60) @ P / 300.0
    true = np.cov(np.transpose(errors))
    # The covariance for white noise is too small by a factor of about twenty.
    assert (np.diagonal(P) < 0.1 * np.diagonal(true)).all()
    assert (np.diagonal(estimated) > 0.7 * np.diagonal(true)).all()
    assert (np.diagonal(estimated) < 1.2 * np.diagonal(true)).all()


@pytest.mark.parametrize('n_dipoles', ORDERS)
def test_robust_covariance_is_slightly_larger_than_the_nominal_covariance(n_dipoles):
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng([seed, n_dipoles, 9])
        fit = fit_pass(measured(ROAD, *random_path(rng, n_dipoles, True), rng), n_dipoles,
                       errors=SensorErrors(0.0, 0.0))
        excess = fit.robust_covariance - fit.covariance
        scale = np.sqrt(np.diagonal(fit.covariance))
        assert np.linalg.eigvalsh(excess / np.outer(scale, scale)).min() > -1e-6
        ratios.append(np.sqrt(np.diagonal(fit.robust_covariance)) / scale)
    assert 1.0 <= np.median(ratios) < 1.4


def test_hard_and_soft_iron_are_estimated_from_four_headings():
    """Hard and soft iron of a row of three dipoles have errors below three stds; TSP14 VI.E."""
    rng = np.random.default_rng(5)
    hard, soft = np.array([[60.0, 30.0, -40.0], [120.0, -10.0, -70.0], [20.0, 40.0, 30.0]]), 5.0
    moments, headings, covariances = [], [], []
    for heading in np.deg2rad([0.0, 90.0, 180.0, 225.0]):
        c, s = np.cos(heading), np.sin(heading)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        m = hard @ R.T + soft / 3.0 * EARTH / MU0
        path = np.array([-1.5 * s, 1.5 * c, 0.5, 8.0 * c, 8.0 * s, 0.0, 3.0])
        fit = fit_pass(measured(ROAD, path, m, rng), 3)
        assert not fit.reason
        moment, P = fit.moment
        moments.append(moment)
        covariances.append(P)
        headings.append(fit.heading[0])
    iron = hard_and_soft_iron(moments, headings, EARTH / MU0, covariances)
    std = np.sqrt(np.diagonal(iron.covariance))
    assert (np.abs(np.append(iron.hard - hard.sum(axis=0), iron.soft - soft)) < 3.0 * std).all()
    assert std[3] < 0.5 and (std[:3] < 20.0).all()


def test_selected_order_equals_the_order_of_the_simulated_target():
    """Points are not fitted as rows, and rows of three dipoles are not fitted as points."""
    chosen = {1: [], 3: []}
    for n_dipoles, orders in chosen.items():
        for seed in range(8):
            rng = np.random.default_rng([seed, n_dipoles, 3])
            path, moments = random_path(rng, n_dipoles, True)
            path[3:6] *= 8.0 / np.linalg.norm(path[3:6])
            if n_dipoles > 1:
                path[6] = 4.0
            fits = [fit_pass(measured(ROAD, path, moments, np.random.default_rng(seed)), d)
                    for d in (1, 2, 3)]
            criteria = order_criteria(fits)
            assert criteria.min() == 0.0
            orders.append(choose_order(fits).n_dipoles)
    assert chosen[1] == [1] * 8
    assert min(chosen[3]) >= 2 and chosen[3].count(3) >= 5


ONE_SENSOR = network_of([[0.0, -4.5, 0.0]])


def single_sensor_pass(moments, seed=1, path=(0.5, 0.0, 0.6, 9.0, 0.3, 0.0)):
    path, moments = np.array(path), np.atleast_2d(np.array(moments, dtype=float))
    return measured(ONE_SENSOR, path, moments, np.random.default_rng(seed)), path, moments


def test_one_sensor_determines_directions_and_time_but_not_the_scale():
    data, path, moments = single_sensor_pass([100.0, 250.0, -200.0])
    fit = fit_pass(data, 1)
    assert 'scale' in fit.reason
    b = fit.bearing
    r, v = path[:3] - ONE_SENSOR.positions[0], path[3:6]
    t_cpa = -(r @ v) / (v @ v)
    r_cpa = r + t_cpa * v
    zero = fit.data.stamp_ns / 1e9
    assert abs(b.cpa_time + zero - t_cpa) < 3.0 * b.cpa_time_std
    assert abs(b.rate - np.linalg.norm(v) / np.linalg.norm(r_cpa)) < 3.0 * b.rate_std
    for estimate, true, std in zip((b.cpa_direction, b.motion_direction, b.moment_direction),
                                   (r_cpa, v, moments[0]), b.direction_std, strict=True):
        assert np.arccos(estimate @ true / np.linalg.norm(true)) < 3.0 * std < 0.2


def test_a_fit_of_one_sensor_is_ambiguous_in_the_sign_of_the_path():
    """The paths (r, v) and (-r, -v) have the same field; the fit is the path above the sensor."""
    for seed in range(12):
        rng = np.random.default_rng([seed, 5])
        path, moments = random_path(rng, 1, False)
        data = measured(ONE_SENSOR, path, moments, rng)
        r, v = path[:3] - ONE_SENSOR.positions[0], path[3:6]
        distance = np.linalg.norm(np.cross(r, v)) / np.linalg.norm(v)
        if not 1.5 < distance < 8.0:
            continue
        fit = fit_pass(data, 1, (distance, 0.05 * distance))
        if fit.reason:
            continue
        assert fit.ambiguous and fit.rivals[0][0] == 0.0
        both = np.array([fit.velocity, fit.rivals[0][1][3:6]])
        assert np.abs(both @ v / (v @ v) - [[1.0], [-1.0]]).min(axis=0).max() < 0.3
        t, _, _, _ = fit.closest_approach(ONE_SENSOR.positions[0])
        assert (fit.position + t * fit.velocity)[2] >= ONE_SENSOR.positions[0, 2]


def test_one_sensor_with_a_known_range_determines_all_parameters():
    data, path, moments = single_sensor_pass([100.0, 250.0, -200.0])
    r, v = path[:3] - ONE_SENSOR.positions[0], path[3:6]
    distance = np.linalg.norm(np.cross(r, v)) / np.linalg.norm(v)
    fit = fit_pass(data, 1, (distance + 0.1, 0.2))
    assert not fit.reason and fit.bearing is None and fit.ambiguous
    error = fit.x[:9] - unknowns_at(path, moments, fit.data.stamp_ns / 1e9)
    assert (np.abs(error) < 3.0 * np.sqrt(np.diagonal(fit.covariance)[:9])).all()
    # The relative std of the speed equals the relative std of the range.
    assert fit.speed[1] / fit.speed[0] == pytest.approx(0.2 / distance, rel=0.2)


def test_a_moment_perpendicular_to_the_plane_leaves_directions_unknown():
    """The null space has two dimensions (TSP14 section IV.A); unobservable directions are NaN."""
    data, _, _ = single_sensor_pass([0.0, 0.0, 300.0], path=(0.5, 0.0, 0.0, 9.0, 0.0, 0.0))
    b = fit_pass(data, 1).bearing
    assert np.isnan(b.cpa_direction).all() and np.isnan(b.motion_direction).all()
    assert np.isfinite(b.cpa_time) and np.isfinite(b.rate)


def test_a_path_through_the_sensor_is_rejected():
    data, _, _ = single_sensor_pass([0.0, 200.0, -200.0], path=(0.04, -4.5, 0.0, 9.0, 0.0, 0.0))
    assert 'r0 parallel' in fit_pass(data, 1).reason


@pytest.mark.parametrize('time', [-2.0, 0.0, 2.0])
def test_only_a_path_with_a_very_small_cpa_range_passes_through_the_sensor(time):
    v = np.array([9.0, 0.0, 0.0])
    for fraction, passes_through in ((0.9, True), (1.1, False)):
        cpa = np.array([0.0, 0.0, fraction * MIN_CPA_FRACTION * 3.0 * v[0]])
        theta = np.concatenate([cpa - time * v, v])
        scaled = scaled_to_range(theta, np.ones(3), np.zeros(3), 1.0, 3.0)
        assert (scaled is None) == passes_through


def test_data_that_cannot_be_fitted_result_in_a_reason():
    rng = np.random.default_rng(2)
    path, moments = random_path(rng, 3, True)
    data = measured(ROAD, path, moments, rng)

    def reason(changed, n_dipoles=3):
        fit = fit_pass(changed, n_dipoles)
        assert not len(fit.x) or fit.reason
        return fit.reason

    assert 'no sensor' in reason(replace(data, field=np.full_like(data.field, np.nan)))
    few = np.r_[198:201, 598:601]
    assert '(18) for 22' in reason(replace(
        data, t=data.t[few], sensor=data.sensor[few], field=data.field[few]))
    noise = NOISE * rng.standard_normal(data.field.shape)
    assert 'noise' in reason(replace(data, field=noise))
    far = path.copy()
    far[1] += 45.0
    assert 'range' in reason(measured(ROAD, far, moments, rng), 1)


def test_two_vehicles_in_one_window_are_rejected():
    for seed, heading in ((1, 0.0), (2, np.pi)):
        rng = np.random.default_rng(seed)
        first_path, m1 = random_path(rng, 3, True)
        second_path, m2 = random_path(rng, 3, True)
        first_path[:7] = 0.0, -1.75, 0.5, 9.0, 0.0, 0.0, 3.0
        second_path[:7] = 6.0, 1.75, 0.5, 11.0 * np.cos(heading), 0.0, 0.0, 3.0
        both = superposed(measured(ROAD, first_path, m1, rng),
                          measured(ROAD, second_path, m2, rng, noise=1e-15))
        assert choose_order([fit_pass(both, d) for d in (1, 2, 3)]) is None


def test_missing_axes_and_sensors_only_reduce_the_accuracy():
    rng = np.random.default_rng(8)
    path, moments = random_path(rng, 1, True)
    data = measured(ROAD, path, moments, rng)
    field = data.field.copy()
    field[data.sensor == 1, 2] = np.nan
    field[100:140] = np.nan
    partial, complete = fit_pass(replace(data, field=field), 1), fit_pass(data, 1)
    assert not partial.reason and partial.data.n_values == 2 * 400 * 3 - 400 - 120
    assert len(partial.x) == 6 + 3 + 5 and len(complete.x) == 6 + 3 + 6
    error = partial.x[:9] - unknowns_at(path, moments, partial.data.stamp_ns / 1e9)
    assert error @ np.linalg.solve(partial.covariance[:9, :9], error) < chi2.ppf(0.999, 9)
    assert (np.diagonal(partial.covariance)[:9] > np.diagonal(complete.covariance)[:9]).all()


@pytest.fixture(scope='session')
def recorded_passes(road_network):
    """Fit the bundled vehicle recordings: {name: FittedPass}."""
    out = {}
    for name in VEHICLES:
        found = fit(vehicle_path(name), road_network)
        assert len(found.passes) == 1 and not found.report.warnings(), name
        out[name] = found.passes[0]
    return out


STRAIGHT = {'straight_car_right': 8.3, 'straight_small_left': 11.1, 'straight_car_fast_left': 20.0,
            'straight_truck_right': 6.0}


@pytest.mark.parametrize('name', STRAIGHT)
def test_order_three_describes_vehicles(recorded_passes, name):
    """The normalised cost is below 2, or 8 for trucks, and the speed error is below 8 %."""
    fit = next(f for f in recorded_passes[name].fits if f.n_dipoles == 3)
    assert not fit.reason
    assert fit.normalised_cost < (8.0 if 'truck' in name else 2.0)
    assert fit.speed[0] == pytest.approx(STRAIGHT[name], rel=0.08)
    # A row of three dipoles is a poor model of a truck, so the robust stds are several times the
    # nominal stds.
    std_ratio = np.sqrt(np.diagonal(fit.robust_covariance) / np.diagonal(fit.covariance))[:6]
    assert np.median(std_ratio) > (5.0 if 'truck' in name else 1.0)
    # The selected order may differ from three.
    assert recorded_passes[name].chosen.speed[0] == pytest.approx(STRAIGHT[name], rel=0.1)


@pytest.mark.parametrize('name', [n for n in VEHICLES if 'turns' in n])
def test_a_turn_is_rejected_as_not_at_constant_velocity(recorded_passes, name):
    assert recorded_passes[name].chosen is None
    assert any('constant velocity' in f.reason for f in recorded_passes[name].fits)
