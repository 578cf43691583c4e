"""Calibration of a board of 41 sensors from recorded readings, tested on other readings."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from mag_tracking.analysis.network_blind import calibrate_geometry_blind
from mag_tracking.analysis.network_geometry import GeometrySettings, calibrate_geometry
from mag_tracking.analysis.network_readings import rotation, tool_rotations
from support.marks import studied
from support.real_board import BOX, MOMENT, board_of_41, errors, said, within_limits


@pytest.fixture(scope='module')
def recorded():
    """(network, field, positions, axes)."""
    return board_of_41()


@pytest.mark.parametrize('first', studied([0, 1], [0]))
def test_calibration_on_every_other_row_is_accurate_on_the_rest(recorded, first):
    network, field, positions, axes = recorded
    g = calibrate_geometry(network, field[first::2], positions[first::2], axes[first::2], MOMENT,
                           GeometrySettings())
    assert g.converged and g.suspect_sensors == () and g.suspect_poses == ()
    assert 0.4 < g.normalised_cost < 1.0
    # The magnet is about 8 mm below the tracked point.
    assert g.tool_offset[0][2] == pytest.approx(-8e-3, abs=1e-3)
    assert g.tool_offset[1][2] < 3e-4 and (g.tool_tilt[1] < 2e-3).all()
    rest = slice(1 - first, None, 2)
    place, turn = errors(g, field[rest], positions[rest], axes[rest], g.magnet_poses)
    low = positions[rest, 2] < 0.1
    said(f'known poses, rows {first}::2', place, turn, low)
    within_limits(place, turn, low)
    if first == 0:
        # The stated geometry with calibrated biases only is at least three times worse.
        stated = GeometrySettings(
            gain_std=0.0, rotation_std_deg=0.0, position_std=0.0, board_shift_std=0.0,
            board_rotation_std_deg=0.0, tool_offset_std=0.0, tool_tilt_std_deg=0.0)
        plain = calibrate_geometry(network, field[::2], positions[::2], axes[::2], MOMENT, stated)
        few = slice(1, None, 6)
        worse, turn = errors(plain, field[few], positions[few], axes[few], plain.magnet_poses)
        said('as stated', worse, turn, positions[few, 2] < 0.1)
        assert np.median(worse) > 3.0 * np.median(place)


def registered(r, u, positions, axes):
    """Map from tracked poses to the world: best rigid motion, tool offset and tool tilt."""
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
def test_blind_calibration_is_accurate_on_the_other_rows(recorded):
    """Calibrated without the tracker, registered by the training rows, tested on the others."""
    network, field, positions, axes = recorded
    g = calibrate_geometry_blind(network, field[::2], MOMENT, *BOX, GeometrySettings())
    assert g.converged and g.suspect_sensors == () and len(g.rows) >= 155
    poses = registered(*g.poses, positions[::2][g.rows], axes[::2][g.rows])
    place, turn = errors(g, field[1::2], positions[1::2], axes[1::2], poses)
    low = positions[1::2, 2] < 0.1
    said('unknown poses, rows 0::2', place, turn, low)
    within_limits(place, turn, low)
