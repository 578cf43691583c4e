"""Recorder: kills and disk failures cause only small losses, which are reported."""

import errno
import io
import os
import re
import select
import signal
import struct
import subprocess
import sys
import time

import pytest
from rosbags.highlevel import AnyReaderError

from mag_tracking.recording.reader import Recording
from mag_tracking.recording.repair import repair
from support.bundled import ROOT
from support.marks import studied
from support.recorded_numbers import TOPIC, S, by_rosbags, field, numbers, started

# Not run in parallel with tests that load the machine.
pytestmark = pytest.mark.alone
TEST_FOLDER = str(ROOT / 'test')


class SmallDisk:
    """File opener that simulates a disk with `free_bytes` free bytes."""

    def __init__(self, free_bytes):
        self.free_bytes = free_bytes

    def __call__(self, path):
        disk = self

        class File(io.FileIO):
            def write(self, data):
                if len(data) and disk.free_bytes <= 0:
                    raise OSError(errno.ENOSPC, 'No space left on device')
                n = super().write(bytes(data[:disk.free_bytes]))
                disk.free_bytes -= n
                return n

            def truncate(self, size=None):
                before = os.fstat(self.fileno()).st_size
                disk.free_bytes += before - super().truncate(size)

        return File(path, 'xb')


RECORD_UNTIL_KILLED = '''
import os, struct, sys, time
sys.path.insert(0, sys.argv[2])
from support.recorded_numbers import TOPIC, field, started
data = [field(k) for k in range(4000)]
recorder, _ = started(sys.argv[1], split_ns=700_000_000)
last_tick = 0
for k, d in enumerate(data):
    now = time.monotonic_ns()
    recorder.write(TOPIC, d, time.time_ns())
    os.write(1, struct.pack('<QQ', k, now))
    if now - last_tick > 100_000_000:
        recorder.tick(now)
        last_tick = now
    time.sleep(0.001)
'''


def record_until_killed(folder, after_s):
    """Start a recorder and kill it after `after_s`; return the numbers and times [ns] of the
    messages passed to it."""
    process = subprocess.Popen([sys.executable, '-c', RECORD_UNTIL_KILLED, folder,
                                TEST_FOLDER], stdout=subprocess.PIPE)
    with process:
        assert select.select([process.stdout], [], [], 60.0)[0]
        time.sleep(after_s)
        process.send_signal(signal.SIGKILL)
        sent = process.stdout.read()
    assert process.returncode == -signal.SIGKILL
    sent = sent[:len(sent) // 16 * 16]
    return tuple(zip(*struct.iter_unpack('<QQ', sent), strict=True))


@pytest.mark.parametrize('n_kills', studied([5, 20], [5]))
def test_kills_lose_less_than_a_second(tmp_path, n_kills):
    worst_n = worst_s = n_cut = 0
    for n in range(0, 20, 20 // n_kills):
        folder = tmp_path / f'r{n}'
        recorded, times = record_until_killed(folder, 0.1 + 0.05 * n)
        found, recording = numbers(folder)
        assert found == list(range(len(found))) and len(found) <= len(recorded) + 1
        assert all(re.match('files without|partially read', loss)
                   for loss in recording.losses), recording.losses
        lost = len(recorded) - len(found)
        if lost > 0:
            worst_n, worst_s = max(worst_n, lost), max(
                worst_s, (times[-1] - times[len(found)]) / S)
        # Other readers require the index. Before the repair, the last file has no index, unless
        # the process was killed between two files.
        if recording.losses:
            n_cut += 1
            with pytest.raises(AnyReaderError, match='end magic'):
                by_rosbags(folder)
        assert repair(folder, report=lambda _: None) == bool(recording.losses)
        assert [k for _, k in by_rosbags(folder)] == found == numbers(folder)[0]
        assert not Recording(folder).losses
    print(f'worst of {n_kills} kills: {worst_s:.2f} s, {worst_n} messages')
    assert worst_s < 1.0 and n_cut > n_kills / 2


def test_a_full_disk_is_reported_and_the_recording_continues(tmp_path):
    disk = SmallDisk(40_000)
    recorder, reports = started(tmp_path / 'a', opener=disk, retry_ns=S)
    for k in range(2000):
        if k == 1000:
            before = recorder.dropped[TOPIC]
            disk.free_bytes += 10**6
        recorder.write(TOPIC, field(k), k)
        recorder.tick(S + k * S // 100)
    recorder.close()
    found, recording = numbers(tmp_path / 'a')
    dropped = recorder.dropped[TOPIC]
    assert recorder.counts[TOPIC] == len(found) == 2000 - dropped
    assert 100 < before < dropped <= before + 100
    # There is a single gap, from the first chunk without space to the first retry with space.
    first = found.index(next(b for a, b in zip(found, found[1:], strict=False) if b != a + 1))
    assert found[:first] == list(range(first)) and found[first:] == list(range(first + dropped,
                                                                               2000))
    assert len(reports) == 2 and 'No space' in reports[0] and f': {dropped}' in reports[1]
    assert not recorder.unfinished and not recording.losses
    assert [k for _, k in by_rosbags(tmp_path / 'a')] == found


def test_a_recording_on_a_full_disk_can_be_repaired(tmp_path):
    disk = SmallDisk(40_000)
    recorder, reports = started(tmp_path / 'a', opener=disk, split_bytes=15_000)
    for k in range(2000):
        recorder.write(TOPIC, field(k), k)
        recorder.tick(S + k * S // 100)
    found, _ = numbers(tmp_path / 'a')
    assert recorder.counts[TOPIC] == len(found) > 200
    assert found == list(range(len(found)))
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == found
    assert any(f'mag-tracking repair {tmp_path / "a"}' in text for text in reports)
    repair(tmp_path / 'a')
    assert [k for _, k in by_rosbags(tmp_path / 'a')] == found
    assert sorted(p.suffix for p in (tmp_path / 'a').iterdir() if p.suffix != '.mcap') == ['.yaml']


RECORD_WITH_FILE_LIMIT = '''
import resource, sys
sys.path.insert(0, sys.argv[2])
from support.recorded_numbers import S, TOPIC, field, started
resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))
recorder, reports = started(sys.argv[1], retry_ns=S // 2)
for k in range(1500):
    recorder.write(TOPIC, field(k), k)
    recorder.tick(S + k * S // 100)
recorder.close()
print(recorder.counts[TOPIC], recorder.dropped[TOPIC], len(reports), len(recorder.unfinished))
'''


def test_recording_survives_a_file_size_limit_of_the_system(tmp_path):
    """The limit causes real short writes, and leaves no space for the index of a full file."""
    done = subprocess.run([sys.executable, '-c', RECORD_WITH_FILE_LIMIT, tmp_path / 'a',
                           TEST_FOLDER], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    n_recorded, dropped, n_reports, _ = map(int, done.stdout.split())
    found, _ = numbers(tmp_path / 'a')
    assert n_recorded == len(found) == 1500 - dropped and dropped > 0 and n_reports >= 4
    repair(tmp_path / 'a', report=lambda _: None)
    assert [k for _, k in by_rosbags(tmp_path / 'a')] == found


def test_a_removed_folder_is_reported_and_created_again(tmp_path):
    recorder, reports = started(tmp_path / 'a', retry_ns=S)
    for k in range(500):
        if k == 100:
            for p in (tmp_path / 'a').iterdir():
                p.unlink()
            (tmp_path / 'a').rmdir()
        recorder.write(TOPIC, field(k), k)
        recorder.tick(S + k * S // 100)
    recorder.close()
    found, _ = numbers(tmp_path / 'a')
    assert found == list(range(recorder.dropped[TOPIC], 500)) and 100 < len(found) < 400
    assert recorder.counts[TOPIC] == len(found) and 'was removed' in reports[0]
