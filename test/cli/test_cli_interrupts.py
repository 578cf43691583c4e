"""Interrupted commands keep finished results; a repeated signal ends them immediately."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from mag_tracking.cli import main
from support.bundled import NETWORK_FILE, vehicle_path
from support.cli_runs import NAME, quick_file, replay_one


def test_an_interrupted_replay_keeps_finished_results(tmp_path):
    out = tmp_path / 'out'
    recordings = [tmp_path / f'{NAME}_{k}.mcap' for k in range(40)]
    for path in recordings:
        path.write_bytes(vehicle_path(NAME).read_bytes())
    process = subprocess.Popen(
        [sys.executable, '-m', 'mag_tracking.cli', 'replay', *map(str, recordings), '--network',
         str(NETWORK_FILE), '--params', str(quick_file(tmp_path)), '--out', str(out),
         '--no-figures'],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    table = out / f'{NAME}_0' / 'summary.json'
    deadline = time.monotonic() + 120
    while not table.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=120)
    assert process.returncode == 130, stderr
    assert 'Traceback' not in stderr
    assert json.loads(table.read_text())['recording'] == f'{NAME}_0.mcap'


def interrupt_feed(monkeypatch, at):
    """Interrupt the pipeline at batch number `at`; return the list of batches fed."""
    from mag_tracking.pipeline import Pipeline
    feed, calls = Pipeline.feed, []

    def interrupted(self, readings):
        calls.append(readings)
        if len(calls) == at:
            signal.raise_signal(signal.SIGINT)
        return feed(self, readings)

    monkeypatch.setattr(Pipeline, 'feed', interrupted)
    return calls


def summary_of(out):
    return json.loads((out / 'summary.json').read_text())


def test_an_interrupt_ends_reading_after_the_current_batch(tmp_path, monkeypatch):
    calls = interrupt_feed(monkeypatch, 3)
    before = signal.getsignal(signal.SIGINT)
    assert replay_one(tmp_path, '--no-figures') == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert len(calls) == 3
    assert summary_of(tmp_path)['interrupted'] is True


def test_an_interrupt_does_not_wait_for_the_next_batch(tmp_path, monkeypatch):
    from mag_tracking.recording.sample_reader import SampleReader
    waited = []

    def no_batches(self, progress):
        signal.raise_signal(signal.SIGINT)
        progress(1)
        waited.append(True)
        yield from ()

    monkeypatch.setattr(SampleReader, 'readings', no_batches)
    assert replay_one(tmp_path, '--no-figures') == 130
    assert not waited and summary_of(tmp_path)['interrupted'] is True


@pytest.mark.parametrize(
    'step', ['summarise', 'add_track', 'errors_against_truth', 'write_figures'])
def test_an_interrupt_while_writing_loses_no_results(tmp_path, monkeypatch, capsys, step):
    """SIGINT arrives during the first and second call of a step that updates or writes results."""
    from mag_tracking.apps import replay as app
    from mag_tracking.cli import replay

    module = {'write_figures': replay, 'add_track': app.TrackHistory}.get(step, app)
    original, calls = getattr(module, step), []

    def interrupted(*args, **keywords):
        calls.append(step)
        if len(calls) in (1, 2):
            signal.raise_signal(signal.SIGINT)
        return original(*args, **keywords)

    monkeypatch.setattr(module, step, interrupted)
    assert replay_one(tmp_path) == 130
    assert summary_of(tmp_path)['interrupted'] is (step == 'add_track')
    assert 'interrupted; ' in capsys.readouterr().out
    assert not list(tmp_path.glob('*.png'))


def test_a_repeated_interrupt_ends_the_command(tmp_path, monkeypatch):
    from mag_tracking.apps import replay as app

    def hanging(*_):
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
        raise AssertionError('not reached')

    monkeypatch.setattr(app, 'summarise', hanging)
    assert replay_one(tmp_path, '--no-figures') == 130


def test_a_background_job_ignores_interrupts(tmp_path, monkeypatch):
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        interrupt_feed(monkeypatch, 3)
        assert replay_one(tmp_path, '--no-figures') == 0
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_command_works_outside_the_main_thread(tmp_path):
    status = []
    thread = threading.Thread(target=lambda: status.append(replay_one(tmp_path, '--no-figures')))
    thread.start()
    thread.join()
    assert status == [0]


@pytest.mark.parametrize('unbuffered', ['', '1'])
def test_a_closed_pipe_ends_the_command_silently(unbuffered):
    """The exit status with `| head` is that of SIGPIPE (141), and no error is printed."""
    command = [sys.executable, '-m', 'mag_tracking.cli', 'info', str(vehicle_path(NAME))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          env={**os.environ, 'PYTHONUNBUFFERED': unbuffered}) as process:
        process.stdout.close()
        assert process.stderr.read() == b'' and process.wait() == 141


def test_a_broken_pipe_elsewhere_is_an_error(monkeypatch, capfd):
    def broken(*arguments):
        raise BrokenPipeError(errno.EPIPE, 'the sensor')

    monkeypatch.setattr('mag_tracking.apps.info.time_topics', broken)
    assert main(['info', str(vehicle_path(NAME))]) == 1
    assert 'the sensor' in capfd.readouterr().err
