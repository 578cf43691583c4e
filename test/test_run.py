"""The loop of all runs: sinks that fail, and the last stage."""

import errno
import json

import pytest

from mag_tracking.apps.readings import source_of
from mag_tracking.apps.traffic import EventSink, TrafficSink
from mag_tracking.cli import main
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.pipeline import STAGES, Pipeline, settings_for
from mag_tracking.records import Readings
from mag_tracking.results.result_folder import ResultFolder
from mag_tracking.run import run
from support.bundled import NETWORK_FILE, QUICK, vehicle_path

PATH = vehicle_path('straight_car_right')
OPTIONS = ['--network', str(NETWORK_FILE)]


class FailingSink:
    """Sink that fails at a step."""

    folder = 'some/folder'

    def __init__(self, error, step=5):
        self.error, self.step, self.n = error, step, 0

    def add(self, step):
        self.n += 1
        if self.n == self.step:
            raise self.error


@pytest.mark.parametrize('error', [OutputError('full'), OSError(errno.ENOSPC, 'full')])
def test_a_sink_that_fails_does_not_stop_the_others(road_network, error):
    pipeline = Pipeline(road_network, settings_for('vehicle', QUICK))
    failing, traffic, events = FailingSink(error), TrafficSink(pipeline), EventSink(pipeline)
    report = run(source_of(PATH, road_network), pipeline, [failing, traffic, events])
    assert failing.n == 5 and [f.sink for f in report.failures] == [failing]
    assert report.has_failed(failing) and not report.has_failed(traffic)
    assert any('full' in line for line in report.warnings())
    assert len(traffic.result(report).vehicles) == 1 and len(events.result(report).events) == 2


def test_a_run_ends_if_all_sinks_have_failed(road_network):
    sink = FailingSink(OSError(errno.ENOSPC, 'full'), step=2)
    with pytest.raises(OutputError, match='some/folder: full'):
        run(source_of(PATH, road_network), Pipeline(road_network, settings_for('vehicle')), [sink])
    assert sink.n == 2


def full_disk(*_):
    raise OSError(errno.ENOSPC, 'No space left on device')


@pytest.mark.parametrize('method', ['add_track', 'write_summary'])
def test_a_full_disk_is_named_and_leaves_the_other_tables(tmp_path, monkeypatch, capsys, method):
    monkeypatch.setattr(ResultFolder, method, full_disk)
    assert main(['replay', str(PATH), *OPTIONS, '--tables', 'poses,passages,events', '--out',
                 str(tmp_path), '--no-figures']) == 1
    assert str(tmp_path) in capsys.readouterr().err
    assert len((tmp_path / 'passages.csv').read_text().splitlines()) == 2
    assert len((tmp_path / 'events.csv').read_text().splitlines()) == 3
    if method == 'add_track':
        assert json.loads((tmp_path / 'summary.json').read_text())['not_written']


def test_a_table_whose_sink_failed_is_not_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(TrafficSink, 'add_passage', full_disk)
    assert main(['replay', str(PATH), *OPTIONS, '--tables', 'passages,events', '--out',
                 str(tmp_path)]) == 1
    assert 'No space' in capsys.readouterr().err
    assert not (tmp_path / 'passages.csv').exists() and (tmp_path / 'events.csv').exists()


@pytest.mark.parametrize('upto', STAGES)
def test_a_pipeline_ends_with_the_stage_that_is_asked_for(road_network, upto):
    pipeline = Pipeline(road_network, settings_for('vehicle', QUICK), upto)
    report = run(source_of(PATH, road_network), pipeline, [])
    assert list(report.counts) == list(STAGES[:STAGES.index(upto) + 1])


def test_an_unknown_stage_is_refused(road_network):
    with pytest.raises(SettingsError, match="'tracks'"):
        Pipeline(road_network, settings_for('vehicle'), 'tracks')


def test_calibrated_readings_precede_their_frames(road_network):
    pipeline = Pipeline(road_network, settings_for('vehicle', QUICK), 'align')
    source, kinds = source_of(PATH, road_network), []

    class Kinds:
        def add(self, step):
            kinds.extend(type(record) for record in step.records)

    run(source, pipeline, [Kinds()])
    assert kinds[0] is Readings and len(set(kinds)) == 2
