"""Calibration of a board of 41 sensors from recorded readings, validated with held-out readings."""

from functools import partial

import numpy as np
import pytest
from scipy.optimize import least_squares

from mag_tracking.calibration.network_fit import GeometrySettings, rotation, tool_rotations
from mag_tracking.calibration.network_geometry import (
    calibrate_geometry,
    calibrate_geometry_blind,
)
from support.magnet_boards import magnet_poses
from support.marks import studied
from support.real_board import BOX, MOMENT, assert_within_limits, board_of_41, errors, print_errors


@pytest.fixture(scope='module')
def recorded():
    """Recorded readings of the board: (network, field, positions, axes)."""
    return board_of_41()


@pytest.mark.parametrize('first', studied([0, 1], [0]))
def test_calibration_with_half_of_the_readings_is_accurate_for_the_other_half(recorded, first):
    network, field, positions, axes = recorded
    g = calibrate_geometry(network, field[first::2], positions[first::2], axes[first::2], MOMENT,
                           GeometrySettings())
    assert g.converged and g.suspect_sensors == () and g.suspect_poses == ()
    assert 0.4 < g.normalised_cost < 1.0
    # The magnet is about 8 mm below the tracked point.
    assert g.tool_offset[0][2] == pytest.approx(-8e-3, abs=1e-3)
    assert g.tool_offset[1][2] < 3e-4 and (g.tool_tilt[1] < 2e-3).all()
    test_rows = slice(1 - first, None, 2)
    position_error, axis_error = errors(g, field[test_rows], positions[test_rows],
                                        axes[test_rows], partial(magnet_poses, g))
    is_low = positions[test_rows, 2] < 0.1
    print_errors(f'known poses, rows {first}::2', position_error, axis_error, is_low)
    assert_within_limits(position_error, axis_error, is_low)
    if first == 0:
        # If only the biases are calibrated, the errors are at least three times as large.
        bias_only = GeometrySettings(
            gain_std=0.0, rotation_std_deg=0.0, position_std=0.0, board_shift_std=0.0,
            board_rotation_std_deg=0.0, tool_offset_std=0.0, tool_tilt_std_deg=0.0)
        nominal = calibrate_geometry(network, field[::2], positions[::2], axes[::2], MOMENT,
                                     bias_only)
        sixth_rows = slice(1, None, 6)
        nominal_error, axis_error = errors(nominal, field[sixth_rows], positions[sixth_rows],
                                           axes[sixth_rows], partial(magnet_poses, nominal))
        print_errors('nominal', nominal_error, axis_error, positions[sixth_rows, 2] < 0.1)
        assert np.median(nominal_error) > 3.0 * np.median(position_error)


def fit_registration(r, u, positions, axes):
    """Fit rigid motion, tool offset and tool tilt; return the map from tracked to world poses."""
    centre = positions.mean(axis=0)

    def poses(x, positions, axes):
        T, R = tool_rotations(axes), rotation(x[3:6])
        v = np.append(x[9:], 1.0)
        return ((positions - centre + T @ x[6:9]) @ R.T + centre + x[:3],
                T @ (v / np.linalg.norm(v)) @ R.T)

    def residuals(x):
        p, a = poses(x, positions, axes)
        return np.concatenate([((p - r) / 1e-3).ravel(), ((a - u) / 0.02).ravel(), x[:9] / 0.03])

    x = least_squares(residuals, np.zeros(11), loss='soft_l1').x
    return lambda positions, axes: poses(x, positions, axes)


@pytest.mark.study
def test_blind_calibration_is_accurate_for_the_other_readings(recorded):
    """The calibration uses no tracked poses; they serve only for registration and validation."""
    network, field, positions, axes = recorded
    g = calibrate_geometry_blind(network, field[::2], MOMENT, *BOX, GeometrySettings())
    assert g.converged and g.suspect_sensors == () and len(g.rows) >= 155
    poses = fit_registration(*g.poses, positions[::2][g.rows], axes[::2][g.rows])
    position_error, axis_error = errors(g, field[1::2], positions[1::2], axes[1::2], poses)
    is_low = positions[1::2, 2] < 0.1
    print_errors('unknown poses, rows 0::2', position_error, axis_error, is_low)
    assert_within_limits(position_error, axis_error, is_low)
