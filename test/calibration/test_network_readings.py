"""Predicted readings of a board near a magnet; derivatives with respect to all unknowns."""

import numpy as np

from mag_tracking.calibration.network_fit import (
    TrackedMagnet,
    predicted_readings,
    rotation,
    tool_rotations,
)
from mag_tracking.physics.dipole import dipole_field
from support.magnet_boards import MOMENT, board, tracked


def test_derivatives_agree_with_differences():
    rng = np.random.default_rng(1)
    network = board()
    positions, axes = tracked(5, rng)
    magnet = TrackedMagnet(positions, tool_rotations(axes), np.array([0.05, 0.04, 0.1]), MOMENT)
    x = [rng.standard_normal((9, 10)) * np.repeat([1e-5, 0.1, 0.3, 5e-3], [3, 1, 3, 3]),
         rng.standard_normal(12) * np.repeat([5e-3, 0.3, 8e-3, 0.2], [3, 3, 3, 3]),
         rng.standard_normal((5, 8)) * np.repeat([5e-3, 0.2, 1e-6], [3, 2, 3])]
    exact = predicted_readings(network, magnet, *x)[2:]
    size = np.abs(exact[1]).max()
    for block, J in enumerate(exact):
        for c in range(J.shape[-1]):
            step = 1e-5
            f = []
            for sign in (1.0, -1.0):
                shifted = [v.copy() for v in x]
                shifted[block][..., c] += sign * step
                f.append(predicted_readings(network, magnet, *shifted)[0])
            numeric = (f[0] - f[1]) / (2.0 * step)
            scale = max(np.abs(J[..., c]).max(), 1e-6 * size)
            assert np.abs(numeric - J[..., c]).max() < 1e-5 * scale, (block, c)


def test_a_network_without_errors_measures_the_dipole_field():
    network = board()
    positions, axes = tracked(4, np.random.default_rng(2))
    magnet = TrackedMagnet(positions, tool_rotations(axes), np.zeros(3), MOMENT)
    f, signal, *_ = predicted_readings(network, magnet, np.zeros((9, 10)), np.zeros(12),
                                       np.zeros((4, 8)))
    for j in range(9):
        for k in range(4):
            expected = network.R_ws[j].T @ dipole_field(network.positions[j] - positions[k],
                                                        MOMENT * axes[k])
            np.testing.assert_allclose(f[j, k], expected, rtol=1e-9)
    np.testing.assert_array_equal(f, signal)


def test_each_unknown_has_its_documented_effect():
    network = board()
    positions, axes = tracked(4, np.random.default_rng(2))
    magnet = TrackedMagnet(positions, tool_rotations(axes), positions.mean(axis=0), MOMENT)
    shared, pose = np.zeros(12), np.zeros((4, 8))
    shared[:3], shared[6:9] = [1e-3, 2e-3, 3e-3], [0.0, 0.0, -8e-3]
    r, m, *_ = magnet.poses(shared, pose)
    np.testing.assert_allclose(r, positions + shared[:3] - 8e-3 * axes, rtol=1e-12)
    np.testing.assert_allclose(m, MOMENT * axes, rtol=1e-12)
    rotated = np.zeros(12)
    rotated[5] = 0.1
    r, m, *_ = magnet.poses(rotated, pose)
    R, c = rotation(rotated[3:6]), positions.mean(axis=0)
    np.testing.assert_allclose(r, c + (positions - c) @ R.T, rtol=1e-12)
    np.testing.assert_allclose(m, MOMENT * axes @ R.T, rtol=1e-12)
    sensor = np.zeros((9, 10))
    sensor[:, :3], sensor[:, 3] = [1e-5, 2e-5, 3e-5], 0.1
    sensor[:, 4:7] = [0.1, -0.2, 0.3]
    pose[:, 5:] = [1e-6, 2e-6, -3e-6]
    f, *_ = predicted_readings(network, magnet, sensor, np.zeros(12), pose)
    R_ws = network.R_ws @ rotation(sensor[0, 4:7])
    B = dipole_field(network.positions[:, None] - positions, MOMENT * axes) + pose[0, 5:]
    np.testing.assert_allclose(f, sensor[0, :3] + 1.1 * B @ R_ws, rtol=1e-9)


def test_tool_rotations_are_the_shortest_rotations_from_z():
    axes = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    R = tool_rotations(axes)
    np.testing.assert_allclose(R[:, :, 2], axes, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(R[1, :, 1], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(R[2, :, 0], [1.0, 0.0, 0.0], atol=1e-12)
