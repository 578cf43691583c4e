"""Archives: faults are reported, and lost tasks are repeated."""

import contextlib
import errno
import gc
import json
import os
import re
import shutil
import subprocess
import threading
from pathlib import Path

import numpy as np
import psutil
import pytest

from mag_tracking.apps import archive_work, cluster
from mag_tracking.apps.archive import archive, recordings_of
from mag_tracking.cli import main
from mag_tracking.errors import ClusterError, OutputError, RecordingError
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.results.archive_folder import (
    TABLES,
    ArchiveFolder,
    recording_key,
    recording_state,
)
from mag_tracking.results.parquet_table import TableWriter
from support.archives import command, rows, same_tables, wait_for
from support.bundled import NETWORK_FILE, QUICK, vehicle_path
from support.mqtt_broker import free_port

pytestmark = pytest.mark.timeout(900)


def test_the_tasks_of_a_lost_worker_are_repeated(tmp_path, recordings, complete_archive):
    out, runs = tmp_path / 'out', []
    before = {*psutil.Process().children(recursive=True)}
    thread = threading.Thread(daemon=True, target=lambda: runs.append(archive(
        [recordings], NETWORK_FILE, settings_for('vehicle', QUICK), out)))
    thread.start()
    wait_for(lambda: list(out.glob('unfinished/*/cut')))
    # Processes without children are workers; the other processes supervise the workers.
    workers = [p for p in psutil.Process().children(recursive=True) if p not in before
               and not p.children()]
    for worker in workers:
        with contextlib.suppress(psutil.NoSuchProcess):
            if worker.memory_info().rss > 100e6:
                worker.kill()
    thread.join()
    assert len(runs[0].done) == 3 and runs[0].lost_workers >= 1
    assert same_tables(out, complete_archive)


def test_an_incompatible_folder_is_refused(tmp_path, recordings, complete_archive):
    settings = settings_for('vehicle', QUICK)
    paths = [recordings / 'straight_car_right.mcap']
    (tmp_path / 'taken').mkdir()
    (tmp_path / 'taken' / 'photo.jpg').write_text('')
    with pytest.raises(OutputError, match='taken'):
        archive(paths, NETWORK_FILE, settings, tmp_path / 'taken')
    with pytest.raises(OutputError, match='of settings'):
        archive(paths, NETWORK_FILE, settings_for('vehicle'), complete_archive)
    other = tmp_path / 'network.yaml'
    other.write_text(NETWORK_FILE.read_text().replace('4.5', '4.6'))
    with pytest.raises(OutputError, match='of network'):
        archive(paths, other, settings, complete_archive)
    old_archive = tmp_path / 'old'
    shutil.copytree(complete_archive, old_archive)
    metadata = json.loads((old_archive / 'archive.json').read_text())
    (old_archive / 'archive.json').write_text(json.dumps({**metadata, 'schema': 0}))
    with pytest.raises(OutputError, match='version 0.*version 3'):
        archive(paths, NETWORK_FILE, settings, old_archive)
    (old_archive / 'archive.json').write_text('{"schema"')
    with pytest.raises(OutputError, match='cannot read'):
        archive(paths, NETWORK_FILE, settings, old_archive)


def test_a_second_run_into_the_same_folder_is_refused(tmp_path, recordings):
    out, lines = tmp_path / 'out', []
    settings = settings_for('vehicle', QUICK)

    def second_run():
        if not lines:
            with pytest.raises(OutputError, match='another run'):
                archive([recordings], NETWORK_FILE, settings, out)
            lines.append('refused')
        return True
    assert archive([recordings], NETWORK_FILE, settings, out, stopped=second_run).interrupted
    assert lines == ['refused']


def test_a_scheduler_that_does_not_respond_is_reported(tmp_path, recordings, monkeypatch):
    monkeypatch.setattr(cluster, 'CONNECT_TIMEOUT_S', 1.0)
    settings = settings_for('vehicle', QUICK)
    for address in (f'tcp://127.0.0.1:{free_port()}', 'nonsense://x'):
        with pytest.raises(ClusterError, match=address):
            archive([recordings], NETWORK_FILE, settings, tmp_path / 'out', scheduler=address)


def test_a_scheduler_requires_workers(tmp_path, recordings, monkeypatch):
    from distributed import LocalCluster

    settings = settings_for('vehicle', QUICK)
    with LocalCluster(n_workers=0, processes=True, dashboard_address=None,
                      threads_per_worker=1) as local_cluster:
        monkeypatch.setattr(cluster, 'FIRST_WORKER_TIMEOUT_S', 1.0)
        with pytest.raises(ClusterError, match='no workers'):
            archive([recordings], NETWORK_FILE, settings, tmp_path / 'out',
                    scheduler=local_cluster.scheduler_address)
        monkeypatch.undo()
        local_cluster.scale(1)
        local_cluster.wait_for_workers(1)
        run = archive([recordings], NETWORK_FILE, settings, tmp_path / 'out',
                      scheduler=local_cluster.scheduler_address)
        assert len(run.done) == 3


def test_a_scheduler_with_certificates_is_used(tmp_path, recordings, complete_archive):
    from distributed import LocalCluster
    from distributed.security import Security

    certificate, key = str(tmp_path / 'certificate.pem'), str(tmp_path / 'key.pem')
    subprocess.run(['openssl', 'req', '-x509', '-newkey', 'rsa:2048', '-nodes', '-days', '2',
                    '-subj', '/CN=localhost', '-addext', 'subjectAltName=IP:127.0.0.1',
                    '-keyout', key, '-out', certificate], check=True, capture_output=True)
    security = Security(require_encryption=True, tls_ca_file=certificate, **{
        f'tls_{role}_{name}': path for role in ('client', 'scheduler', 'worker')
        for name, path in (('cert', certificate), ('key', key))})
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=True, host='127.0.0.1',
                      protocol='tls://', security=security, dashboard_address='127.0.0.1:0') as tls:
        address = tls.scheduler_address
        assert address.startswith('tls://')
        arguments = command(recordings, tmp_path / 'out', tmp_path, '--scheduler', address)
        refused = subprocess.run(arguments, capture_output=True, text=True)
        names = re.findall(r'DASK_\w+', refused.stderr)
        assert refused.returncode == 1 and 'requires certificates' in refused.stderr
        files = {name: key if name.endswith('KEY') else certificate for name in names}
        finished = subprocess.run(arguments, capture_output=True, text=True,
                                  env=os.environ | files)
    assert 'recordings failed: 1' in finished.stdout, finished.stderr
    assert same_tables(tmp_path / 'out', complete_archive)


def test_a_worker_that_is_lost_during_the_start_is_reported(tmp_path, recordings, monkeypatch):
    (tmp_path / 'sitecustomize.py').write_text(
        "import os, sys\nif '--multiprocessing-fork' in sys.argv: os._exit(1)\n")
    monkeypatch.setenv('PYTHONPATH', f'{tmp_path}:{os.environ.get("PYTHONPATH", "")}')
    with pytest.raises(ClusterError, match='--workers'):
        archive([recordings], NETWORK_FILE, settings_for('vehicle', QUICK), tmp_path / 'out')


def test_a_failed_client_does_not_block_the_next_one(tmp_path, recordings, monkeypatch):
    """Garbage collection of a failed client in Dask's event loop must not cause a deadlock."""
    from distributed import LocalCluster
    from tornado.ioloop import IOLoop

    settings, current = settings_for('vehicle', QUICK), IOLoop.current
    thread_ids: set[int] = set()

    def current_after_collection(*args, **kwargs):
        if threading.get_ident() not in thread_ids:
            thread_ids.add(threading.get_ident())
            gc.collect()
        return current(*args, **kwargs)

    with LocalCluster(n_workers=1, processes=False, dashboard_address=None,
                      threads_per_worker=1) as local_cluster:
        gc.disable()
        try:
            with pytest.raises(ClusterError, match='nonsense://x'):
                archive([recordings], NETWORK_FILE, settings, tmp_path / 'out',
                        scheduler='nonsense://x')
            monkeypatch.setattr(IOLoop, 'current', current_after_collection)
            run = archive([recordings], NETWORK_FILE, settings, tmp_path / 'out',
                          scheduler=local_cluster.scheduler_address)
        finally:
            gc.enable()
        assert len(run.done) == 3


def test_a_run_continues_after_a_full_disk(tmp_path, recordings, complete_archive):
    """A limit on the file size simulates a full disk."""
    out = tmp_path / 'out'
    arguments = command(recordings, out, tmp_path, '--workers', '1')
    completed = subprocess.run(['bash', '-c', 'ulimit -f 30; exec "$@"', '-', *arguments],
                               capture_output=True, text=True)
    assert completed.returncode == 1 and 'mag-tracking: cannot write' in completed.stderr
    assert 'Traceback' not in completed.stderr and not list(out.glob('done/*.json'))
    assert subprocess.run(arguments, capture_output=True).returncode == 1
    assert same_tables(out, complete_archive)


def test_a_table_is_complete_or_missing(tmp_path):
    health = TABLES['health']
    with pytest.raises(RuntimeError), TableWriter(tmp_path / 'a.parquet', health) as table:
        table.add({'stamp_ns': 1})
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='cannot write'):
        TableWriter(tmp_path / 'file' / 'c.parquet', health)


def test_folders_and_patterns_select_recordings(tmp_path, recordings):
    selected = recordings_of([recordings, recordings / 'straight_*.mcap'])
    assert [p.name for p in selected] == ['junction_left_to_right.mcap', 'damaged.mcap',
                                          'straight_car_right.mcap', 'straight_small_left.mcap']
    (tmp_path / 'bag').mkdir()
    shutil.copy(recordings / 'straight_car_right.mcap', tmp_path / 'bag' / 'a_0.mcap')
    (tmp_path / 'bag' / 'metadata.yaml').write_text('')
    assert recordings_of([tmp_path]) == [(tmp_path / 'bag').resolve()]
    for path in (tmp_path / 'none', tmp_path / '*.bag', recordings / 'notes.txt'):
        with pytest.raises(RecordingError, match=re.escape(str(path))):
            recordings_of([path])


def test_invalid_arguments_are_reported(tmp_path, recordings, capsys):
    arguments = ['archive', str(recordings), '--network', str(NETWORK_FILE), '--out',
                 str(tmp_path / 'out')]
    assert main([*arguments, '--workers', '0']) == 1
    assert '--workers: ' in capsys.readouterr().err
    assert main(['archive', str(tmp_path / 'none'), *arguments[2:]]) == 1
    assert str(tmp_path / 'none') in capsys.readouterr().err


def test_a_recording_that_grows_during_tracking_is_tracked_again(tmp_path):
    """A recording may still be in progress while it is archived."""
    path, out, settings = tmp_path / 'a.mcap', tmp_path / 'out', settings_for('vehicle', QUICK)
    data = vehicle_path('straight_car_right').read_bytes()
    path.write_bytes(data[:len(data) // 2])

    def grow():
        if list(out.glob('unfinished/*')):
            path.write_bytes(data)
        return False
    archive([path], NETWORK_FILE, settings, out, stopped=grow)
    second = archive([path], NETWORK_FILE, settings, out)
    assert len(second.done) == 1 and second.tracks == 1
    assert archive([path], NETWORK_FILE, settings, out).tracked_earlier == [path]


def test_leftovers_of_an_earlier_state_of_a_recording_are_discarded(tmp_path):
    """The leftovers are tables and intermediate files of a killed run."""
    path = tmp_path / 'a[1] = ö.mcap'
    shutil.copy(vehicle_path('straight_car_right'), path)
    with ArchiveFolder(tmp_path / 'out', {}) as dataset:
        work = dataset.begin(path, recording_state(path))
        (work / 'cut').mkdir()
        table = tmp_path / 'out' / 'poses' / 'date=2026-01-01' / f'{recording_key(path)}.parquet'
        table.parent.mkdir(parents=True)
        table.write_text('')
        assert dataset.begin(path, recording_state(path)) == work and (work / 'cut').is_dir()
        assert not table.exists()
        shutil.copy(vehicle_path('straight_small_left'), path)
        other = dataset.begin(path, recording_state(path))
        assert other != work and not work.exists() and not list(other.iterdir())


def test_a_recording_that_kills_its_workers_is_the_only_failure(tmp_path, recordings, monkeypatch):
    """A file that terminates its worker simulates a recording that needs too much memory. Other
    tasks that are lost with the worker are repeated."""
    folder = tmp_path / 'recordings'
    folder.mkdir()
    shutil.copy(recordings / 'straight_car_right.mcap', folder / 'good.mcap')
    shutil.copy(recordings / 'straight_car_right.mcap', folder / 'deadly.mcap')
    site = tmp_path / 'site'
    site.mkdir()
    (site / 'sitecustomize.py').write_text(EXIT_ON_DEADLY_FILE)
    monkeypatch.setenv('PYTHONPATH', f'{site}:{os.environ.get("PYTHONPATH", "")}')
    lines = []
    run = archive([folder], NETWORK_FILE, settings_for('vehicle', QUICK), tmp_path / 'out',
                  report=lines.append)
    assert [p.name for p in run.done] == ['good.mcap'] and run.lost_workers >= 1
    assert 'lost' in run.failed[folder / 'deadly.mcap']
    assert len(rows(tmp_path / 'out', 'recordings')) == 2


EXIT_ON_DEADLY_FILE = '''
import builtins, os, sys
if any('spawn' in word for word in sys.argv) or '--multiprocessing-fork' in sys.argv:
    opened = builtins.open
    def guarded(file, *arguments, **named):
        if str(file).endswith('deadly.mcap'):
            os._exit(1)
        return opened(file, *arguments, **named)
    builtins.open = guarded
'''


def test_unusual_file_names_are_archived(tmp_path):
    folder, settings = tmp_path / 'recordings', settings_for('vehicle', QUICK)
    folder.mkdir()
    names = ['n' * 245 + '.mcap', os.fsdecode(b'caf\xe9.mcap'), 'a = b, ü.MCAP']
    for name in names:
        shutil.copy(vehicle_path('straight_car_right'), folder / name)
    run = archive([folder], NETWORK_FILE, settings, tmp_path / 'out')
    assert len(run.done) == 3 and len(rows(tmp_path / 'out', 'tracks')) == 3
    assert 'caf\\udce9' in {row[0] for row in rows(tmp_path / 'out', 'recordings')}


def test_special_files_are_skipped_and_each_recording_is_found_once(tmp_path):
    (tmp_path / 'dangling.mcap').symlink_to('nowhere')
    (tmp_path / 'loop').symlink_to(tmp_path)
    os.mkfifo(tmp_path / 'pipe.mcap')
    bag = tmp_path / 'bag'
    bag.mkdir()
    shutil.copy(vehicle_path('straight_car_right'), bag / 'bag_0.mcap')
    (bag / 'metadata.yaml').write_text('')
    for names in ([tmp_path], [tmp_path / '**'], [bag / '*.mcap', bag], [tmp_path, bag]):
        assert recordings_of(names) == [bag]
    assert recordings_of([bag / '*.mcap']) == [bag / 'bag_0.mcap']


def test_an_empty_recording_has_null_values(tmp_path):
    (tmp_path / 'empty.mcap').write_bytes(
        vehicle_path('straight_car_right').read_bytes()[:500])
    archive([tmp_path], NETWORK_FILE, settings_for('vehicle', QUICK), tmp_path / 'out')
    (row,) = rows(tmp_path / 'out', 'recordings')
    assert row[2:4] == (None, None) and row[4] == ''


@pytest.fixture
def job(tmp_path):
    """Tasks of a bundled recording, of which the first has been executed."""
    job = archive_work.Job(vehicle_path('straight_car_right'), tmp_path / 'work', tmp_path / 'out',
                           read_network(NETWORK_FILE), settings_for('vehicle', QUICK))
    job.work_folder.mkdir()
    archive_work.cut(job)
    return job


def test_damaged_intermediate_results_are_reported(job):
    """A file of Python objects is damaged, too: to read it would execute code."""
    chunk = job.cut_folder / 'segment-0' / '0.npz'
    with np.load(chunk) as arrays:
        content = dict(arrays)
    for damaged in ({'stamp_ns': content['stamp_ns']},
                    content | {'field': np.array([object])},
                    content | {'text': np.array('{"doubts"')}):
        np.savez(chunk, **damaged)
        with pytest.raises(RecordingError, match='0.npz'):
            archive_work.track_segment(job, 0)
    np.savez(chunk, **content)
    archive_work.track_segment(job, 0)
    result = job.segment_folder(0) / 'tracked.json'
    for text in ('', '[]', '{"n_tracks": 1}', result.read_text().replace('rows', 'sensors')
                 .replace('n_passes', 'passes')):
        result.write_text(text)
        with pytest.raises(RecordingError, match='tracked.json'):
            archive_work.join(job)
    (job.cut_folder / 'columns.json').write_text('{"frames": 1}')
    with pytest.raises(RecordingError, match='columns.json'):
        archive_work.cut(job)


def test_a_recording_with_a_damaged_summary_is_tracked_again(
        tmp_path, complete_archive, recordings):
    """If it is not tracked in this run, its row is missing, which is reported."""
    out, settings, lines = tmp_path / 'out', settings_for('vehicle', QUICK), []
    shutil.copytree(complete_archive, out)
    other, path = sorted(out.glob('done/straight_*.json'))
    for summary in (other, path):
        summary.write_text(summary.read_text().replace('"size"', '"sice"'))
    run = archive([recordings / 'straight_small_left.mcap'], NETWORK_FILE, settings, out,
                  report=lines.append)
    assert len(run.done) == 1 and not run.failed and len(rows(out, 'recordings')) == 2
    assert len(lines) == 2 and str(path) in lines[0] and str(other) in lines[1]
    archive([recordings], NETWORK_FILE, settings, out, report=lines.append)
    assert same_tables(out, complete_archive)


@pytest.mark.parametrize('damage', [
    lambda data: b'', lambda data: b'garbage', lambda data: data[:-1], lambda data: b'PAR1'])
def test_a_recording_with_a_damaged_table_is_tracked_again(
        damage, tmp_path, complete_archive, recordings):
    out, lines = tmp_path / 'out', []
    shutil.copytree(complete_archive, out)
    table = next(out.glob('poses/date=*/straight_small_left*.parquet'))
    table.write_bytes(damage(table.read_bytes()))
    run = archive([recordings / '*.mcap'], NETWORK_FILE, settings_for('vehicle', QUICK), out,
                  report=lines.append)
    assert [path.stem for path in run.done] == ['straight_small_left']
    assert str(table) in lines[0] and 'straight_small_left.mcap' in lines[0]
    assert same_tables(out, complete_archive)


@pytest.mark.parametrize('damage', [
    lambda text: '', lambda text: '[' * 100_000, lambda text: text[:len(text) // 2],
    lambda text: '{}', lambda text: '[]',
    lambda text: text.replace('"size": ', '"size": null, "_": '),
    lambda text: text.replace('"tracks": ', '"tracks": 9e99, "_": '),
    lambda text: text.replace('"frames": ', '"frames": 9223372036854775808, "_": '),
    lambda text: text.replace('"error": ""', '"error": null')])
def test_damaged_summaries_are_named(tmp_path, complete_archive, damage):
    shutil.copytree(complete_archive / 'done', tmp_path / 'done')
    path, *others = sorted(tmp_path.glob('done/*.json'))
    recording = Path(json.loads(path.read_text())['source'])
    path.write_text(damage(path.read_text()))
    (tmp_path / 'archive.json').write_text('{"schema": 3}')
    lines = []
    with ArchiveFolder(tmp_path, {}) as dataset:
        with pytest.raises(OutputError, match=path.name):
            dataset.done(recording)
        assert len(list(dataset.summaries(lines.append))) == len(others) == 2
    assert len(lines) == 1 and path.name in lines[0]


def test_a_full_disk_is_reported_even_if_the_file_has_been_created(job, monkeypatch):
    def no_space(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(os, 'fsync', no_space)
    with pytest.raises(OutputError, match='No space'):
        archive_work.track_segment(job, 0)
