"""Simulated sensor boards below a magnet."""

from dataclasses import replace
from functools import cache

import numpy as np

from mag_tracking.calibration.network_fit import (
    GeometrySettings,
    TrackedMagnet,
    predicted_readings,
    rotation,
    tool_rotations,
)
from mag_tracking.calibration.network_geometry import calibrate_geometry
from mag_tracking.network import SensorNetwork

MOMENT = 0.264
SETTINGS = GeometrySettings(moment_std=0.02)
LOW, HIGH = np.array([-0.08, -0.08, 0.03]), np.array([0.2, 0.2, 0.25])


def board(n_side=3, spacing=0.06, noise=1e-7, seed=3):
    """Network of sensors on a square grid, each with a random orientation."""
    positions = np.array([(x, y, 0.0) for y in range(n_side) for x in range(n_side)]) * spacing
    R = rotation(np.random.default_rng(seed).standard_normal((n_side**2, 3)))
    names = tuple(f'mag_{j}' for j in range(len(positions)))
    return SensorNetwork(names, positions, R, tuple(f'/{name}' for name in names),
                         noise_std=(np.full(3, noise),) * len(names))


def tracked(n_poses, rng):
    """Random positions (n, 3) [m] and axes (n, 3) of a tracked tool above the board."""
    positions = rng.uniform([0.0, 0.0, 0.05], [0.12, 0.12, 0.13], (n_poses, 3))
    axes = np.array([0.0, 0.0, 1.0]) + 0.6 * rng.uniform(-1.0, 1.0, (n_poses, 3))
    return positions, axes / np.linalg.norm(axes, axis=1)[:, None]


def signal_of(geometry, field):
    """Remove the biases and gains of a calibrated network from readings (..., n, 3) [T]."""
    return (np.asarray(field, dtype=float) - geometry.bias) / geometry.gain[:, None]


def magnet_poses(geometry, positions, axes):
    """Convert tracked positions and axes (K, 3), tracker frame, to those of the magnet, world
    frame."""
    magnet = replace(geometry.magnet, tool=positions, R_tool=tool_rotations(axes))
    return magnet.positions_and_axes(geometry.shared, np.zeros((len(positions), 8)))


def truth(network, n_poses, rng, settings=SETTINGS):
    """Draw the unknowns from their priors: sensors (n, 10), shared (12,), poses (K, 8)."""
    s, deg = settings, np.pi / 180.0
    n = len(network)
    sensor = rng.standard_normal((n, 10)) * np.repeat(
        [3e-5, s.gain_std, s.rotation_std_deg * deg, s.position_std], [3, 1, 3, 3])
    shared = rng.standard_normal(12) * np.repeat(
        [s.board_shift_std, s.board_rotation_std_deg * deg, s.tool_offset_std,
         s.tool_tilt_std_deg * deg, s.moment_std], [3, 3, 3, 2, 1])
    pose = rng.standard_normal((n_poses, 8)) * np.repeat(
        [s.tracker_position_std, s.tracker_tilt_std_deg * deg, s.ambient_std], [3, 2, 3])
    return sensor, shared, pose


def simulated(seed, n_poses=40, network=None, settings=SETTINGS):
    """Simulate a board with all modelled errors.

    Returns (network, field (K, n, 3), positions, axes, truth).
    """
    rng = np.random.default_rng(seed)
    network = network or board()
    positions, axes = tracked(n_poses, rng)
    x = truth(network, n_poses, rng, settings)
    magnet = TrackedMagnet(positions, tool_rotations(axes), positions.mean(axis=0), MOMENT)
    f, signal, *_ = predicted_readings(network, magnet, *x)
    magnitude = np.linalg.norm(signal, axis=2)[:, :, None]
    std = np.sqrt(np.square(np.array(network.noise_std))[:, None]
                  + (settings.field_error * magnitude) ** 2)
    f = f + std * rng.standard_normal(f.shape)
    return network, np.swapaxes(f, 0, 1).copy(), positions, axes, x


def estimated(geometry, network):
    """Estimated unknowns (10 n + 12,) of a `NetworkGeometry`, ordered as in its covariance."""
    n = len(network)
    rotations = [_rotation_vector(a.T @ b)
                 for a, b in zip(network.R_ws, geometry.network.R_ws, strict=True)]
    sensor = np.hstack([geometry.bias, geometry.gain[:, None] - 1.0, np.array(rotations),
                        geometry.network.positions - network.positions])
    return np.append(sensor.reshape(10 * n), geometry.shared)


def _rotation_vector(R):
    """Rotation vector (3,) of a rotation matrix; the angle must be below 90 degrees."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    s = np.linalg.norm(v)
    return v if s == 0.0 else v * np.arcsin(s) / s


@cache
def calibrated_boards():
    """Simulate and calibrate several boards; return ((simulated, geometry), ...).

    The result is cached and must not be modified.
    """
    out = []
    for seed in range(16):
        case = simulated(seed)
        network, field, positions, axes, _ = case
        out.append((case, calibrate_geometry(network, field, positions, axes, MOMENT, SETTINGS)))
    return tuple(out)
