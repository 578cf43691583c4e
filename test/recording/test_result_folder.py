"""The folder of one run: results of an earlier one are replaced, and nothing else."""

import pytest

from mag_tracking.errors import OutputError
from mag_tracking.recording.result_folder import ResultFolder, figure_name
from support.networks import line_network


def write(out):
    """Whether it took the place of an earlier run."""
    with ResultFolder(out, line_network(2)) as results:
        results.write_summary({})
    return results.replaces_earlier


def test_what_an_earlier_run_left_is_replaced(tmp_path):
    out = tmp_path / 'out'
    assert not write(out)
    names = {path.name for path in out.iterdir()}
    figures = {figure_name(kind, 12) for kind in ('map', 'weights', 'field')}
    theirs = {'map_track_1.pdf', 'my_map_track_1.png', 'map_track_1.png.txt', 'map_track_x.png',
              'notes.txt', 'network.yaml'}
    for name in figures | theirs:
        (out / name).write_text('earlier')
    (out / 'map_track_2.png').mkdir()
    assert write(out)
    assert {path.name for path in out.iterdir()} == names | theirs | {'map_track_2.png'}
    assert {(out / name).read_text() for name in theirs} == {'earlier'}


@pytest.mark.parametrize('name', ['poses.csv', 'summary.json', 'tracks.mcap', 'map_track_3.png'])
def test_one_file_is_an_earlier_run(tmp_path, name):
    (tmp_path / name).symlink_to('nowhere')
    assert write(tmp_path) and not (tmp_path / name).is_symlink()


def test_a_run_that_was_killed_has_no_summary_of_the_one_before(tmp_path):
    write(tmp_path)
    with ResultFolder(tmp_path, line_network(2)):
        assert not (tmp_path / 'summary.json').exists()
        assert not (tmp_path / 'metadata.yaml').exists()


def test_another_recording_is_left_as_it_is(tmp_path):
    (tmp_path / 'metadata.yaml').write_text('- theirs.mcap\n')
    (tmp_path / 'poses.csv').write_text('theirs')
    with pytest.raises(OutputError, match='another recording'):
        ResultFolder(tmp_path, line_network(2))
    assert (tmp_path / 'poses.csv').read_text() == 'theirs'
    assert len(list(tmp_path.iterdir())) == 2
