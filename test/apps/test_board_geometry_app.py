"""Network geometry calibrated with the poses of a magnet."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.analysis.network_geometry import GeometrySettings, calibrate_geometry
from mag_tracking.analysis.network_readings import TrackedMagnet, rotation, tool_rotations
from mag_tracking.apps.board_geometry import survey_geometry
from mag_tracking.network import CalibrationRecord
from mag_tracking.network.file import read_network, write_network
from support.geometry_command import command, through_calibrate, write_table
from support.magnet_boards import HIGH, LOW, MOMENT, simulated


def with_earlier_calibration(network):
    """The network with an earlier calibration: tumbled sensors and clock offsets."""
    n = len(network)
    rng = np.random.default_rng(8)
    C = np.eye(3) + 0.1 * rng.standard_normal((n, 3, 3))
    return replace(
        network, offset=tuple(1e-5 * rng.standard_normal((n, 3))), correction=tuple(C),
        clock_offset=np.full(n, 0.02), orientation_std=(np.full(3, 0.5),) * n,
        calibrated=(CalibrationRecord('2020-01-01', 'hand', 1e-3),) * n)


def raw_readings(network, field):
    """Raw readings (K, n, 3) that the network calibrates to `field`."""
    return np.stack([np.linalg.solve(C, field[:, j].T).T + o for j, (C, o) in enumerate(
        zip(network.correction, network.offset, strict=True))], axis=1)


def test_an_earlier_calibration_is_included(tmp_path):
    stated, field, positions, axes, _ = simulated(2)
    tumbled = with_earlier_calibration(stated)
    g = calibrate_geometry(stated, field, positions, axes, MOMENT, GeometrySettings())
    write_network(tmp_path / 'stated.yaml', tumbled)
    table = write_table(tmp_path / 'poses.csv', raw_readings(tumbled, field), positions, axes)
    assert command(table, '--network', tmp_path / 'stated.yaml', out=tmp_path / 'out.yaml') == 0
    network = read_network(tmp_path / 'out.yaml')
    B = through_calibrate(network, raw_readings(tumbled, field))
    np.testing.assert_allclose(B, g.signal(field), rtol=0, atol=1e-11)
    np.testing.assert_allclose(network.positions, g.network.positions, atol=1e-8)
    np.testing.assert_allclose(network.R_ws, g.network.R_ws, atol=1e-6)
    assert all(c.clock_offset_std == 1e-3 and c.by == 'magnet, 40 tracked poses'
               for c in network.calibrated) and (network.clock_offset == 0.02).all()


def test_orientation_stds_are_about_world_axes(tmp_path):
    """A sensor that measures only x does not observe a rotation about x."""
    stated, field, positions, axes, _ = simulated(3)
    # The x axis of sensor 4 is along world y, its y axis along world z.
    R = stated.R_ws.copy()
    mounting = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    field[:, 4] = field[:, 4] @ R[4].T @ mounting
    R[4] = mounting
    field[:, 4, 1:] = np.nan
    write_network(tmp_path / 'stated.yaml', replace(stated, R_ws=R))
    table = write_table(tmp_path / 'poses.csv', field, positions, axes)
    assert command(table, '--network', tmp_path / 'stated.yaml', out=tmp_path / 'out.yaml') == 0
    std = np.rad2deg(read_network(tmp_path / 'out.yaml').orientation_std[4])
    assert std[1] == pytest.approx(2.0, rel=0.05) and std[0] < 1.0 and std[2] < 1.0


def test_a_sensor_without_readings_keeps_its_nominal_geometry(tmp_path, capsys):
    stated, field, positions, axes, _ = simulated(3)
    tumbled = with_earlier_calibration(stated)
    field[:, 4] = np.nan
    field[5] = np.nan
    readings = raw_readings(tumbled, field)
    # A sensor that was not tumbled may lack a single axis.
    plain = replace(tumbled, offset=(*tumbled.offset[:6], None, *tumbled.offset[7:]),
                    correction=(*tumbled.correction[:6], None, *tumbled.correction[7:]))
    readings[:, 6], readings[:, 6, 2] = field[:, 6], np.nan
    write_network(tmp_path / 'stated.yaml', plain)
    table = write_table(tmp_path / 'poses.csv', readings, positions, axes)
    assert command(table, '--network', tmp_path / 'stated.yaml', out=tmp_path / 'out.yaml') == 0
    text = capsys.readouterr().out
    assert '39 of 40 poses' in text
    assert 'warning: poses not used (without readings): 1\n' in text
    assert 'warning: mag_4 has no readings; its nominal geometry is kept' in text
    assert 'warning: mag_6 never reported z: its background is still unknown' in text
    was, now = read_network(tmp_path / 'stated.yaml'), read_network(tmp_path / 'out.yaml')
    for name in ('positions', 'R_ws', 'noise_std', 'background', 'correction', 'orientation_std'):
        was_4, now_4 = (getattr(network, name)[4] for network in (was, now))
        assert (now_4 is None) == (was_4 is None)
        # The file stores quaternions, so rotations change by rounding.
        assert now_4 is None or np.abs(now_4 - was_4).max() < 1e-14, name
    assert now.calibrated[4] == was.calibrated[4] and now.calibrated[3].by != 'hand'
    assert now.background[6] is None and now.correction[6][0, 0] != 1.0


def test_unknown_poses_keep_the_row_numbers_of_the_table(tmp_path):
    """Row numbers are those of the table, also if rows were skipped."""
    stated, field, positions, axes, x = simulated(21)
    field[4] = np.nan
    table = write_table(tmp_path / 'poses.csv', field, positions, axes)
    found = survey_geometry(table, stated, MOMENT, GeometrySettings(), 'today', (LOW, HIGH))
    assert 6 not in found.rows and found.n_poses == 40 > len(found.rows)
    magnet = TrackedMagnet(positions, tool_rotations(axes), positions.mean(axis=0), MOMENT)
    r = magnet.poses(x[1], x[2])[0][found.rows - 2]
    assert np.median(np.linalg.norm(found.geometry.poses[0] - r, axis=1)) < 3e-3
    np.testing.assert_allclose(found.rotation_angle, np.linalg.norm(
        [rotation_vector(a.T @ b) for a, b in zip(stated.R_ws, found.network.R_ws, strict=True)],
        axis=1), rtol=1e-6)


def rotation_vector(R):
    """Rotation vector (3,) [rad] of a rotation below 90 degrees."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    s = np.linalg.norm(v)
    np.testing.assert_allclose(rotation(v / s * np.arcsin(s)), R, atol=1e-9)
    return v / s * np.arcsin(s)
