"""Pose of a magnet from one reading, and joint estimation of poses and network geometry."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mag_tracking.calibration.magnet_pose import locate_magnet
from mag_tracking.calibration.network_fit import TrackedMagnet, tool_rotations
from mag_tracking.calibration.network_geometry import calibrate_geometry_blind
from mag_tracking.physics.dipole import dipole_field
from support.magnet_boards import HIGH, LOW, MOMENT, SETTINGS, board, estimated, simulated

FIELD_ERROR, AMBIENT_STD = 0.01, 1e-7


def test_single_poses_have_consistent_covariances():
    """Each random pose above the board has one reading per sensor, with a random field error."""
    network = board(4, 0.05)
    rng = np.random.default_rng(5)
    nees, costs = [], []
    for _ in range(300):
        r = rng.uniform([-0.03, -0.03, 0.05], [0.18, 0.18, 0.16])
        u = rng.standard_normal(3)
        u /= np.linalg.norm(u)
        A = AMBIENT_STD * rng.standard_normal(3)
        B = np.einsum('nij,nj->ni', network.R_sw,
                      dipole_field(network.positions - r, MOMENT * u) + A)
        size = np.linalg.norm(B, axis=1)[:, None]
        B += np.hypot(1e-7, FIELD_ERROR * size) * rng.standard_normal(B.shape)
        B[rng.integers(16)] = np.nan
        pose = locate_magnet(network, B, MOMENT, LOW, HIGH, FIELD_ERROR, AMBIENT_STD)
        assert pose.converged, pose.reason
        assert np.linalg.norm(pose.axis) == pytest.approx(1.0)
        assert np.abs(pose.covariance[3:] @ np.append(np.zeros(3), pose.axis)).max() < 1e-9 * (
            pose.covariance[3:, 3:].max())
        # The covariance is of first order, so only the axis error perpendicular to the axis counts.
        e = np.append(pose.position - r, pose.axis * (pose.axis @ u) - u)
        C = pose.covariance / max(1.0, pose.normalised_cost)
        scale = np.sqrt(np.diagonal(C))
        C, e = C / np.outer(scale, scale), e / scale
        nees.append(e @ np.linalg.pinv(C, rcond=1e-9, hermitian=True) @ e)
        costs.append(pose.normalised_cost)
    low, high = chi2.ppf([0.005, 0.995], 5 * 300) / 300
    print(f'NEES {np.mean(nees):.2f} in {low:.2f} .. {high:.2f}, cost {np.mean(costs):.3f}')
    assert low <= np.mean(nees) <= high
    assert np.mean(costs) == pytest.approx(1.0, abs=0.06)


def test_a_rejected_pose_has_a_reason():
    network = board()
    u = np.array([0.6, 0.0, 0.8])

    def reading(r, m):
        return np.einsum('nij,nj->ni', network.R_sw,
                         dipole_field(network.positions - np.array(r), m * u))

    few_readings = np.full((9, 3), np.nan)
    few_readings[:2, :2] = 1e-6
    pose = locate_magnet(network, few_readings, MOMENT, LOW, HIGH, FIELD_ERROR, AMBIENT_STD)
    assert not pose.converged and 'axes is 4' in pose.reason
    assert np.isnan(pose.position).all()
    pose = locate_magnet(network, reading([0.06, 0.05, 0.3], MOMENT), MOMENT, LOW, HIGH,
                         FIELD_ERROR, AMBIENT_STD)
    assert not pose.converged and 'box' in pose.reason
    np.testing.assert_allclose(pose.position, [0.06, 0.05, 0.3], atol=1e-5)
    pose = locate_magnet(network, reading([0.06, 0.05, 0.08], 4.0 * MOMENT), MOMENT, LOW, HIGH,
                         FIELD_ERROR, AMBIENT_STD)
    assert not pose.converged and 'normalised cost' in pose.reason
    valid = reading([0.06, 0.05, 0.08], MOMENT)
    for change, message in (
            ({'moment': -1.0}, 'moment is -1.0'),
            ({'high': LOW}, 'has no volume'), ({'field': valid * np.inf}, 'infinite'),
            ({'network': replace(network, noise_std=(None,) * 9)}, 'noise_std is None')):
        with pytest.raises(ValueError, match=message):
            locate_magnet(**{'network': network, 'field': valid, 'moment': MOMENT, 'low': LOW,
                             'high': HIGH, 'field_error': FIELD_ERROR, 'ambient_std': AMBIENT_STD,
                             **change})


# Calibration without a tracker.

def test_unknown_poses_and_geometry_are_estimated_jointly():
    nees = []
    for seed in (21, 22, 23):
        network, field, positions, axes, x = simulated(seed, settings=replace(
            SETTINGS, moment_std=0.0))
        magnet = TrackedMagnet(positions, tool_rotations(axes), positions.mean(axis=0), MOMENT)
        r, *_ = magnet.poses(x[1], x[2])
        field[5] = np.nan
        g = calibrate_geometry_blind(network, field, MOMENT, LOW, HIGH,
                                     replace(SETTINGS, moment_std=0.0))
        assert g.converged and len(g.rows) >= 36 and 5 not in g.rows
        assert np.median(np.linalg.norm(g.poses[0] - r[g.rows], axis=1)) < 2e-3
        assert not g.shared.any()
        e = (estimated(g, network)[:90] - x[0].ravel())
        unit = np.sqrt(np.diagonal(g.covariance)[:90])
        z = e / unit
        nees.append(z @ np.linalg.solve(g.covariance[:90, :90] / np.outer(unit, unit), z))
    low, high = chi2.ppf([0.005, 0.995], 90 * 3) / 3
    print(f'NEES {np.mean(nees):.1f} in {low:.1f} .. {high:.1f}')
    assert low <= np.mean(nees) <= high


def test_readings_without_a_magnet_are_rejected():
    network = board()
    field = 3e-5 + 1e-7 * np.random.default_rng(0).standard_normal((10, 9, 3))
    with pytest.raises(ValueError, match='0 of 10'):
        calibrate_geometry_blind(network, field, MOMENT, LOW, HIGH, SETTINGS)
