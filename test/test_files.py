"""Output files are newly created; an existing link or pipe of the same name is replaced."""

import os

import pytest
from matplotlib.figure import Figure

import mag_tracking as mt
from mag_tracking.apps.replay import replay
from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import checked_path, new_binary_file, new_text_file, output_folder
from mag_tracking.network.file import read_network, write_network
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.background_file import write_backgrounds
from mag_tracking.recording.field_table import TableOptions, read_field_table
from mag_tracking.recording.pose_table import read_readings
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.recorder import Recorder
from mag_tracking.recording.repair import repair
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.report.style import save_figure
from mag_tracking.results.fit_folder import FitFolder
from mag_tracking.results.result_folder import ResultFolder
from mag_tracking.results.traffic_tables import write_events
from mag_tracking.settings import read_parameter_file
from support.bundled import vehicle_path
from support.networks import line_network


def write_results(out):
    with ResultFolder(out, line_network(2)) as results:
        results.write_summary({})


def write_fits(out):
    with FitFolder(out):
        pass


def write_recording(out):
    with RecordingWriter(out / 'a.mcap'):
        pass


def write_figures(out):
    for suffix in ('png', 'PNG', 'svg'):
        save_figure(Figure(), out / f'a.{suffix}')


@pytest.mark.parametrize('write, extra_names', [
    (write_results, ()), (write_fits, ()), (write_recording, ()), (write_figures, ()),
    (lambda out: write_events(out, []), ()),
    (lambda out: write_network(out / 'n.yaml', line_network(2)), ()),
    (lambda out: write_backgrounds(out / 'b.json', {}), ())])
def test_results_are_not_written_through_a_symbolic_link(tmp_path, write, extra_names):
    (tmp_path / 'new').mkdir()
    write(tmp_path / 'new')
    names = sorted(path.name for path in (tmp_path / 'new').iterdir())
    out, targets = tmp_path / 'out', tmp_path / 'theirs'
    out.mkdir()
    targets.mkdir()
    for name in (*names, *extra_names):
        # A recording is only replaced if `metadata.yaml` lists its name.
        (targets / name).write_text('- a.mcap\n- tracks.mcap\n')
        (out / name).symlink_to(targets / name)
    write(out)
    assert sorted(path.name for path in out.iterdir()) == names
    assert not any(path.is_symlink() for path in out.iterdir())
    assert {path.read_text() for path in targets.iterdir()} == {'- a.mcap\n- tracks.mcap\n'}


@pytest.mark.parametrize('create_file', [new_text_file, new_binary_file])
def test_a_new_file_replaces_a_link_or_pipe_of_its_name(tmp_path, create_file):
    path, other = tmp_path / 'a', tmp_path / 'other'
    other.write_text('theirs')
    for create in (lambda: path.symlink_to(other), lambda: path.symlink_to(tmp_path / 'nowhere'),
                   lambda: path.hardlink_to(other), lambda: os.mkfifo(path), lambda: None):
        path.unlink(missing_ok=True)
        create()
        with create_file(path) as stream:
            stream.write('' if create_file is new_text_file else b'')
        assert path.is_file() and not path.is_symlink() and path.stat().st_size == 0
        assert other.read_text() == 'theirs' and sorted(tmp_path.iterdir()) == [path, other]


def test_a_line_can_be_read_as_soon_as_it_is_flushed(tmp_path):
    with new_text_file(tmp_path / 'a') as stream:
        stream.write('row\n')
        stream.flush()
        assert (tmp_path / 'a').read_text() == 'row\n'


def test_unpaired_surrogates_are_escaped(tmp_path):
    with new_text_file(tmp_path / 'a') as stream:
        stream.write('\udcff\u00e4')
    assert (tmp_path / 'a').read_text(encoding='utf-8') == '\\udcff\u00e4'


def test_a_folder_of_the_same_name_is_refused(tmp_path):
    (tmp_path / 'a').mkdir()
    with pytest.raises(OSError, match='directory'):
        new_text_file(tmp_path / 'a')
    for name in ('poses.csv', 'tracks.mcap'):
        (tmp_path / name / name).mkdir(parents=True)
        with pytest.raises(OutputError, match='directory'):
            ResultFolder(tmp_path / name, line_network(2))


def test_a_path_with_a_nul_character_is_refused(tmp_path):
    message = r"'a\\x00b.* is not a valid path: it contains a NUL character"
    with pytest.raises(RecordingError, match=message):
        checked_path('a\0b', RecordingError)
    for write in (output_folder, new_text_file, lambda path: write_events(path, []),
                  RecordingWriter, FitFolder, Recorder,
                  lambda path: write_network(path, line_network(2)),
                  lambda path: replay(Recording(vehicle_path('straight_car_right')),
                                      line_network(2), settings_for('vehicle'), path)):
        with pytest.raises(OutputError, match=message):
            write('a\0b')
    for read in (read_network, read_parameter_file, Recording, repair, read_readings,
                 lambda path: mt.track(path, line_network(2)),
                 lambda path: read_field_table(path, TableOptions())):
        with pytest.raises(mt.MagTrackingError, match=message):
            read('a\0b')
