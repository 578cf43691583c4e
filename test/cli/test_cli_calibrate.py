"""The commands `mag-tracking calibrate network` and `tumble`."""

import gzip
import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.cli import main
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.file import read_network, write_network
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.recording.writer import RecordingWriter
from support.bundled import DATA, NETWORK_FILE, QUICK, parameter_file, vehicle_path
from support.samples import MagSample, recorded, sample_dict

RECORDING = vehicle_path('straight_car_right')
NETWORK = ['--network', str(NETWORK_FILE)]


def write_recording(folder, readings, name='mag_1'):
    """Write a recording of readings (n, 3) [T] at 100 Hz; return its path."""
    with RecordingWriter(folder / 'hand.mcap') as writer:
        for k, field in enumerate(readings):
            stamp = 10**18 + k * 10**7
            writer.write(f'/{name}/imu/mag', MAGNETIC_FIELD,
                         sample_dict(MagSample(stamp, name, field), name), stamp)
    return folder / 'hand.mcap'


def tumbled():
    """Bundled readings (n, 3) [T] of a tumbled sensor."""
    gauss = np.loadtxt(DATA / 'calibration' / 'tumbled_acc_mag.csv', delimiter=',', skiprows=1)
    return gauss[:, 3:] * 1e-4


def test_calibrate_writes_a_network_that_replay_accepts(tmp_path, capsys):
    out, figure = tmp_path / 'calibrated.yaml', tmp_path / 'calibration.png'
    assert main(['calibrate', 'network', str(RECORDING), *NETWORK, '--out', str(out),
                 '--figure', str(figure)]) == 0
    output = capsys.readouterr().out
    assert ('relative to mag_1' in output and 'passes used: 1' in output
            and 'warning' not in output)
    assert figure.stat().st_size > 20000
    network = read_network(out)
    assert all(c.date.startswith('20') and 'compass' in c.by for c in network.calibrated)
    assert abs(network.clock_offset[1]) > 5e-3 and network.calibrated[1].clock_offset_std < 1e-3
    assert all((std < np.deg2rad(5.0)).all() for std in network.orientation_std)
    assert all(1e-9 < std.min() < std.max() < 1e-7 for std in network.noise_std)
    params = parameter_file(tmp_path / 'quick.yaml', QUICK)
    assert main(['replay', str(RECORDING), '--network', str(out), '--params', str(params), '--out',
                 str(tmp_path / 'run'), '--no-figures']) == 0
    assert ' 1 track (' in capsys.readouterr().out


def test_a_repeated_calibration_adds_no_information(tmp_path):
    """A second calibration with the same recording changes neither orientations nor their stds."""
    first, again = tmp_path / 'first.yaml', tmp_path / 'again.yaml'
    for network, out in ((NETWORK_FILE, first), (first, again)):
        assert main(['calibrate', 'network', str(RECORDING), '--network', str(network), '--out',
                     str(out)]) == 0
    a, b = read_network(first), read_network(again)
    np.testing.assert_allclose(b.R_ws, a.R_ws, atol=1e-9)
    np.testing.assert_allclose(b.orientation_std, a.orientation_std, rtol=1e-6)


def test_a_given_background_does_not_hide_a_flipped_axis(tmp_path, capsys):
    first, flipped = tmp_path / 'first.yaml', tmp_path / 'flipped.yaml'
    main(['calibrate', 'network', str(RECORDING), *NETWORK, '--no-passes', '--out',
          str(first)])
    network = read_network(first)
    background = tuple(R.T @ (network.earth_field * [1.0, 1.0, -1.0]) for R in network.R_ws)
    write_network(flipped, replace(network, background=background,
                                   earth_field=network.earth_field * [1.0, 1.0, -1.0]))
    capsys.readouterr()
    assert main(['calibrate', 'network', str(RECORDING), '--network', str(flipped), '--out',
                 str(tmp_path / 'out.yaml')]) == 2
    assert 'mag_1 differs' in capsys.readouterr().out


@pytest.mark.parametrize('std', [20.0, 180.0])
def test_replay_warns_of_a_large_orientation_uncertainty(tmp_path, capsys, std):
    network = read_network(NETWORK_FILE)
    path = tmp_path / 'network.yaml'
    write_network(path, replace(network, orientation_std=(np.full(3, np.deg2rad(std)), None)))
    assert main(['replay', str(RECORDING), '--network', str(path), '--out', str(tmp_path / 'run'),
                 '--no-figures']) == 0
    output = capsys.readouterr().out
    assert '1 sensor has' in output and ' 1 track (' in output
    angles = json.loads((tmp_path / 'run' / 'summary.json').read_text())['tracks'][0]['mounting']
    # Tracking limits the uncertainty to 15 degrees.
    assert 5.0 < max(angles['mag_1']['std_deg']) <= 15.0


def test_a_calibration_without_passes_is_less_certain(tmp_path, capsys):
    stds = []
    for extra in ([], ['--no-passes']):
        out = tmp_path / f'{len(extra)}.yaml'
        assert main(['calibrate', 'network', str(RECORDING), *NETWORK, '--out', str(out),
                     *extra]) == 0
        stds.append([std[2] for std in read_network(out).orientation_std])
    assert 'nominal heading\n' in capsys.readouterr().out.split('written to')[1]
    assert (np.array(stds[0]) < np.array(stds[1])).all()


def test_a_flipped_axis_is_named(tmp_path, capsys):
    network = read_network(NETWORK_FILE)
    with RecordingWriter(tmp_path / 'flipped.mcap') as writer:
        for sample in recorded(SampleReader(Recording(RECORDING), network)):
            flipped = [1.0, 1.0, -1.0] if sample.sensor == 'mag_2' else np.ones(3)
            writer.write(f'/{sample.sensor}/imu/mag', MAGNETIC_FIELD, sample_dict(
                replace(sample, field=sample.field * flipped), sample.sensor), sample.stamp_ns)
    assert main(['calibrate', 'network', str(tmp_path / 'flipped.mcap'), *NETWORK,
                 '--out', str(tmp_path / 'out.yaml')]) == 2
    output = capsys.readouterr().out
    assert re.search('mag_2 .*: z .*flipped\n', output)
    assert 'mag_1 differs' not in output and 'not used' in output
    assert output.count('no accelerations') == 2
    assert 'few accelerometers' in output


@pytest.mark.parametrize('arguments, message', [
    (['calibrate', 'network', 'nothing.mcap'], 'nothing.mcap'),
    (['calibrate', 'tumble', 'nothing.mcap'], 'nothing.mcap'),
    (['calibrate', 'tumble', str(RECORDING), '--sensor', 'mag_9'], 'mag_9'),
    (['calibrate', 'network', str(RECORDING), '--figure', 'found.xyz'], 'found.xyz'),
    (['calibrate', 'tumble', str(RECORDING), '--field-magnitude', '50'],
     '--field-magnitude: expected 1e-6 to 1e-3 T, got 50'),
])
def test_invalid_arguments_are_named(tmp_path, capsys, arguments, message):
    command, *rest = arguments
    status = main([command, *rest, *NETWORK, '--out',
                   str(tmp_path / 'out.yaml')])
    assert status == 1 and message in capsys.readouterr().err
    assert not (tmp_path / 'out.yaml').exists()


@pytest.mark.parametrize('option', ['--out', '--figure'])
def test_a_missing_folder_is_named_before_the_calibration(tmp_path, capsys, option):
    missing = ['--out', str(tmp_path / 'o.yaml')] if option == '--figure' else []
    assert main(['calibrate', 'network', str(RECORDING), *NETWORK, *missing, option,
                 str(tmp_path / 'no' / 'x.png')]) == 1
    assert (f'{tmp_path / "no"}' in capsys.readouterr().err
            and not list(tmp_path.iterdir()))


def test_an_interrupted_calibration_writes_nothing(tmp_path):
    process = subprocess.Popen(
        [sys.executable, '-c', 'import os, signal, sys\n'
         'from mag_tracking.apps import calibrate as calibrating\n'
         'from mag_tracking.cli import main\n'
         'feed = calibrating.Survey.feed\n'
         'def interrupted(self, sample):\n'
         '    os.kill(os.getpid(), signal.SIGINT)\n    return feed(self, sample)\n'
         'calibrating.Survey.feed = interrupted\nsys.exit(main(sys.argv[1:]))',
         'calibrate', 'network', str(RECORDING), *NETWORK, '--out',
         str(tmp_path / 'o.yaml')],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    output, _ = process.communicate(timeout=120)
    # The exit status after Ctrl-C that `cli.main` documents.
    assert process.returncode == 130, output
    assert 'interrupted: ' in output
    assert not (tmp_path / 'o.yaml').exists()


def test_tumbling_calibrates_a_real_sensor(tmp_path, capsys):
    readings = tumbled()
    out, figure = tmp_path / 'out.yaml', tmp_path / 'tumbled.png'
    assert main(['calibrate', 'tumble', str(write_recording(tmp_path, readings)), *NETWORK,
                 '--sensor', 'mag_1', '--out', str(out), '--figure', str(figure)]) == 0
    assert '1.26% (uncorrected 32.0%)' in capsys.readouterr().out
    assert figure.stat().st_size > 20000
    network = read_network(out)
    magnitude = np.linalg.norm((readings - network.offset[0]) @ network.correction[0].T, axis=1)
    assert magnitude.std() / magnitude.mean() <= 0.015
    assert network.offset[1] is None and network.correction[1] is None
    assert 'tumbled' in network.calibrated[0].by and '1.3 %' in network.calibrated[0].by


def test_tumbling_removes_background_and_noise_of_raw_readings(tmp_path, capsys):
    network = read_network(NETWORK_FILE)
    given_network = replace(network, background=(np.full(3, 1e-5),) * 2,
                            noise_std=(np.full(3, 1e-8),) * 2)
    write_network(tmp_path / 'nominal.yaml', given_network)
    recording = write_recording(tmp_path / 'hand', tumbled())
    assert main(['calibrate', 'tumble', str(recording), '--network',
                 str(tmp_path / 'nominal.yaml'), '--sensor', 'mag_1', '--out',
                 str(tmp_path / 'out.yaml')]) == 0
    calibrated = read_network(tmp_path / 'out.yaml')
    assert calibrated.background[0] is None and calibrated.noise_std[0] is None
    np.testing.assert_array_equal(calibrated.background[1], given_network.background[1])


def test_tumbling_calibrates_raw_counts(tmp_path, capsys):
    """The sensor is a QMC5883L, which is at rest for the first minute."""
    with gzip.open(DATA / 'calibration' / 'qmc5883l_raw_counts.csv.gz', 'rt') as stream:
        counts = np.loadtxt(stream, delimiter=',', skiprows=3)
    assert main(['calibrate', 'tumble', str(write_recording(tmp_path, counts * 1e-9)), '--network',
                 str(NETWORK_FILE), '--sensor', 'mag_1', '--out', str(tmp_path / 'out.yaml')]) == 0
    network = read_network(tmp_path / 'out.yaml')
    magnitude = np.linalg.norm(
        (counts * 1e-9 - network.offset[0]) @ network.correction[0].T, axis=1)
    print(capsys.readouterr().out, magnitude.std() / magnitude.mean())
    assert magnitude.std() / magnitude.mean() <= 0.03


def test_tumbling_refuses_sensors_that_were_not_rotated(tmp_path, capsys):
    assert main(['calibrate', 'tumble', str(RECORDING), *NETWORK, '--out',
                 str(tmp_path / 'out.yaml')]) == 1
    output = capsys.readouterr().out
    assert output.count('calibration rejected') == 2 and 'nothing was' in output
    assert not (tmp_path / 'out.yaml').exists()
