"""Real readings of 41 sensors, with the poses of a magnet from an optical tracker."""

import numpy as np

from mag_tracking.calibration.magnet_pose import locate_magnet
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.pose_table import read_pose_table, read_sensor_positions
from support.bundled import DATA
from support.magnet_boards import signal_of

MOMENT = 0.264
FOLDER = DATA / 'magnet_41_sensors'
BOX = np.array([-0.05, -0.05, 0.03]), np.array([0.2, 0.22, 0.3])


def board_of_41():
    """Read the bundled data of the board: (network, field (K, 41, 3) [T], positions, axes)."""
    sensor_positions = read_sensor_positions(FOLDER / 'sensor_positions_m.csv')
    names = tuple(f'mag_{j}' for j in range(len(sensor_positions)))
    noise = (np.full(3, 4e-8),) * 25 + (np.array([3.2e-7, 3.2e-7, 4.1e-7]),) * 16
    network = SensorNetwork(names, sensor_positions, np.tile(np.eye(3), (41, 1, 1)),
                            tuple(f'/{name}' for name in names), noise_std=noise)
    return network, *read_pose_table(FOLDER / 'poses.csv')


def errors(geometry, field, positions, axes, to_world):
    """Errors of the estimated positions [m] and axes [deg] of a magnet.

    The function `to_world` transforms positions and axes from the tracker frame to the world frame.
    """
    r, u = to_world(positions, axes)
    estimates = [locate_magnet(geometry.network, B, geometry.moment[0], *BOX, 0.01, 1e-7)
                 for B in signal_of(geometry, field)]
    assert all(p.converged for p in estimates)
    angle = [np.rad2deg(np.arccos(np.clip(p.axis @ a, -1.0, 1.0)))
             for p, a in zip(estimates, u, strict=True)]
    return np.linalg.norm([p.position for p in estimates] - r, axis=1), np.array(angle)


def print_errors(title, position_error, axis_error, is_low):
    print(f'{title}: {1e3 * np.median(position_error):.3f} mm, '
          f'{1e3 * np.median(position_error[is_low]):.3f} mm below 100 mm, '
          f'{np.median(axis_error):.2f} deg; 90 % within '
          f'{1e3 * np.quantile(position_error, 0.9):.2f} mm')


def assert_within_limits(position_error, axis_error, is_low):
    """Assert the specified limits, and the tighter limits that have been reached."""
    assert np.median(position_error) <= 2.0e-3 and np.median(position_error[is_low]) <= 0.8e-3
    assert np.median(axis_error) <= 2.5
    assert np.median(position_error) <= 1.0e-3 and np.median(position_error[is_low]) <= 0.55e-3
    assert np.median(axis_error) <= 1.1
