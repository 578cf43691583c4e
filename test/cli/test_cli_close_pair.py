"""Recording of a close pair of sensors: output of `fit`, `replay` and `doctor`."""

import csv
import json

import pytest

from mag_tracking.cli import main
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.recording.writer import RecordingWriter
from support.bundled import QUICK, parameter_file
from support.close_pairs import readings_of
from support.samples import sample_dict, samples_of

SEED = 20
NETWORK = '''earth_field: [2.0e-6, 1.55e-5, -4.9e-5]
sensors:
  mag_1: {position: [-0.25, 0.0, 0.0]}
  mag_2: {position: [0.25, 0.0, 0.0]}
'''


@pytest.fixture(scope='module')
def pair(tmp_path_factory):
    """(recording, network file, velocity along x [m/s])."""
    folder = tmp_path_factory.mktemp('pair')
    readings, velocity, _ = readings_of(SEED)
    with RecordingWriter(folder / 'pair.mcap') as writer:
        for s in samples_of(readings):
            writer.write(f'/{s.sensor}/imu/mag', MAGNETIC_FIELD, sample_dict(s, s.sensor),
                         s.stamp_ns)
    (folder / 'network.yaml').write_text(NETWORK)
    return str(folder / 'pair.mcap'), str(folder / 'network.yaml'), velocity


def test_fit_reports_speed_and_direction_by_two_methods(pair, tmp_path, capsys):
    recording, network, velocity = pair
    assert main(['fit', recording, '--network', network, '--out', str(tmp_path), '--no-figures',
                 '--orders', '2', '3', '-v']) == 0
    output = capsys.readouterr().out
    assert 'delay between' in output and 'contradict' not in output
    with open(tmp_path / 'fits.csv', encoding='utf-8') as stream:
        rows = list(csv.DictReader(stream))
    chosen = next(row for row in rows if row['chosen'] == '1')
    for name in ('speed', 'delay_speed'):
        assert abs(float(chosen[name]) / abs(velocity) - 1.0) < 0.1
        assert float(chosen[f'sd_{name}']) < 0.25 * abs(velocity)
    assert chosen['trusted'] == 'speed direction time'
    assert abs(abs(float(chosen['delay_heading_deg'])) - (180.0 if velocity < 0.0 else 0.0)) < 1e-9
    assert chosen['no_delay'] == '' and chosen['sd_delay_heading_deg'] == 'nan'
    assert json.loads((tmp_path / 'fits.json').read_text())['fits'][0]['no_delay'] == ''


def test_replay_reports_the_delay_of_the_track(pair, tmp_path, capsys):
    recording, network, velocity = pair
    params = parameter_file(tmp_path / 'params.yaml', QUICK)
    assert main(['replay', recording, '--network', network, '--params', str(params), '--out',
                 str(tmp_path), '--no-figures', '-v']) == 0
    assert 'delay between' in capsys.readouterr().out
    summary = json.loads((tmp_path / 'summary.json').read_text())
    assert summary['frames_too_long'] is None
    (track,) = [t for t in summary['tracks'] if t['poses'] > 10]
    assert abs(track['delay']['speed'] / abs(velocity) - 1.0) < 0.15
    assert isinstance(track['delay']['contradicts'], bool)


def test_commands_warn_of_frames_that_are_too_long(pair, tmp_path, capsys):
    recording, network, _ = pair
    params = parameter_file(tmp_path / 'long.yaml', QUICK | {'align.period_s': 0.08})
    options = ['--network', network, '--params', str(params)]
    assert main(['replay', recording, *options, '--out', str(tmp_path / 'out'),
                 '--no-figures']) == 0
    assert '80 ms' in capsys.readouterr().out
    main(['doctor', recording, *options])
    assert '80 ms' in capsys.readouterr().out
