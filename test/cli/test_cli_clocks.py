"""`replay` reports a clock error; the reported offset, set in the network file, corrects it."""

import json
import re

import numpy as np
import pytest

from mag_tracking.cli import main
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.recording.writer import RecordingWriter
from support import spoiler
from support.bundled import QUICK, parameter_file
from support.samples import sample_dict, samples_of
from support.situation_worlds import ambient_world

NETWORK = '''earth_field: [2.0e-6, 1.55e-5, -4.9e-5]
sensors:
  mag_1: {{position: [0.0, -4.5, 0.0]}}
  mag_2: {{position: [0.0, 4.5, 0.0], clock_offset: {}}}
'''


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """Recording of three cars and two sensors; the clock of mag_2 is 0.2 s ahead."""
    a_world = ambient_world(np.random.default_rng(5), 'boxes', None, 75.0, cars=3)
    path = tmp_path_factory.mktemp('clocks') / 'cars.mcap'
    with RecordingWriter(path) as writer:
        for s in samples_of(spoiler.apply(a_world.readings, spoiler.delayed('mag_2', 0.2))):
            writer.write(f'/{s.sensor}/imu/mag', MAGNETIC_FIELD, sample_dict(s, s.sensor),
                         s.stamp_ns)
    return str(path)


def replay(recording, folder, offset, capsys):
    """Replay with a `clock_offset` [s] of mag_2; return (output, summary)."""
    folder.mkdir()
    (folder / 'network.yaml').write_text(NETWORK.format(offset))
    params = parameter_file(folder / 'params.yaml', QUICK)
    assert main(['replay', recording, '--network', str(folder / 'network.yaml'), '--params',
                 str(params), '--out', str(folder / 'out'), '--no-figures']) == 0
    return capsys.readouterr().out, json.loads((folder / 'out' / 'summary.json').read_text())


def test_the_reported_offset_corrects_the_clock(recording, tmp_path, capsys):
    output, summary = replay(recording, tmp_path / 'wrong', 0.0, capsys)
    assert f'warning: {summary["clocks_apart"]}' in output
    assert 'of mag_2' in output and 'clocks_apart' in summary['tracks'][-1]['doubts']
    offset = float(re.search(r'increase clock_offset of mag_2 by (\S+) s', output).group(1))
    assert offset == pytest.approx(0.2, abs=0.05)
    output, summary = replay(recording, tmp_path / 'right', offset, capsys)
    assert summary['clocks_apart'] == '' and 'the clock' not in output
    assert not any('clocks_apart' in t['doubts'] for t in summary['tracks'])
