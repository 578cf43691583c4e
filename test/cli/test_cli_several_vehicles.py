"""`fit` of a recording in which two vehicles pass at the same time."""

import csv
import json

import numpy as np

from mag_tracking.cli import main
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.file import write_network
from mag_tracking.recording.writer import RecordingWriter
from support.busy_worlds import busy
from support.samples import sample_dict, samples_of


def test_fit_writes_rows_and_a_figure_of_each_vehicle(tmp_path, capsys):
    a_world = busy('meeting', 2, 'clouds', 3, n=1)
    with RecordingWriter(tmp_path / 'pair.mcap') as writer:
        for s in samples_of(a_world.readings):
            writer.write(f'/{s.sensor}/imu/mag', MAGNETIC_FIELD, sample_dict(s, s.sensor),
                         s.stamp_ns)
    write_network(tmp_path / 'network.yaml', a_world.network)
    out = tmp_path / 'fits'
    assert main(['fit', str(tmp_path / 'pair.mcap'), '--network', str(tmp_path / 'network.yaml'),
                 '--orders', '1', '2', '-v', '--out', str(out)]) == 0
    output = capsys.readouterr().out
    assert 'pair, pass 1, vehicle 1:' in output and 'pair, pass 1, vehicle 2:' in output
    assert output.count('2 vehicles were') == 2
    with open(out / 'fits.csv', encoding='utf-8') as stream:
        rows = list(csv.DictReader(stream))
    assert [(r['pass'], r['vehicle'], r['n_vehicles'], r['n_dipoles']) for r in rows] == [
        ('1', '1', '2', '1'), ('1', '1', '2', '2'), ('1', '2', '2', '1'), ('1', '2', '2', '2')]
    chosen = [r for r in rows if r['chosen'] == '1']
    assert np.prod([float(r['vx']) for r in chosen]) < 0.0 and len(chosen) == 2
    assert len(json.loads((out / 'fits.json').read_text())['fits']) == 4
    assert {p.name for p in out.glob('*.png')} == {
        'pair_pass_1_vehicle_1.png', 'pair_pass_1_vehicle_2.png', 'orders.png'}
    assert 'pass 1, vehicle 2' in (out / 'report.html').read_text()
