"""Calibration of the geometry of a network with a magnet in many poses."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.apps.calibrate import survey_geometry
from mag_tracking.calibration.network_fit import (
    GeometrySettings,
    TrackedMagnet,
    rotation,
    tool_rotations,
)
from mag_tracking.calibration.network_geometry import calibrate_geometry
from mag_tracking.network import CalibrationRecord
from mag_tracking.network.file import read_network, write_network
from support.geometry_command import calibrated_readings, command, write_table
from support.magnet_boards import HIGH, LOW, MOMENT, signal_of, simulated


def with_earlier_calibration(network):
    """Return a network with an earlier calibration, including tumbling and clock offsets."""
    n = len(network)
    rng = np.random.default_rng(8)
    C = np.eye(3) + 0.1 * rng.standard_normal((n, 3, 3))
    return replace(
        network, offset=tuple(1e-5 * rng.standard_normal((n, 3))), correction=tuple(C),
        clock_offset=np.full(n, 0.02), orientation_std=(np.full(3, 0.5),) * n,
        calibrated=(CalibrationRecord('2020-01-01', 'hand', 1e-3),) * n)


def raw_readings(network, field):
    """Raw readings (K, n, 3) [T] whose calibration by the network gives `field`."""
    return np.stack([np.linalg.solve(C, field[:, j].T).T + o for j, (C, o) in enumerate(
        zip(network.correction, network.offset, strict=True))], axis=1)


def test_an_earlier_calibration_is_preserved(tmp_path):
    nominal, field, positions, axes, _ = simulated(2)
    calibrated = with_earlier_calibration(nominal)
    geometry = calibrate_geometry(nominal, field, positions, axes, MOMENT, GeometrySettings())
    write_network(tmp_path / 'nominal.yaml', calibrated)
    table = write_table(tmp_path / 'poses.csv', raw_readings(calibrated, field), positions, axes)
    assert command(table, '--network', tmp_path / 'nominal.yaml', out=tmp_path / 'out.yaml') == 0
    network = read_network(tmp_path / 'out.yaml')
    B = calibrated_readings(network, raw_readings(calibrated, field))
    np.testing.assert_allclose(B, signal_of(geometry, field), rtol=0, atol=1e-11)
    np.testing.assert_allclose(network.positions, geometry.network.positions, atol=1e-8)
    np.testing.assert_allclose(network.R_ws, geometry.network.R_ws, atol=1e-6)
    assert all(c.clock_offset_std == 1e-3 and c.by == 'magnet, 40 tracked poses'
               for c in network.calibrated) and (network.clock_offset == 0.02).all()


def test_orientation_stds_are_about_world_axes(tmp_path):
    """A sensor that measures only x does not observe a rotation about x."""
    nominal, field, positions, axes, _ = simulated(3)
    # The x axis of sensor 4 is along world y, its y axis along world z.
    R = nominal.R_ws.copy()
    mounting = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    field[:, 4] = field[:, 4] @ R[4].T @ mounting
    R[4] = mounting
    field[:, 4, 1:] = np.nan
    write_network(tmp_path / 'nominal.yaml', replace(nominal, R_ws=R))
    table = write_table(tmp_path / 'poses.csv', field, positions, axes)
    assert command(table, '--network', tmp_path / 'nominal.yaml', out=tmp_path / 'out.yaml') == 0
    std = np.rad2deg(read_network(tmp_path / 'out.yaml').orientation_std[4])
    assert std[1] == pytest.approx(2.0, rel=0.05) and std[0] < 1.0 and std[2] < 1.0


def test_a_sensor_without_readings_keeps_its_nominal_geometry(tmp_path, capsys):
    nominal, field, positions, axes, _ = simulated(3)
    calibrated = with_earlier_calibration(nominal)
    field[:, 4] = np.nan
    field[5] = np.nan
    readings = raw_readings(calibrated, field)
    # A sensor that was not tumbled may lack a single axis.
    network = replace(calibrated, offset=(*calibrated.offset[:6], None, *calibrated.offset[7:]),
                      correction=(*calibrated.correction[:6], None, *calibrated.correction[7:]))
    readings[:, 6], readings[:, 6, 2] = field[:, 6], np.nan
    write_network(tmp_path / 'nominal.yaml', network)
    table = write_table(tmp_path / 'poses.csv', readings, positions, axes)
    assert command(table, '--network', tmp_path / 'nominal.yaml', out=tmp_path / 'out.yaml') == 0
    text = capsys.readouterr().out
    assert '39 of 40 poses' in text
    assert '(no readings): 1\n' in text
    assert 'warning: mag_4 ' in text
    assert 'warning: mag_6 ' in text
    before, after = read_network(tmp_path / 'nominal.yaml'), read_network(tmp_path / 'out.yaml')
    for name in ('positions', 'R_ws', 'noise_std', 'background', 'correction', 'orientation_std'):
        before_4, after_4 = (getattr(network, name)[4] for network in (before, after))
        assert (after_4 is None) == (before_4 is None)
        # The file stores quaternions, so rotations change by rounding.
        assert after_4 is None or np.abs(after_4 - before_4).max() < 1e-14, name
    assert after.calibrated[4] == before.calibrated[4] and after.calibrated[3].by != 'hand'
    assert after.background[6] is None and after.correction[6][0, 0] != 1.0


def test_unknown_poses_keep_the_row_numbers_of_the_table(tmp_path):
    """Skipped rows do not change the row numbers of later poses."""
    nominal, field, positions, axes, x = simulated(21)
    field[4] = np.nan
    table = write_table(tmp_path / 'poses.csv', field, positions, axes)
    survey = survey_geometry(table, nominal, MOMENT, GeometrySettings(), 'today', (LOW, HIGH))
    assert 6 not in survey.rows and survey.n_poses == 40 > len(survey.rows)
    magnet = TrackedMagnet(positions, tool_rotations(axes), positions.mean(axis=0), MOMENT)
    r = magnet.poses(x[1], x[2])[0][survey.rows - 2]
    assert np.median(np.linalg.norm(survey.geometry.poses[0] - r, axis=1)) < 3e-3
    np.testing.assert_allclose(survey.rotation_angle, np.linalg.norm(
        [rotation_vector(a.T @ b) for a, b in zip(nominal.R_ws, survey.network.R_ws, strict=True)],
        axis=1), rtol=1e-6)


def rotation_vector(R):
    """Rotation vector (3,) [rad] of a rotation below 90 degrees."""
    v = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    s = np.linalg.norm(v)
    np.testing.assert_allclose(rotation(v / s * np.arcsin(s)), R, atol=1e-9)
    return v / s * np.arcsin(s)
