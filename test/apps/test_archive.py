"""Archives: agreement with a replay, resumed runs, and invalid recordings."""

import contextlib
import os
import shutil
import signal
import subprocess

import duckdb
import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest

import mag_tracking as mt
from mag_tracking.apps import archive_segments, archive_work
from mag_tracking.apps.archive import archive
from mag_tracking.apps.archive_segments import SegmentWriter, read_segment
from mag_tracking.apps.archive_work import Job, cut, join, track_segment
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.records import FieldFrame
from mag_tracking.results.archive_folder import TABLES, common_columns, join_tables
from mag_tracking.results.parquet_table import TableWriter
from mag_tracking.stages.track.doubts import CLOCKS_APART
from support.archives import command, rows, same_tables, wait_for
from support.bundled import DATA, NETWORK_FILE, QUICK

pytestmark = pytest.mark.timeout(900)

NETWORK = read_network(NETWORK_FILE)
ROAD = DATA / 'two_way_road' / 'two_way_road.mcap'


@pytest.fixture(scope='module')
def road_network_file(tmp_path_factory):
    """Network file of the two-way road, with a larger distance between the sensors."""
    path = tmp_path_factory.mktemp('road') / 'network.yaml'
    path.write_text(NETWORK_FILE.read_text().replace('4.5', '5.5'))
    return path


def archive_without_cluster(folder, recording, network, settings, in_order=True):
    """Archive a recording without a cluster; return (columns of its row, number of segments).

    With `in_order` False, the segments are tracked in reverse order.
    """
    work = folder / 'unfinished'
    work.mkdir(parents=True)
    job = Job(recording, work, folder, network, settings)
    segments = range(cut(job)['segments'])
    for k in segments if in_order else reversed(segments):
        track_segment(job, k)
    return join(job), len(segments)


def assert_rows_of_replay(folder, result):
    """Assert that the tables in `folder` contain the poses and tracks of a replay in its order."""
    for table, poses in (('poses', result.poses),
                         ('smoothed', result.smoothed[result.smoothed['complete']])):
        files = pq.read_table(folder / table).to_pandas()
        np.testing.assert_array_equal(files[['stamp_ns', 'track_id']].values,
                                      np.array([poses['stamp_ns'], poses['track_id']]).T)
        np.testing.assert_array_equal(files[['x', 'y', 'z']].values, poses['position'])
        np.testing.assert_array_equal(np.stack(files['covariance']).reshape(-1, 6, 6),
                                      poses['covariance'])
        np.testing.assert_array_equal(files['ambiguous'].values, poses['ambiguous'])
        if table == 'poses':
            assert files['doubts'].tolist() == poses['doubts'].tolist()
    tracks = pq.read_table(folder / 'tracks').to_pylist()
    assert [t['track_id'] for t in tracks] == list(result.tracks)
    for row, log in zip(tracks, result.tracks.values(), strict=True):
        summary = log.summary()
        assert {n: row[n] for n in ('poses', 'arrival', 'speed', 'verdict', 'end_ns')} \
            == {n: summary[n] for n in ('poses', 'arrival', 'speed', 'verdict', 'end_ns')}


def test_a_recording_in_segments_gives_the_rows_of_a_replay(
        tmp_path, monkeypatch, road_network_file):
    monkeypatch.setattr(archive_segments, 'MIN_SEGMENT_FRAMES', 60)
    monkeypatch.setattr(archive_segments, 'CHUNK_FRAMES', 50)
    settings, network = settings_for('vehicle', QUICK), read_network(road_network_file)
    columns, n = archive_without_cluster(tmp_path, ROAD, network, settings, in_order=False)
    result = mt.track(ROAD, network, settings=QUICK)
    assert n > 8 and columns['tracks'] == len(result.tracks) >= 20
    assert columns['passes'] == pq.read_table(tmp_path / 'passes').num_rows >= 20
    assert_rows_of_replay(tmp_path, result)


@pytest.mark.study
@pytest.mark.parametrize('ahead_s', [0.0, 0.2])
def test_clock_differences_carry_over_between_segments(
        tmp_path, monkeypatch, road_network_file, ahead_s):
    """If clocks differ, the doubts of a track depend on passes in earlier segments."""
    monkeypatch.setattr(archive_segments, 'MIN_SEGMENT_FRAMES', 60)
    path = tmp_path / 'network.yaml'
    text = road_network_file.read_text()
    path.write_text(text.replace('mag_2:', f'mag_2:\n    clock_offset: {ahead_s}'))
    network = read_network(path)
    assert network.clock_offset.tolist() == [0.0, ahead_s]
    calls, manager = [], archive_work.TrackManager
    monkeypatch.setattr(archive_work, 'TrackManager', lambda *a: calls.append(a) or manager(*a))
    _, n = archive_without_cluster(tmp_path / 'archive', ROAD, network, settings_for('vehicle'))
    result = mt.track(ROAD, network)
    assert_rows_of_replay(tmp_path / 'archive', result)
    # Segments whose tracks depend on earlier segments were tracked a second time.
    assert n > 1 and (len(calls) > n) == bool(ahead_s)
    assert any(CLOCKS_APART in d for d in result.poses['doubts']) == bool(ahead_s)


def test_an_archive_contains_all_valid_recordings(tmp_path, recordings, capsys):
    """The invalid recording is reported and skipped. A second run changes nothing."""
    out, lines = tmp_path / 'out', []
    settings = settings_for('vehicle', QUICK)
    run = archive([recordings], NETWORK_FILE, settings, out, workers=2, report=lines.append)
    damaged = (recordings / 'damaged.mcap').resolve()
    assert len(run.done) == 3 and list(run.failed) == [damaged] and not run.interrupted
    assert len(lines) == 1 and f'damaged.mcap: {damaged} ' in lines[0]
    assert [p.name[:7] for p in (out / 'unfinished').iterdir()] == ['damaged']
    for path in run.done:
        result = mt.track(path, NETWORK_FILE, settings=QUICK)
        poses = pq.read_table(out / 'poses', filters=[('source', '=', str(path))]).to_pandas()
        np.testing.assert_array_equal(poses.sort_values('stamp_ns')[['x', 'y']].values,
                                      result.poses['position'][:, :2])
    row_of = {row[1]: row for row in rows(out, 'recordings')}
    assert len(row_of) == 4 and 'damaged.mcap' in row_of[str(damaged)][4]
    sensors = duckdb.sql(f"SELECT DISTINCT sensor, accepted > 500, noise_x BETWEEN 1e-9 AND 1e-7 "
                         f"FROM read_parquet('{out}/health/**/*.parquet') ORDER BY 1").fetchall()
    assert sensors == [('mag_1', True, True), ('mag_2', True, True)]

    mtimes = {p: p.stat().st_mtime_ns for p in out.rglob('*-*.parquet')}
    second = archive([recordings / '*.mcap', recordings / 'below'], NETWORK_FILE, settings, out)
    assert sorted(second.tracked_earlier) == sorted(run.done) and not second.done
    assert {p: p.stat().st_mtime_ns for p in out.rglob('*-*.parquet')} == mtimes
    assert len(rows(out, 'recordings')) == 4


def test_a_recording_that_changed_is_tracked_again(tmp_path, recordings):
    copy, settings = tmp_path / 'copy', settings_for('vehicle', QUICK)
    copy.mkdir()
    shutil.copy(recordings / 'straight_car_right.mcap', copy / 'a.mcap')
    archive([copy], NETWORK_FILE, settings, tmp_path / 'out')
    before = rows(tmp_path / 'out', 'poses')
    shutil.copy(recordings / 'straight_small_left.mcap', copy / 'a.mcap')
    run = archive([copy], NETWORK_FILE, settings, tmp_path / 'out')
    after = rows(tmp_path / 'out', 'poses')
    assert len(run.done) == 1 and before and after and not any(row in before for row in after)
    assert len(rows(tmp_path / 'out', 'recordings')) == 1


def test_a_stopped_run_continues(tmp_path, recordings, complete_archive):
    out, settings = tmp_path / 'out', settings_for('vehicle', QUICK)
    sizes = []
    first = archive([recordings], NETWORK_FILE, settings, out, progress=sizes.append,
                    stopped=lambda: bool(sizes))
    assert first.interrupted and 1 <= len(first.done) < 3
    second = archive([recordings], NETWORK_FILE, settings, out)
    assert not second.interrupted and len(second.done) + len(first.done) == 3
    assert sorted(second.tracked_earlier) == sorted(first.done)
    assert same_tables(out, complete_archive)


def test_a_killed_run_continues(tmp_path, recordings, complete_archive):
    out = tmp_path / 'out'
    arguments = command(recordings, out, tmp_path, '--workers', '1')
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    wait_for(lambda: list(out.glob('done/*.json')))
    for child in psutil.Process(process.pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            child.kill()
    process.kill()
    process.communicate()
    finished = subprocess.run(arguments, capture_output=True, text=True)
    assert finished.returncode == 1 and 'recordings failed: 1' in finished.stdout, finished.stderr
    assert same_tables(out, complete_archive)


def test_ctrl_c_ends_the_command_with_a_hint_to_continue(tmp_path, recordings):
    out = tmp_path / 'out'
    process = subprocess.Popen(command(recordings, out, tmp_path, '--workers', '1'),
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               start_new_session=True)
    wait_for(lambda: list(out.glob('unfinished/*/.*.cut')))
    # A terminal sends Ctrl-C to the whole process group.
    os.killpg(process.pid, signal.SIGINT)
    text, errors = process.communicate()
    assert process.returncode == 130 and 'to continue' in text, errors
    assert 'Traceback' not in errors


def frames(*segments):
    """Frames at 10 Hz in consecutive intervals (duration [s], whether a target is present)."""
    out = []
    for seconds, present in segments:
        for _ in range(round(10 * seconds)):
            out.append(FieldFrame(len(out) * 100_000_000, np.zeros((1, 3)), np.eye(3)[None],
                                  np.ones(1, dtype=np.int64), np.zeros(1), present))
    return out


@pytest.mark.parametrize('quiet_s, n', [(0.5, 1), (2.5, 1), (3.5, 2), (30.0, 2)])
def test_quiet_intervals_longer_than_the_lookback_separate_segments(
        tmp_path, monkeypatch, quiet_s, n):
    monkeypatch.setattr(archive_segments, 'MIN_SEGMENT_FRAMES', 10)
    monkeypatch.setattr(archive_segments, 'CHUNK_FRAMES', 7)
    all_frames = frames((20.0, False), (2.0, True), (quiet_s, False), (2.0, True), (9.0, False))
    writer = SegmentWriter(tmp_path, 3.0)
    for frame in all_frames:
        writer.add_frame(frame, {})
    writer.close()
    assert writer.n_segments == n
    for k in range(n):
        stored = [frame for chunk in read_segment(tmp_path / f'segment-{k}', NETWORK)
                  for frame, _ in chunk.frames()]
        first = next(i for i, frame in enumerate(stored) if frame.target_present)
        # The segment contains all frames that a new track may use, and the frame that ends it.
        assert stored[first].stamp_ns - stored[0].stamp_ns in (3_000_000_000, 3_100_000_000)
        assert not stored[-1].target_present
    assert max(len(chunk.stamp_ns) for k in range(n) for chunk in read_segment(
        tmp_path / f'segment-{k}', NETWORK)) <= 7 + 31


def test_a_backward_time_jump_between_segments_loses_no_frames(tmp_path):
    writer = SegmentWriter(tmp_path, 3.0)
    for frame in frames((60.0, False)) + frames((60.0, False), (2.0, True), (9.0, False)):
        writer.add_frame(frame, {})
    writer.close()
    stored = [frame for chunk in read_segment(tmp_path / 'segment-0', NETWORK)
              for frame, _ in chunk.frames()]
    assert len(stored) == 31 + 20 + 1
    assert not (tmp_path / 'segment-1').exists()


def test_doubts_are_stored_with_the_frames_of_a_segment(tmp_path):
    """Doubts are stored at the start of each segment and whenever they change."""
    writer = SegmentWriter(tmp_path, 3.0)
    first, second = ({'doubtful_background': {'mag_1': ((1, end),)}} for end in (None, 5))
    for k, frame in enumerate(frames((5.0, False), (2.0, True), (9.0, False))):
        writer.add_frame(frame, first if k < 60 else second)
    writer.close()
    stored = [(frame.stamp_ns, doubts) for chunk in read_segment(tmp_path / 'segment-0', NETWORK)
              for frame, doubts in chunk.frames() if doubts is not None]
    assert [doubts for _, doubts in stored] == [first, second]
    assert stored[0][0] < 5_000_000_000 and stored[1][0] == 6_000_000_000


def test_rows_are_partitioned_by_day_and_unknown_values_are_null(complete_archive):
    for path in complete_archive.rglob('*-*.parquet'):
        table = pq.read_table(path, partitioning=None)
        days = {str(t.date()) for t in table['time'].to_pandas()}
        assert days == {path.parent.name.removeprefix('date=')}
        for name, kind in zip(table.schema.names, table.schema.types, strict=True):
            if str(kind) == 'double':
                assert not np.isnan(table[name].drop_null().to_numpy()).any(), (path, name)


def test_a_recording_over_midnight_is_split_into_two_days(tmp_path):
    midnight = 20_000 * 86_400 * 10**9
    with TableWriter(tmp_path / 'part.parquet', TABLES['health']) as table:
        for k in (-2, -1, 0, 1):
            table.add({**common_columns(tmp_path / 'a.mcap', midnight + k), 'sensor': 'mag_1'})
    assert join_tables([tmp_path / 'part.parquet'], [0], 'health', tmp_path, 'a') == 4
    assert {p.parent.name: pq.read_table(p, partitioning=None).num_rows
            for p in tmp_path.glob('health/*/a.parquet')} == {
        'date=2024-10-03': 2, 'date=2024-10-04': 2}
