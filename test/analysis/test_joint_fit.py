"""Joint fit of several targets: estimates, covariances, and rejected fits."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.analysis.fitted_pass import choose_order, order_criteria
from mag_tracking.analysis.joint_fit import (
    GroundPrior,
    are_separate,
    fit_joint,
    fit_targets,
    path_from,
)
from mag_tracking.analysis.pass_description import SensorErrors, assignment, fits_at_minimum
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.pass_trust import FittedRow, residual_elsewhere
from mag_tracking.inference.least_squares import Minimum
from mag_tracking.physics.passes import RowPass, SuperposedPasses
from support.passes import ROAD, measured, network_of, random_moments, superposed

GROUND, ORDERS = GroundPrior((0.7, 0.4), 0.1), (1, 2)
FOUR_SENSORS = network_of([[-3.0, -4.5, 0.0], [-3.0, 4.5, 0.0], [3.0, -4.5, 0.0], [3.0, 4.5, 0.0]])


def random_lane_path(rng, time_s, direction, n_dipoles):
    """Create random (path, moments) of a vehicle that passes the origin in its lane at `time_s`."""
    speed = direction * rng.uniform(8.0, 20.0)
    position = [-speed * time_s, -direction * rng.uniform(1.4, 2.2), rng.uniform(0.4, 1.0)]
    moments = random_moments(rng, n_dipoles)
    length = [rng.uniform(2.0, 3.5)] if n_dipoles > 1 else []
    return np.concatenate([position, [speed, 0.1 * rng.standard_normal(), 0.0], length]), moments


def simulated_pass(rng, plan, n_dipoles, network=ROAD):
    """Simulate vehicles; `plan` lists (time at the origin [s], direction). Return (data, paths)."""
    targets = [random_lane_path(rng, *passing, n_dipoles) for passing in plan]
    fields = [measured(network, path, moments, rng, seconds=6.0, noise=1.2e-8 if k == 0 else 1e-15)
              for k, (path, moments) in enumerate(targets)]
    data = fields[0]
    for other in fields[1:]:
        data = superposed(data, other)
    return data, [path for path, _ in targets]


def tracked_paths(rng, paths):
    """Add typical errors of a tracker to paths (K, 6): 0.5 m and 5 % of the speed."""
    tracks = np.array([path[:6] for path in paths])
    tracks[:, :2] += 0.5 * rng.standard_normal((len(paths), 2))
    tracks[:, 3] *= 1.0 + 0.05 * rng.standard_normal(len(paths))
    return tracks


MEETING, FOLLOWING = ((-0.3, 1), (0.2, -1)), ((-0.8, 1), (0.8, 1))


@pytest.mark.parametrize(('plan', 'n_dipoles'), [(MEETING, 1), (MEETING, 2), (FOLLOWING, 2)])
def test_two_vehicles_are_fitted_with_consistent_covariances(plan, n_dipoles):
    z = []
    for seed in range(6):
        rng = np.random.default_rng([seed, n_dipoles])
        data, paths = simulated_pass(rng, plan, n_dipoles)
        joint_fits = fit_joint(data, tracked_paths(rng, paths), GROUND, (n_dipoles,))
        assert len(joint_fits) == 2
        for (fit,), path in zip(joint_fits, paths, strict=True):
            assert fit.converged and fit.n_other_unknowns == 6 + (n_dipoles > 1) + 3 * n_dipoles
            assert not fit.reason and abs(fit.normalised_cost - 1.0) < 0.15
            true = path[:6].copy()
            true[:3] += fit.data.stamp_ns / 1e9 * path[3:6]
            e = fit.x[:6] - true
            z.append(e @ np.linalg.solve(fit.covariance[:6, :6], e))
    # Each vehicle has six path parameters. The prior of height and climb only reduces the errors.
    assert chi2.cdf(np.sum(z), 6 * len(z)) < 0.999, np.round(z, 1)
    assert chi2.cdf(np.sum(z), 4 * len(z)) > 0.001, np.round(z, 1)


def test_three_vehicles_are_fitted():
    rng = np.random.default_rng(5)
    data, paths = simulated_pass(rng, ((-1.2, 1), (0.1, -1), (1.1, 1)), 1, FOUR_SENSORS)
    joint_fits = fit_joint(data, tracked_paths(rng, paths), GROUND, (1, 2))
    assert [choose_order(fits).n_dipoles for fits in joint_fits] == [1, 1, 1]
    for fits, path in zip(joint_fits, paths, strict=True):
        fit = choose_order(fits)
        assert abs(fit.velocity[0] - path[3]) < 4.0 * fit.speed[1] < 1.0
        assert fit.data.stamp_ns / 1e9 == pytest.approx(-path[0] / path[3], abs=0.5)


def test_data_of_each_fit_exclude_the_fields_of_the_others():
    """The data of a fit contain only the field of its vehicle and the noise."""
    rng = np.random.default_rng(6)
    data, paths = simulated_pass(rng, MEETING, 1)
    (first,), (second,) = fit_joint(data, tracked_paths(rng, paths), GROUND, (1,))
    assert first.cost == second.cost and first.n_unknowns == second.n_unknowns
    np.testing.assert_allclose(first.data.field - first.predicted,
                               second.data.field - second.predicted, atol=1e-15)
    assert np.std(first.data.field - first.predicted) == pytest.approx(1.2e-8, rel=0.05)
    alone = fit_pass(first.data, 1)
    assert abs(alone.speed[0] - first.speed[0]) < 2.0 * first.speed[1]


def test_order_of_each_vehicle_is_chosen_separately():
    rng = np.random.default_rng(9)
    point, m = random_lane_path(rng, -0.3, 1, 1)
    row, moments = random_lane_path(rng, 0.3, -1, 3)
    data = superposed(measured(ROAD, point, m, rng, seconds=6.0),
                      measured(ROAD, row, moments, rng, seconds=6.0, noise=1e-15))
    joint_fits = fit_joint(data, tracked_paths(rng, (point, row)), GROUND, (1, 2, 3))
    orders = [choose_order(fits).n_dipoles for fits in joint_fits]
    assert orders[0] == 1 and orders[1] >= 2
    # The fits of all orders describe the same vehicle and have the same time zero.
    for fits, path in zip(joint_fits, (point, row), strict=True):
        assert [fit.n_dipoles for fit in fits] == [1, 2, 3]
        assert len({(fit.data.stamp_ns, fit.data.t[0]) for fit in fits}) == 1
        assert all(fit.velocity[0] * path[3] > 0.0 for fit in fits if fit.converged)


def test_two_following_vehicles_are_not_fitted_as_one_long_row():
    """Without tracks, one row is fitted, whose length is the distance between the vehicles."""
    rng = np.random.default_rng(3)
    first_path, moments = random_lane_path(rng, -0.5, 1, 2)
    second_path = first_path.copy()
    second_path[0] -= 18.0
    data = superposed(measured(ROAD, first_path, moments, rng, seconds=6.0),
                      measured(ROAD, second_path, 0.8 * moments, rng, seconds=6.0, noise=1e-15))
    alone = [fit_pass(data, n) for n in (1, 2)]
    wrong = choose_order(alone)
    assert wrong is not None and wrong.length[0] > 12.0
    paths = tracked_paths(rng, (first_path, second_path))
    assert fit_targets(data, alone, paths[:1], GROUND, ORDERS) == (tuple(alone),)
    chosen = [choose_order(fits) for fits in fit_targets(data, alone, paths, GROUND, ORDERS)]
    assert len(chosen) == 2
    for fit in chosen:
        assert abs(fit.velocity[0] - first_path[3]) < 4.0 * fit.speed[1] < 2.0 \
            and fit.length[0] < 5.0


def test_two_tracks_of_one_vehicle_are_fitted_as_one():
    rng = np.random.default_rng(4)
    row, moments = random_lane_path(rng, 0.0, 1, 3)
    row[6] = 7.0
    data = measured(ROAD, row, moments, rng, seconds=6.0)
    alone = [fit_pass(data, n) for n in (2, 3)]
    parts = np.array([row[:6], row[:6]])
    parts[:, 0] += [1.7, -1.7]
    assert fit_targets(data, alone, parts, GROUND, ORDERS) == (tuple(alone),)
    assert abs(choose_order(alone).velocity[0] - row[3]) < 0.5


def test_fits_of_overlapping_vehicles_are_rejected():
    rng = np.random.default_rng(1)
    slow, slow_moments = random_lane_path(rng, 0.0, 1, 1)
    fast, fast_moments = random_lane_path(rng, 0.3, 1, 1)
    fast[1], fast[3] = slow[1], 2.0 * slow[3]
    data = superposed(measured(ROAD, slow, slow_moments, rng, seconds=6.0),
                      measured(ROAD, fast, fast_moments, rng, seconds=6.0, noise=1e-15))
    alone = [fit_pass(data, n) for n in (1, 2)]
    fits, = fit_targets(data, alone, np.array([slow, fast]), GROUND, ORDERS)
    assert all('overlap' in fit.reason for fit in fits) and choose_order(alone) is not None


def test_a_rejected_joint_fit_has_a_reason():
    rng = np.random.default_rng(7)
    data, paths = simulated_pass(rng, MEETING, 1)
    alone, two = [fit_pass(data, 1)], tracked_paths(rng, paths)
    four = np.vstack([two, two + [0.0, 20.0, 0.0, 0.0, 0.0, 0.0]])
    cases = [('4 targets were tracked, but at most 3', data, four),
             ('too few measurements', replace(
                 data, t=data.t[::200], sensor=data.sensor[::200], field=data.field[::200],
                 covariance=data.covariance[::200]), two),
             # A third vehicle is not tracked.
             ('of the field unexplained', superposed(data, measured(
                 ROAD, *random_lane_path(rng, 1.5, 1, 1), rng, seconds=6.0, noise=1e-15)), two)]
    for reason, pass_data, tracks in cases:
        fits, = fit_targets(pass_data, alone, tracks, GROUND, (1,))
        assert reason in fits[0].reason and fits[0].trusted == (), fits[0].reason
        assert choose_order(fits) is None
    # With one sensor, the scale is not observable, even for a single vehicle.
    one = measured(network_of([[0.0, -4.5, 0.0]]), paths[0], np.ones((1, 3)), rng)
    assert fit_targets(one, alone, two, GROUND, (1,)) == (tuple(alone),)


def test_vehicles_side_by_side_or_following_are_separate():
    data, _ = simulated_pass(np.random.default_rng(8), MEETING, 1)
    path = np.array([0.0, -1.75, 0.5, 10.0, 0.0, 0.0, 3.0])

    def shifted_path(*by):
        return path + np.pad(by, (0, 7 - len(by)))

    assert are_separate(data, (path, shifted_path(0.0, 3.5)))
    assert are_separate(data, (path, shifted_path(-7.0)))
    assert not are_separate(data, (path, shifted_path(-5.0)))
    # In the first case, a vehicle catches up within range of the sensors; in the second case,
    # outside this range.
    assert not are_separate(data, (path, shifted_path(-9.0, 0.0, 0.0, 6.0)))
    assert are_separate(data, (path, shifted_path(-60.0, 0.0, 0.0, 2.0)))
    assert are_separate(data, (path,))


def test_path_from_refers_to_the_time_zero_of_the_data():
    rng = np.random.default_rng(2)
    data, paths = simulated_pass(rng, MEETING, 2)
    data = replace(data, stamp_ns=1_700_000_000_000_000_000)
    joint_fits = fit_joint(data, tracked_paths(rng, paths), GROUND, (2,))
    for (fit,), path in zip(joint_fits, paths, strict=True):
        np.testing.assert_allclose(path_from(data, fit)[:2], path[:2], atol=1.0)
    assert np.isfinite(order_criteria([fits[0] for fits in joint_fits])).all()


def test_a_false_track_is_not_fitted_as_a_vehicle():
    rng = np.random.default_rng(12)
    row, moments = random_lane_path(rng, 0.0, 1, 2)
    data = measured(ROAD, row, moments, rng, seconds=6.0)
    alone = [fit_pass(data, n) for n in ORDERS]
    ghost_track = row[:6] * [-1.0, -1.0, 1.0, -1.0, 1.0, 1.0]
    assert fit_targets(data, alone, np.array([row[:6], ghost_track]), GROUND,
                       ORDERS) == (tuple(alone),)


def test_a_velocity_change_of_one_target_rejects_all_fits():
    """The second vehicle suddenly changes from half to twice its nominal speed."""
    rng = np.random.default_rng(11)
    (first, first_moments), (second, second_moments) = (
        random_lane_path(rng, -0.3, 1, 1), random_lane_path(rng, 0.2, -1, 1))
    data = measured(ROAD, first, first_moments, rng, seconds=6.0)
    warped_times = np.where(data.t < 0.2, 0.1 + 0.5 * data.t, 2.0 * data.t - 0.2)
    model = RowPass(warped_times, data.positions, ROAD.R_sw[data.sensor], 1)
    field = (model.basis(second[None])[0] @ second_moments[0]).reshape(-1, 3)
    data = replace(data, field=data.field + field)
    paths = np.array([first, second])
    changes = [fits[0].velocity_change for fits in fit_joint(data, paths, GROUND, (1,))]
    assert changes[1] > 2.0 * changes[0]
    joint_fits = fit_targets(data, [fit_pass(data, 1)], paths, GROUND, (1,))
    assert all(choose_order(fits) is None for fits in joint_fits)


def test_fits_are_in_the_order_of_the_passes():
    rng = np.random.default_rng(13)
    data, paths = simulated_pass(rng, FOLLOWING, 1)
    for order in ([0, 1], [1, 0]):
        joint_fits = fit_joint(data, tracked_paths(rng, paths)[order], GROUND, (1,))
        assert joint_fits[0][0].data.stamp_ns < joint_fits[1][0].data.stamp_ns


def test_a_fit_that_differs_from_its_track_has_a_reason():
    rng = np.random.default_rng(14)
    data, paths = simulated_pass(rng, MEETING, 1)
    wrong_tracks = tracked_paths(rng, paths)
    # The track is three times as fast as the vehicle.
    wrong_tracks[1, 3] *= 3.0
    joint_fits = fit_joint(data, wrong_tracks, GROUND, (1,))
    fine, wrong = sorted(fit.reason for fit, in joint_fits)
    assert fine == '' and 'velocity' in wrong
    assert fit_joint(data, wrong_tracks, GROUND, (1,), stopped=lambda: True) == ()


def fits_with_minima(*others):
    """Create fits of two points; each of `others` maps theta (12,) to another minimum of the cost.

    Return (data, true theta, fits, (linear parameters, minimum)).
    """
    rng = np.random.default_rng(15)
    data, paths = simulated_pass(rng, MEETING, 1)
    theta = np.concatenate(paths)
    model = SuperposedPasses.from_orders((1, 1), data.t, data.positions, ROAD.R_sw[data.sensor])
    A = model.basis(theta[None])[0]
    p = np.linalg.lstsq(A, data.field.ravel(), rcond=None)[0]
    minimum = Minimum(theta, float(data.n_values), True,
                      tuple((x(theta), 1.01 * data.n_values) for x in others))
    return data, theta, fits_at_minimum(data, (1, 1), minimum, p, 1.0, SensorErrors()), (p, minimum)


def test_exchanged_targets_are_not_rivals():
    def exchanged(theta):
        return np.concatenate([theta[6:], theta[:6]])

    def second_elsewhere(theta):
        return exchanged(theta + np.eye(12)[7] * 3.0)

    _, theta, (first, second), _ = fits_with_minima(exchanged, second_elsewhere)
    assert first.rivals == () and len(second.rivals) == 1
    np.testing.assert_allclose(second.rivals[0][1], theta[6:] + [0.0, 3.0, 0.0, 0.0, 0.0, 0.0])
    assert assignment([theta[:6], theta[6:]], [theta[6:], theta[:6]]) == (1, 0)
    # A shift of time zero also propagates the rival along its path.
    shifted = second.shifted(2.0)
    np.testing.assert_allclose(shifted.rivals[0][1][:3],
                               second.rivals[0][1][:3] + 2.0 * theta[9:12])
    np.testing.assert_allclose(shifted.position, second.position + 2.0 * second.velocity)
    assert shifted.data.stamp_ns == second.data.stamp_ns + 2_000_000_000


def test_a_prior_adds_information():
    data, _, (_, second), (p, minimum) = fits_with_minima()
    std = np.full(12, np.inf)
    std[8] = 0.05
    _, known = fits_at_minimum(data, (1, 1), minimum, p, 1.0, SensorErrors(), path_std=std)
    # Sherman-Morrison update for one additional measurement of one parameter.
    P = second.covariance
    gain = P[:, 2] / (P[2, 2] + 0.05**2)
    np.testing.assert_allclose(known.covariance, P - np.outer(gain, P[2]), rtol=1e-5,
                               atol=1e-9 * np.abs(P).max())


def test_residuals_near_any_target_are_not_elsewhere():
    rng = np.random.default_rng(16)
    data, paths = simulated_pass(rng, FOLLOWING, 1)
    rows = [FittedRow(1, path, (RowPass(data.t, data.positions, ROAD.R_sw[data.sensor], 1).basis(
        path[None])[0] @ [200.0, 100.0, -300.0]).reshape(-1, 3)) for path in paths]
    for row in rows:
        residual = np.einsum('nij,nj->ni', data.whitening, 0.2 * row.field)
        assert residual_elsewhere(data, rows, residual) < 1e-3


def test_targets_of_a_poor_joint_fit_are_ambiguous():
    *_, (first, _), _ = fits_with_minima()
    assert not first.ambiguous and first.n_other_unknowns == 9
    poor = replace(first, cost=2.1 * first.degrees_of_freedom)
    assert poor.ambiguous and not replace(poor, n_other_unknowns=0).ambiguous
