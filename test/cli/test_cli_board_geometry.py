"""The command `mag-tracking calibrate board`."""

import signal
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

from mag_tracking.calibration.magnet_pose import locate_magnet
from mag_tracking.calibration.network_fit import GeometrySettings
from mag_tracking.calibration.network_geometry import calibrate_geometry
from mag_tracking.network.file import read_network, write_network
from support.geometry_command import calibrated_readings, command, write_table
from support.magnet_boards import MOMENT, board, magnet_poses, signal_of, simulated
from support.real_board import BOX, FOLDER, assert_within_limits, board_of_41, print_errors

POSITIONS_FILE = FOLDER / 'sensor_positions_m.csv'


@pytest.fixture(scope='module')
def calibrated(tmp_path_factory):
    """(written network, output, folder) of a calibration with every other pose."""
    folder = tmp_path_factory.mktemp('geometry')
    nominal, field, positions, axes = board_of_41()
    write_network(folder / 'nominal.yaml', nominal)
    table = write_table(folder / 'poses.csv', field[::2], positions[::2], axes[::2])
    run = subprocess.run(
        [sys.executable, '-m', 'mag_tracking.cli', 'calibrate', 'board', table, '--network',
         folder / 'nominal.yaml', '--moment', str(MOMENT), '--out', folder / 'board.yaml',
         '--figure', folder / 'board.png'], capture_output=True, text=True, check=True)
    return read_network(folder / 'board.yaml'), run.stdout, folder


def test_the_written_network_locates_the_magnet(calibrated):
    """Held-out raw readings are calibrated by the stage Calibrate and give accurate poses."""
    network, *_ = calibrated
    nominal, field, positions, axes = board_of_41()
    g = calibrate_geometry(nominal, field[::2], positions[::2], axes[::2], MOMENT,
                           GeometrySettings())
    B = calibrated_readings(network, field[1::2])
    # The fields are equal within the digits of the file, because the background does not drift.
    np.testing.assert_allclose(B, signal_of(g, field[1::2]), rtol=0, atol=1e-12)
    poses = [locate_magnet(network, b, MOMENT, *BOX, 0.01, 1e-7) for b in B]
    assert all(p.converged for p in poses)
    r, u = magnet_poses(g, positions[1::2], axes[1::2])
    position_error = np.linalg.norm([p.position for p in poses] - r, axis=1)
    angle_error = np.rad2deg([np.arccos(np.clip(p.axis @ a, -1.0, 1.0))
                              for p, a in zip(poses, u, strict=True)])
    is_low = positions[1::2, 2] < 0.1
    print_errors('by the written file', position_error, angle_error, is_low)
    assert_within_limits(position_error, angle_error, is_low)


def test_the_printed_table_and_figure_match_the_network(calibrated):
    network, text, folder = calibrated
    rows = [line.split() for line in text.splitlines() if line.startswith('mag_')]
    assert [r[0] for r in rows] == list(network.names)
    nominal = board_of_41()[0]
    shift = 1e3 * np.linalg.norm(network.positions - nominal.positions, axis=1)
    np.testing.assert_allclose([float(r[1]) for r in rows], shift, atol=0.006)
    rotation_deg = np.rad2deg([np.arccos(0.5 * (np.trace(R) - 1.0)) for R in network.R_ws])
    np.testing.assert_allclose([float(r[3]) for r in rows], rotation_deg, atol=0.006)
    gain = 1.0 / np.array([C[0, 0] for C in network.correction])
    np.testing.assert_allclose([float(r[5]) for r in rows], gain, atol=6e-5)
    bias = gain[:, None] * network.background
    np.testing.assert_allclose([[float(v) for v in r[7:10]] for r in rows], 1e6 * bias, atol=0.006)
    assert np.ptp(gain) > 0.01 and shift.max() > 0.5 and rotation_deg.max() > 1.0
    assert 'moment 0.264 A m^2 (given)' in text and ' mm; tilt ' in text
    assert '162 of 162 poses used, normalised cost 0.6' in text
    assert 'warning' not in text and 'note' not in text
    assert all(c.by == 'magnet, 162 tracked poses' and c.date.startswith('20')
               and np.isnan(c.clock_offset_std) for c in network.calibrated)
    assert (folder / 'board.png').stat().st_size > 50_000
    noise = np.array(nominal.noise_std) / gain[:, None]
    np.testing.assert_allclose(np.array(network.noise_std), noise, rtol=1e-9)


def test_sensor_positions_alone_are_sufficient(tmp_path, capsys):
    out = tmp_path / 'board.yaml'
    short_table = write_table(tmp_path / 'poses.csv', *(v[::6] for v in board_of_41()[1:]))
    assert command(short_table, '--sensors', POSITIONS_FILE, out=out) == 0
    text = capsys.readouterr().out
    assert '41 sensors assumed' in text
    # With one noise level for two kinds of sensors, the noisier kind is inconsistent.
    assert 'sensors inconsistent' in text
    network = read_network(out)
    assert network.noise_std == (None,) * 41 and network.imu_topics == (None,) * 41
    assert command(short_table, '--sensors', POSITIONS_FILE, '--noise-std', 3e-7, out=out) == 0
    assert 'assumed' not in capsys.readouterr().out
    noise = np.array(read_network(out).noise_std) * [[C[0, 0] ** -1] for C in
                                                     read_network(out).correction]
    np.testing.assert_allclose(noise, 3e-7, rtol=1e-9)


def test_inconsistent_sensors_and_poses_are_named(tmp_path, capsys, monkeypatch):
    """Swapped axes are reported with the sensor, an inconsistent pose with its row in the file."""
    nominal, field, positions, axes, _ = simulated(5)
    field[:, 2] = field[:, 2][:, [1, 0, 2]]
    field[3] = np.nan
    positions[7, 0] += 0.02
    write_network(tmp_path / 'nominal.yaml', nominal)
    table = write_table(tmp_path / 'poses.csv', field, positions, axes)
    figures, save = [], Figure.savefig
    monkeypatch.setattr(Figure, 'savefig', lambda figure, *a, **k: figures.append(figure)
                        or save(figure, *a, **k))
    assert command(table, '--network', tmp_path / 'nominal.yaml', '--figure',
                   tmp_path / 'board.png', out=tmp_path / 'out.yaml') == 0
    text = capsys.readouterr().out
    assert 'noise): mag_2\n' in text
    assert 'row 1): 9\n' in text
    lines = table.read_text().splitlines()
    assert lines[8].endswith(','.join(map(str, [*positions[7].tolist(), *axes[7].tolist()])))
    labels = [t.get_text() for f in figures[0].subfigs for a in f.axes for t in
              (a.get_legend().get_texts() if a.get_legend() else [])]
    assert 'suspect sensor' in labels
    titles = [a.get_title(loc='left') for f in figures[0].subfigs for a in f.axes]
    assert any('suspect: 1' in title for title in titles)


# Rejected calibrations, settings and invalid input.

def test_a_reversed_magnet_is_refused(tmp_path, capsys):
    nominal, field, positions, axes, _ = simulated(9)
    write_network(tmp_path / 'nominal.yaml', nominal)
    table = write_table(tmp_path / 'poses.csv', field, positions, -axes)
    assert command(table, '--network', tmp_path / 'nominal.yaml', '--figure',
                   tmp_path / 'board.png', out=tmp_path / 'out.yaml') == 1
    out, err = capsys.readouterr()
    assert 'normalised cost' in err
    assert 'written to' not in out
    assert {p.name for p in tmp_path.iterdir()} == {'nominal.yaml', 'poses.csv'}


def test_settings_are_read_from_a_file(tmp_path, capsys):
    nominal, field, positions, axes, _ = simulated(9)
    write_network(tmp_path / 'nominal.yaml', nominal)
    table = write_table(tmp_path / 'poses.csv', field, positions, axes)
    params = tmp_path / 'params.yaml'
    params.write_text('{rotation_std_deg: 0.0, moment_std: 0.02}')
    common = '--network', tmp_path / 'nominal.yaml', '--params', params
    assert command(table, *common, out=tmp_path / 'out.yaml') == 0
    network = read_network(tmp_path / 'out.yaml')
    np.testing.assert_allclose(network.R_ws, nominal.R_ws, atol=1e-12)
    # A fixed orientation has no standard deviation in the file.
    assert network.orientation_std == (None,) * 9
    assert 'moment 0.26' in (text := capsys.readouterr().out) and '(given)' not in text
    params.write_text('gain_sdt: 0.1')
    assert command(table, *common, out=tmp_path / 'new.yaml') == 1
    assert 'mean gain_std?' in capsys.readouterr().err
    params.write_text('iterations: 1')
    assert command(table, *common, out=tmp_path / 'new.yaml') == 1
    assert 'steps: 1)' in capsys.readouterr().err
    assert not (tmp_path / 'new.yaml').exists()


@pytest.mark.parametrize('options, message', [
    (['--unknown-poses', '--low', 0, 0, 0],
     '--unknown-poses: '),
    (['--low', 0, 0, 0], '--low and --high require --unknown-poses'),
    (['--unknown-poses', '--low', 0, 0, 0, '--high', 1, 0, 1], '--high: '),
    (['--unknown-poses', '--low', 0, 0, 0, '--high', 1, 'nan', 1],
     '--high: '),
    (['--moment', 'nan'], '--moment: '),
    (['--moment', '-1'], '--moment: '),
    (['--noise-std', '0.01'], '--noise-std: '),
    (['--figure', '/nowhere/board.png'], '/nowhere'),
    (['--figure', 'board.xyz'], 'board.xyz'),
    (['--params', '/nowhere.yaml'], '/nowhere.yaml')])
def test_invalid_options_are_named(tmp_path, capsys, options, message):
    assert command(FOLDER / 'poses.csv', '--sensors', POSITIONS_FILE, *options,
                   out=tmp_path / 'out.yaml') == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_invalid_files_are_named(tmp_path, capsys):
    short_table = tmp_path / 'few.csv'
    short_table.write_text('0,0,0\n1,0,0\n')
    out = tmp_path / 'out.yaml'
    assert command(FOLDER / 'poses.csv', '--sensors', short_table, out=out) == 1
    assert 'has 2' in capsys.readouterr().err
    short_table.write_text('0,0,0\n0,0,0\n')
    assert command(FOLDER / 'poses.csv', '--sensors', short_table, out=out) == 1
    assert 'few.csv: sensors mag_0 and mag_1' in capsys.readouterr().err
    assert command(tmp_path / 'none.csv', '--sensors', POSITIONS_FILE, out=out) == 1
    assert 'cannot read' in capsys.readouterr().err
    nominal, field, positions, axes, _ = simulated(1, n_poses=5)
    write_network(tmp_path / 'nominal.yaml', nominal)
    write_table(short_table, field, np.tile(nominal.positions[0], (5, 1)), axes)
    assert command(short_table, '--network', tmp_path / 'nominal.yaml', out=out) == 1
    assert 'few.csv: pose 0: [0.0, 0.0, 0.0]' in capsys.readouterr().err
    assert not out.exists()


# Unknown poses: no motion tracker.

BOX_OPTIONS = ('--unknown-poses', '--low', -0.08, -0.08, 0.03, '--high', 0.2, 0.2, 0.25)


def test_unknown_poses_are_estimated(tmp_path, capsys):
    """The table has no columns of poses."""
    nominal, field, positions, axes, _ = simulated(21)
    field[4] = np.nan
    write_network(tmp_path / 'nominal.yaml', nominal)
    table = write_table(tmp_path / 'poses.csv', field, 0.0 * positions, axes)
    table.write_text('\n'.join(','.join(line.split(',')[:-6])
                               for line in table.read_text().splitlines()))
    assert command(table, '--network', tmp_path / 'nominal.yaml', *BOX_OPTIONS,
                   out=tmp_path / 'out.yaml') == 0
    text = capsys.readouterr().out
    n = int(text.split(' of 40 poses')[0].split()[-1])
    assert 36 <= n < 40 and f'box): {40 - n}' in text and '; tilt ' not in text
    network = read_network(tmp_path / 'out.yaml')
    assert network.calibrated[0].by == f'magnet, {n} unknown poses'
    B = calibrated_readings(network, field)
    pose = locate_magnet(network, B[0], MOMENT, [-0.08, -0.08, 0.03], [0.2, 0.2, 0.25],
                         0.01, 1e-7)
    assert pose.converged and pose.normalised_cost < 3.0


def test_ctrl_c_ends_the_command_without_files(tmp_path):
    process = subprocess.Popen(
        [sys.executable, '-m', 'mag_tracking.cli', 'calibrate', 'board', FOLDER / 'poses.csv',
         '--sensors',
         POSITIONS_FILE, '--moment', str(MOMENT), '--unknown-poses', '--low', *map(str, BOX[0]),
         '--high', *map(str, BOX[1]), '--out', tmp_path / 'out.yaml'],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # In a background job, the process would inherit that SIGINT is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    assert '41 sensors' in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert 'interrupted' in err and 'Traceback' not in err and not out
    assert not list(tmp_path.iterdir())


def test_ctrl_c_while_writing_loses_no_file(tmp_path, monkeypatch):
    """The interrupt occurs between writing the network file and the figure."""
    from mag_tracking.cli import board_geometry as geometry
    nominal, field, positions, axes, _ = simulated(9)
    write_network(tmp_path / 'nominal.yaml', nominal)
    table = write_table(tmp_path / 'poses.csv', field, positions, axes)

    def interrupted(*args):
        write_network(*args)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(geometry, 'write_network', interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert command(table, '--network', tmp_path / 'nominal.yaml', '--figure',
                       tmp_path / 'board.pdf', out=tmp_path / 'out.yaml') == 0
    finally:
        signal.signal(signal.SIGINT, before)
    assert (tmp_path / 'board.pdf').stat().st_size > 10_000
    assert len(read_network(tmp_path / 'out.yaml')) == len(board())
