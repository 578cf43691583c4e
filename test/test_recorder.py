"""The recorder: what it writes others read; a crash, a full disk and a split lose what is told."""

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
import zlib

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.io.bag import Recording
from mag_tracking.io.recorder import FLUSH_NS, Recorder
from mag_tracking.io.recording_repair import finish_file, repair
from mag_tracking.io.rosbag2_folder import offered_qos
from mag_tracking.io.schema import (
    MAGNETIC_FIELD,
    decode,
    definition,
    encoder,
    sample_dict,
    stamp_ns,
)
from mag_tracking.records import MagSample

TOPIC = '/mag_1/imu/mag'
S = 10**9


def field(k):
    """A serialised magnetic field that carries the number `k` as its stamp."""
    noise = np.random.default_rng(k).standard_normal(3) * 1e-5
    return encoder(MAGNETIC_FIELD)(sample_dict(MagSample(k, 'mag', noise, None), 'mag_1'))


def started(folder, **arguments):
    """A recorder that knows the topic, ticked once; and what it reports."""
    told = []
    recorder = Recorder(folder, report=told.append, **arguments)
    recorder.add_topic(TOPIC, MAGNETIC_FIELD, definition(MAGNETIC_FIELD))
    recorder.tick(S)
    return recorder, told


def numbers(path, topic=TOPIC):
    """The numbers of the messages in a recording, in its order, and the recording."""
    recording = Recording(path)
    return [stamp_ns(decode(m).header.stamp) for m in recording.messages([topic])], recording


def by_rosbags(path, topic=TOPIC):
    """[(time, number)] as rosbags reads them."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        rows = [(t, reader.deserialize(raw, c.msgtype).header.stamp)
                for c, t, raw in reader.messages() if c.topic == topic]
    return [(t, s.sec * S + s.nanosec) for t, s in rows]


class Disk:
    """An opener of files on a disk of a few bytes."""

    def __init__(self, room):
        self.room = room

    def __call__(self, path):
        disk = self

        class File(io.FileIO):
            def write(self, data):
                if len(data) and disk.room <= 0:
                    raise OSError(errno.ENOSPC, 'No space left on device')
                n = super().write(bytes(data[:disk.room]))
                disk.room -= n
                return n

            def truncate(self, size=None):
                before = os.fstat(self.fileno()).st_size
                disk.room += before - super().truncate(size)

        return File(path, 'xb')


def test_what_is_recorded_is_read_by_others(tmp_path):
    recorder, told = started(tmp_path / 'a')
    pose = 'geometry_msgs/msg/PoseStamped'
    recorder.add_topic('/pose', pose, definition(pose), offered_qos(False, True))
    content = {'header': {'stamp': {'sec': 3, 'nanosec': 4}, 'frame_id': 'map'}}
    for k in range(300):
        recorder.write(TOPIC, field(k), 7 * S + k * 1000, 7 * S + k * 1000 - 300)
        if k % 100 == 0:
            recorder.write('/pose', encoder(pose)(content), 7 * S + k * 1000 + 1)
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == list(range(300)) and told == []
    assert by_rosbags(tmp_path / 'a') == [(7 * S + k * 1000, k) for k in range(300)]
    with Reader(tmp_path / 'a') as reader:
        assert {t: (i.msgtype, i.msgcount) for t, i in reader.topics.items()} == {
            TOPIC: (MAGNETIC_FIELD, 300), '/pose': (pose, 3)}
        assert (reader.start_time, reader.end_time) == (7 * S, 7 * S + 299_001)
        qos = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
    assert [(q.reliability.name, q.durability.name) for q in (qos[TOPIC], qos['/pose'])] == [
        ('RELIABLE', 'VOLATILE'), ('BEST_EFFORT', 'TRANSIENT_LOCAL')]
    with open(tmp_path / 'a' / 'a_0.mcap', 'rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        rows = [(s.encoding, c.message_encoding, m.sequence, m.log_time - m.publish_time)
                for s, c, m in reader.iter_messages([TOPIC])]
        assert {c.compression for c in reader.get_summary().chunk_indexes} == {'zstd'}
    assert rows == [('ros2msg', 'cdr', k, 300) for k in range(300)]


def test_what_waits_is_written_though_nothing_more_comes(tmp_path):
    recorder, _ = started(tmp_path / 'a')
    recorder.write(TOPIC, field(0), 5)
    recorder.tick(S + FLUSH_NS - 1)
    assert numbers(tmp_path / 'a')[0] == []
    recorder.tick(S + FLUSH_NS)
    assert numbers(tmp_path / 'a')[0] == [0] and FLUSH_NS <= S // 2
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == [0]


def test_a_recording_without_messages_is_one(tmp_path):
    recorder, _ = started(tmp_path / 'a')
    recorder.tick(9000 * S)
    recorder.close()
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == [] and by_rosbags(tmp_path / 'a') == []
    assert [p.name for p in (tmp_path / 'a').glob('*.mcap')] == ['a_0.mcap']


@pytest.mark.parametrize('how', ['size', 'time'])
def test_each_file_of_a_split_recording_stands_alone(tmp_path, how):
    limits = {'size': {'split_bytes': 20_000}, 'time': {'split_ns': 2 * S}}[how]
    recorder, _ = started(tmp_path / 'a', **limits)
    recorder.add_topic('/map', MAGNETIC_FIELD, definition(MAGNETIC_FIELD),
                       offered_qos(True, True), latched=1)
    for k in (7, 8, 9):
        recorder.write('/map', field(k), 100 + k)
    for k in range(1000):
        recorder.write(TOPIC, field(k), 1000 + k)
        recorder.tick(S + k * S // 100)
        if k == 500:
            metadata = yaml.safe_load((tmp_path / 'a' / 'metadata.yaml').read_text())
    recorder.close()
    files = sorted((tmp_path / 'a').glob('*.mcap'), key=lambda p: int(p.stem.split('_')[1]))
    assert len(files) == 5 if how == 'time' else max(p.stat().st_size for p in files) < 23_000
    assert len(files) >= 4
    # In the middle of it, the list names the finished files and the open one.
    listed = metadata['rosbag2_bagfile_information']['relative_file_paths']
    assert listed == [p.name for p in files[:len(listed)]] and 1 < len(listed) < len(files)
    got = []
    for n, file in enumerate(files):
        mine = by_rosbags(file)
        assert mine and mine == by_rosbags(file) and numbers(file)[0] == [k for _, k in mine]
        # The latest of the latched ones, at the time of the first of the others.
        assert by_rosbags(file, '/map') == ([(107, 7), (108, 8), (109, 9)] if n == 0
                                            else [(mine[0][0], 9)])
        got += mine
    assert got == [(1000 + k, k) for k in range(1000)] == by_rosbags(tmp_path / 'a')
    assert recorder.repeated == len(files) - 1
    assert recorder.counts == {TOPIC: 1000, '/map': 3}
    with Reader(tmp_path / 'a') as reader:
        assert reader.message_count == 1003 + recorder.repeated
        assert (reader.start_time, reader.end_time) == (107, 2000)


def test_more_publishers_more_latched_messages(tmp_path):
    recorder, _ = started(tmp_path / 'a', split_ns=S)
    recorder.add_topic(TOPIC, MAGNETIC_FIELD, latched=1)
    recorder.write(TOPIC, field(1), 1)
    recorder.add_topic(TOPIC, MAGNETIC_FIELD, latched=2)
    recorder.write(TOPIC, field(2), 2)
    recorder.tick(3 * S)
    recorder.write(TOPIC, field(3), 3)
    recorder.close()
    assert by_rosbags(tmp_path / 'a' / 'a_1.mcap') == [(3, 1), (3, 2), (3, 3)]


RECORD_UNTIL_KILLED = '''
import os, struct, sys, time
sys.path.insert(0, sys.argv[2])
from test_recorder import TOPIC, field, started
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


def killed(folder, after_s):
    """(numbers, times [ns]) that a recorder process had taken when it was killed."""
    process = subprocess.Popen([sys.executable, '-c', RECORD_UNTIL_KILLED, folder,
                                os.path.dirname(__file__)], stdout=subprocess.PIPE)
    with process:
        assert select.select([process.stdout], [], [], 60.0)[0]
        time.sleep(after_s)
        process.send_signal(signal.SIGKILL)
        sent = process.stdout.read()
    assert process.returncode == -signal.SIGKILL
    sent = sent[:len(sent) // 16 * 16]
    return tuple(zip(*struct.iter_unpack('<QQ', sent), strict=True))


def test_twenty_kills_lose_less_than_a_second(tmp_path):
    worst_n = worst_s = n_cut = 0
    for n in range(20):
        folder = tmp_path / f'r{n}'
        taken, times = killed(folder, 0.1 + 0.05 * n)
        found, recording = numbers(folder)
        assert found == list(range(len(found))) and len(found) <= len(taken) + 1
        assert all(re.search('no usable end|nothing readable after byte', what)
                   for what in recording.losses), recording.losses
        lost = len(taken) - len(found)
        if lost > 0:
            worst_n, worst_s = max(worst_n, lost), max(
                worst_s, (times[-1] - times[len(found)]) / S)
        # Another reader wants the index, which the last file has only after a repair,
        # or if it was killed in the moment between two files.
        if recording.losses:
            n_cut += 1
            with pytest.raises(AnyReaderError, match='end magic'):
                by_rosbags(folder)
        assert repair(folder, report=lambda _: None) == bool(recording.losses)
        assert [k for _, k in by_rosbags(folder)] == found == numbers(folder)[0]
        assert not Recording(folder).losses
    print(f'worst of 20 kills: {worst_s:.2f} s, {worst_n} messages')
    assert worst_s < 1.0 and n_cut > 10


def test_a_full_disk_is_told_and_it_goes_on(tmp_path):
    disk = Disk(40_000)
    recorder, told = started(tmp_path / 'a', opener=disk, retry_ns=S)
    for k in range(2000):
        if k == 1000:
            before = recorder.dropped[TOPIC]
            disk.room += 10**6
        recorder.write(TOPIC, field(k), k)
        recorder.tick(S + k * S // 100)
    recorder.close()
    found, recording = numbers(tmp_path / 'a')
    dropped = recorder.dropped[TOPIC]
    assert recorder.counts[TOPIC] == len(found) == 2000 - dropped
    assert 100 < before < dropped <= before + 100
    # One gap: from the chunk that found no room to the first try after there was some.
    first = found.index(next(b for a, b in zip(found, found[1:], strict=False) if b != a + 1))
    assert found[:first] == list(range(first)) and found[first:] == list(range(first + dropped,
                                                                              2000))
    assert len(told) == 2 and 'No space left' in told[0] and f': {dropped}' in told[1]
    assert not recorder.unfinished and not recording.losses
    assert [k for _, k in by_rosbags(tmp_path / 'a')] == found


def test_a_disk_that_stays_full_leaves_what_can_be_repaired(tmp_path):
    disk = Disk(40_000)
    recorder, told = started(tmp_path / 'a', opener=disk, split_bytes=15_000)
    for k in range(2000):
        recorder.write(TOPIC, field(k), k)
        recorder.tick(S + k * S // 100)
    found, _ = numbers(tmp_path / 'a')
    assert recorder.counts[TOPIC] == len(found) > 200
    assert found == list(range(len(found)))
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == found
    assert any(f'mag-tracking repair {tmp_path / "a"}' in text for text in told)
    repair(tmp_path / 'a')
    assert [k for _, k in by_rosbags(tmp_path / 'a')] == found
    assert sorted(p.suffix for p in (tmp_path / 'a').iterdir() if p.suffix != '.mcap') == ['.yaml']


LIMITED = '''
import resource, sys
sys.path.insert(0, sys.argv[2])
from test_recorder import S, TOPIC, field, started
resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))
recorder, told = started(sys.argv[1], retry_ns=S // 2)
for k in range(1500):
    recorder.write(TOPIC, field(k), k)
    recorder.tick(S + k * S // 100)
recorder.close()
print(recorder.counts[TOPIC], recorder.dropped[TOPIC], len(told), len(recorder.unfinished))
'''


def test_a_limit_of_the_system_on_the_size_of_files(tmp_path):
    """Real short writes; what is unfinished at the end has no room for its index even then."""
    done = subprocess.run([sys.executable, '-c', LIMITED, tmp_path / 'a',
                           os.path.dirname(__file__)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    counted, dropped, told, _ = map(int, done.stdout.split())
    found, _ = numbers(tmp_path / 'a')
    assert counted == len(found) == 1500 - dropped and dropped > 0 and told >= 4
    repair(tmp_path / 'a', report=lambda _: None)
    assert [k for _, k in by_rosbags(tmp_path / 'a')] == found


def test_a_folder_that_is_removed_is_told_and_made_again(tmp_path):
    recorder, told = started(tmp_path / 'a', retry_ns=S)
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
    assert recorder.counts[TOPIC] == len(found) and 'was removed' in told[0]


def torn_recording(tmp_path, tick=True):
    """The bytes of a recording file of two topics, as it is before it is finished."""
    recorder, _ = started(tmp_path / 'source')
    recorder.add_topic('/other', MAGNETIC_FIELD, definition(MAGNETIC_FIELD))
    for k in range(200):
        recorder.write(TOPIC, field(k), k)
        recorder.write('/other', field(k), k)
        recorder.tick(S + k * S // 100)
    whole = (tmp_path / 'source' / 'source_0.mcap').read_bytes()
    recorder.close()
    return whole, (tmp_path / 'source' / 'source_0.mcap').read_bytes()


def test_repair_at_whatever_byte_it_was_cut(tmp_path):
    unfinished, finished = torn_recording(tmp_path)
    assert finished.startswith(unfinished)
    data = finished[:-8]
    last = [c for c in make_reader(io.BytesIO(finished)).get_summary().chunk_indexes
            if c.chunk_start_offset < len(unfinished)][-1]
    last_chunk_end = last.chunk_start_offset + last.chunk_length
    file = tmp_path / 'cut' / 'x_0.mcap'
    file.parent.mkdir()
    for cut in sorted({*np.linspace(60, len(data), 60, dtype=int), last_chunk_end,
                       last_chunk_end + 9, len(unfinished), len(data)}):
        file.write_bytes(data[:cut])
        before = {t: numbers(file, t)[0] for t in (TOPIC, '/other')}
        told = []
        assert repair(file.parent, told.append) == 1
        with open(file, 'rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            for topic, found in before.items():
                assert [stamp_ns_of(m) for _, _, m in reader.iter_messages([topic])] == found
        for topic, found in before.items():
            assert [k for _, k in by_rosbags(file.parent, topic)] == found
        torn = file.with_name('x_0.mcap.cut')
        kept = torn.read_bytes() if torn.exists() else b''
        assert any(f'last {len(kept)} bytes' in line for line in told) == bool(kept)
        if cut <= len(unfinished):
            head = file.read_bytes()
            assert head.startswith(data[:cut - len(kept)]) and data[:cut].endswith(kept)
        torn.unlink(missing_ok=True)
        repaired = file.read_bytes()
        start, _, crc = struct.unpack('<QQI', repaired[-28:-8])
        assert crc == zlib.crc32(repaired[start:-12])
        if last_chunk_end <= cut <= len(unfinished):
            # The indexes of the last chunk are made as they would have been.
            assert repaired.startswith(unfinished)
        assert repair(file.parent) == 0 and file.read_bytes() == repaired


def stamp_ns_of(message):
    """The number in the bytes of a magnetic field: its stamp comes first."""
    sec, nanosec = struct.unpack_from('<iI', message.data, 4)
    return sec * S + nanosec


def test_repair_keeps_the_order_of_many_files(tmp_path):
    recorder, _ = started(tmp_path / 'a', split_ns=S)
    for k in range(24):
        recorder.write(TOPIC, field(k), k)
        recorder.tick(2 * (k + 2) * S)
    recorder.close()
    assert (tmp_path / 'a' / 'a_11.mcap').exists()
    metadata = tmp_path / 'a' / 'metadata.yaml'
    whole = yaml.safe_load(metadata.read_text())
    metadata.unlink()
    assert repair(tmp_path / 'a') == 0 and numbers(tmp_path / 'a')[0] == list(range(24))
    assert yaml.safe_load(metadata.read_text()) == whole


def test_repair_leaves_out_and_tells_a_damaged_chunk(tmp_path):
    unfinished, finished = torn_recording(tmp_path)
    file = tmp_path / 'x.mcap'
    broken = bytearray(unfinished)
    middle = make_reader(io.BytesIO(finished)).get_summary().chunk_indexes[2]
    broken[middle.chunk_start_offset + middle.chunk_length // 2] ^= 0xFF
    file.write_bytes(broken)
    before, told = numbers(file)[0], []
    assert 0 < len(before) < 200
    assert repair(file, told.append) == 1
    assert any('damaged chunks, left out: 1' in line for line in told), told
    assert [k for _, k in by_rosbags(file)] == before


def test_what_is_being_recorded_is_not_repaired(tmp_path):
    recorder, _ = started(tmp_path / 'a')
    recorder.write(TOPIC, field(0), 1)
    with pytest.raises(OutputError, match='a_0.mcap is being recorded'):
        repair(tmp_path / 'a')
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == [0] and repair(tmp_path / 'a') == 0


def test_repair_names_what_is_no_recording(tmp_path):
    with pytest.raises(RecordingError, match='holds no .mcap file'):
        repair(tmp_path / 'nothing')
    (tmp_path / 'x.mcap').write_text('nonsense of some length')
    with pytest.raises(RecordingError, match='x.mcap is not an MCAP file'):
        finish_file(tmp_path / 'x.mcap')
    assert (tmp_path / 'x.mcap').read_text() == 'nonsense of some length'


@pytest.mark.parametrize('name', ['metadata.yaml', 'other_0.mcap', 'other.db3'])
def test_a_folder_with_another_recording_is_refused(tmp_path, name):
    (tmp_path / 'network.yaml').write_text('')
    (tmp_path / name).write_text('kept')
    with pytest.raises(OutputError, match=f'holds a recording already .{name}'):
        Recorder(tmp_path)
    assert (tmp_path / name).read_text() == 'kept' and len(list(tmp_path.iterdir())) == 2


def test_a_place_where_nothing_can_be_written_is_named(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='file is not a folder'):
        Recorder(tmp_path / 'file')
    with pytest.raises(OutputError, match='cannot record in .*Not a directory'):
        Recorder(tmp_path / 'file' / 'a')

    def forbidden(path):
        raise PermissionError(errno.EACCES, 'Permission denied')
    with pytest.raises(OutputError, match='cannot record in .*Permission denied'):
        Recorder(tmp_path / 'a', opener=forbidden)


def test_a_type_without_definition_is_recorded_all_the_same(tmp_path):
    recorder, _ = started(tmp_path / 'a')
    recorder.add_topic('/odd', 'odd_msgs/msg/Odd')
    recorder.write('/odd', b'\0\1\0\0abcd', 1)
    recorder.close()
    (message,) = Recording(tmp_path / 'a').messages()
    assert (message.type, message.data) == ('odd_msgs/msg/Odd', b'\0\1\0\0abcd')
    assert message.schema.encoding == ''
