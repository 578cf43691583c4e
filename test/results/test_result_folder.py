"""Result folder of a run: it replaces the results of an earlier run, and keeps other files."""

import csv

import numpy as np
import pytest

from mag_tracking.apps.replay import replay
from mag_tracking.errors import OutputError
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.recording import core
from mag_tracking.recording.reader import Recording
from mag_tracking.results.result_folder import ResultFolder, figure_name
from support.bundled import NETWORK_FILE, QUICK, vehicle_path
from support.networks import line_network


def write(out):
    """Write a summary; return whether results of an earlier run were replaced."""
    with ResultFolder(out, line_network(2)) as results:
        results.write_summary({})
    return results.replaces_earlier


def test_results_of_an_earlier_run_are_replaced(tmp_path):
    out = tmp_path / 'out'
    assert not write(out)
    names = {path.name for path in out.iterdir()}
    figures = {figure_name(kind, 12) for kind in ('map', 'weights', 'field')}
    others = {'map_track_1.pdf', 'my_map_track_1.png', 'map_track_1.png.txt', 'map_track_x.png',
              'notes.txt', 'network.yaml'}
    for name in figures | others:
        (out / name).write_text('earlier')
    (out / 'map_track_2.png').mkdir()
    assert write(out)
    assert {path.name for path in out.iterdir()} == names | others | {'map_track_2.png'}
    assert {(out / name).read_text() for name in others} == {'earlier'}


@pytest.mark.parametrize('name', ['poses.csv', 'summary.json', 'tracks.mcap', 'map_track_3.png'])
def test_one_result_file_identifies_an_earlier_run(tmp_path, name):
    (tmp_path / name).symlink_to('nowhere')
    assert write(tmp_path) and not (tmp_path / name).is_symlink()


def test_an_unfinished_run_has_no_summary_of_an_earlier_run(tmp_path):
    write(tmp_path)
    with ResultFolder(tmp_path, line_network(2)):
        assert not (tmp_path / 'summary.json').exists()
        assert not (tmp_path / 'metadata.yaml').exists()


def test_a_folder_with_another_recording_is_refused(tmp_path):
    (tmp_path / 'metadata.yaml').write_text('- theirs.mcap\n')
    (tmp_path / 'poses.csv').write_text('theirs')
    with pytest.raises(OutputError, match='another recording'):
        ResultFolder(tmp_path, line_network(2))
    assert (tmp_path / 'poses.csv').read_text() == 'theirs'
    assert len(list(tmp_path.iterdir())) == 2


NUMBERS = [0.0, -0.0, 1.0, 1e5, 1e-5, 0.1, -2.5e-17, 1e22, 5e-324, 1.7976931348623157e308, np.inf,
           -np.inf, np.nan, 123456789.12345678]


def test_rows_of_numbers_are_read_back_exactly():
    values = np.array(NUMBERS).reshape(2, -1)
    rows = core.number_rows(values)
    back = np.array([[float(text) for text in row.split(',')] for row in rows])
    np.testing.assert_array_equal(back, values)
    np.testing.assert_array_equal(np.signbit(back), np.signbit(values))
    assert core.number_rows(np.zeros((0, 3))) == [] and core.number_rows(np.zeros((1, 0))) == ['']


def test_arrival_names_may_contain_commas(tmp_path):
    names = ('from "A", left', 'right', 'rear')
    settings = settings_for('vehicle', {**QUICK, 'track.vehicle.arrival_names': names})
    replay(Recording(vehicle_path('straight_car_right')), read_network(NETWORK_FILE), settings,
           tmp_path)
    with open(tmp_path / 'hypotheses.csv', newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert names[0] in {row['arrival'] for row in rows} <= {*names}
    # The hypothesis with the largest weight in the last frame is near the published pose.
    with open(tmp_path / 'poses.csv', newline='') as stream:
        *_, pose = csv.DictReader(stream)
    best = max((row for row in rows if row['stamp_ns'] == pose['stamp_ns']),
               key=lambda row: float(row['weight']))
    assert abs(float(best['x']) - float(pose['x'])) < 3.0 * float(pose['sd_x'])
