"""Geometry calibration from poses of a magnet: errors and covariances on simulated boards."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.calibration.network_fit import (
    GeometrySettings,
    TrackedMagnet,
    rotation,
    tool_rotations,
)
from mag_tracking.calibration.network_geometry import calibrate_geometry
from support.magnet_boards import (
    MOMENT,
    SETTINGS,
    board,
    calibrated_boards,
    estimated,
    magnet_poses,
    simulated,
)


@pytest.fixture(scope='module')
def boards():
    """Simulate and calibrate several boards; return a list of (simulated data, geometry)."""
    return calibrated_boards()


def test_covariance_agrees_with_the_errors(boards):
    nees, outside, costs = [], [], []
    for (network, *_, x), g in boards:
        assert g.converged and not g.reason
        assert g.suspect_sensors == () and g.suspect_poses == ()
        e = estimated(g, network) - np.append(x[0].ravel(), x[1])
        unit = np.sqrt(np.diagonal(g.covariance))
        z = e / unit
        nees.append(z @ np.linalg.solve(g.covariance / np.outer(unit, unit), z))
        outside.append(np.abs(z) > 2.0)
        costs.append(g.normalised_cost)
    low, high = chi2.ppf([0.005, 0.995], 102 * len(boards)) / len(boards)
    print(f'NEES {np.mean(nees):.1f} in {low:.1f} .. {high:.1f}, cost {np.mean(costs):.3f}, '
          f'outside 2 std {np.mean(outside):.3f}')
    assert low <= np.mean(nees) <= high
    # The gauge freedom correlates the errors, so the tolerance is wider than for a binomial
    # distribution.
    assert np.mean(outside) == pytest.approx(0.0455, abs=0.02)
    assert np.mean(costs) == pytest.approx(1.0, abs=0.03)


def test_calibration_reduces_the_prior_errors(boards):
    """Errors are relative to the mean of all sensors, because a common error is a gauge freedom."""
    for part, max_ratio in ((slice(3, 4), 0.35), (slice(4, 7), 0.35), (slice(7, 10), 0.6)):
        error, prior_errors, std = [], [], []
        for (network, *_, x), g in boards:
            e = (estimated(g, network)[:90] - x[0].ravel()).reshape(9, 10)[:, part]
            if part.start == 4:
                e, prior_error = (np.einsum('nij,nj->ni', network.R_ws, v)
                                  for v in (e, x[0][:, part]))
            else:
                prior_error = x[0][:, part]
            error.append(e - e.mean(axis=0))
            prior_errors.append(prior_error - prior_error.mean(axis=0))
            std.append(np.sqrt(np.diagonal(g.covariance)[:90]).reshape(9, 10)[:, part])
        rms, prior_rms = (np.sqrt(np.mean(np.square(v))) for v in (error, prior_errors))
        print(f'remaining error of {part}: {rms / prior_rms:.2f}')
        assert rms < max_ratio * prior_rms
        # The errors are consistent with the estimated stds.
        assert rms < 1.1 * np.sqrt(np.mean(np.square(std)))


def test_estimated_poses_are_closer_to_the_truth_than_tracked_ones(boards):
    estimated_error, tracked_error, z2 = [], [], []
    for (_, _, positions, axes, x), g in boards:
        magnet = TrackedMagnet(positions, tool_rotations(axes), positions.mean(axis=0), MOMENT)
        r, u = magnet_poses(g, positions, axes)
        as_tracked, m, *_ = magnet.poses(x[1], np.zeros((40, 8)))
        assert np.linalg.norm(r - as_tracked, axis=1).max() < 2.5e-3
        assert (np.einsum('ki,ki->k', u, m) / np.linalg.norm(m, axis=1)).min() > np.cos(0.025)
        true_r, *_ = magnet.poses(x[1], x[2])
        # An error common to all poses is a gauge freedom; only the tracker error is compared.
        for estimate, out in ((g.poses[0], estimated_error), (r, tracked_error)):
            e = estimate - true_r
            out.append(np.square(e - e.mean(axis=0)).mean())
        z2.append(np.mean(np.square(g.pose - x[2]) / np.einsum('kii->ki', g.pose_covariance)))
    print('remaining error of the tracker: '
          f'{np.sqrt(np.mean(estimated_error) / np.mean(tracked_error)):.2f}')
    assert np.mean(estimated_error) < 0.8 * np.mean(tracked_error)
    assert np.mean(z2) == pytest.approx(1.0, abs=0.1)


def test_order_of_the_poses_has_no_effect(boards):
    (network, field, positions, axes, _), g = boards[0]
    order = np.random.default_rng(0).permutation(len(field))
    h = calibrate_geometry(network, field[order], positions[order], axes[order], MOMENT, SETTINGS)
    std = np.sqrt(np.diagonal(g.covariance))
    assert (np.abs(estimated(g, network) - estimated(h, network)) < 1e-5 * std).all()
    np.testing.assert_allclose(h.pose_residual, g.pose_residual[order], rtol=1e-4)


def test_a_rotation_of_the_world_about_z_changes_only_positions(boards):
    (network, field, positions, axes, _), g = boards[1]
    R, d = rotation(np.array([0.0, 0.0, 2.0])), np.array([3.0, -2.0, 1.0])
    rotated = replace(network, positions=network.positions @ R.T + d, R_ws=R @ network.R_ws)
    h = calibrate_geometry(rotated, field, positions @ R.T + d, axes @ R.T, MOMENT, SETTINGS)
    assert (np.abs(h.gain - g.gain) < 1e-4 * g.gain_std).all()
    assert (np.abs(h.bias - g.bias) < 1e-4 * g.bias_std).all()
    assert np.abs(h.network.positions - (g.network.positions @ R.T + d)).max() < 1e-8
    assert h.normalised_cost == pytest.approx(g.normalised_cost, rel=1e-6)


def test_parameters_known_exactly_do_not_change():
    exact = GeometrySettings(
        gain_std=0.0, rotation_std_deg=0.0, position_std=0.0, tracker_position_std=0.0,
        tracker_tilt_std_deg=0.0, ambient_std=0.0)
    network, field, positions, axes, x = simulated(3, settings=exact)
    g = calibrate_geometry(network, field, positions, axes, MOMENT, exact)
    assert g.converged
    np.testing.assert_array_equal(g.network.positions, network.positions)
    np.testing.assert_array_equal(g.gain, 1.0)
    assert not g.position_std.any() and not g.gain_std.any() and not g.rotation_std.any()
    assert g.moment == (MOMENT, 0.0)
    assert not g.pose.any()
    z = (g.bias - x[0][:, :3]) / g.bias_std
    assert chi2.ppf(0.001, 27) < (z**2).sum() < chi2.ppf(0.999, 27)


def test_a_worse_fit_has_larger_stds():
    """The simulated noise is five times the configured noise."""
    noisy_network = board(noise=5e-7)
    network, field, positions, axes, x = simulated(
        4, network=noisy_network, settings=replace(SETTINGS, field_error=0.05))
    nominal_network = board()
    g = calibrate_geometry(nominal_network, field, positions, axes, MOMENT, SETTINGS)
    assert g.converged and 15.0 < g.normalised_cost < 30.0
    e = estimated(g, network) - np.append(x[0].ravel(), x[1])
    assert np.mean(np.square(e / np.sqrt(np.diagonal(g.covariance)))) < 1.6
    nominal = calibrate_geometry(nominal_network, simulated(4)[1], positions, axes, MOMENT,
                                 SETTINGS)
    assert (g.bias_std > 3.0 * nominal.bias_std).all()
    assert (g.position_std <= (1.0 + 1e-9) * SETTINGS.position_std).all()
