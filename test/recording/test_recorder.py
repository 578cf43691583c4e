"""Recorder: recordings that other software can read, splits and latched messages."""

import errno

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from mag_tracking.errors import OutputError
from mag_tracking.messages.types import MAGNETIC_FIELD, definition, encoder
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.recorder import FLUSH_INTERVAL_NS, Recorder
from mag_tracking.recording.writer import offered_qos
from support.recorded_numbers import TOPIC, S, by_rosbags, field, numbers, started

# Not run in parallel with tests that load the machine.
pytestmark = pytest.mark.alone


def test_a_recording_is_read_by_rosbags_and_mcap(tmp_path):
    recorder, reports = started(tmp_path / 'a')
    pose = 'geometry_msgs/msg/PoseStamped'
    recorder.add_topic('/pose', pose, definition(pose), offered_qos(False, True))
    content = {'header': {'stamp': {'sec': 3, 'nanosec': 4}, 'frame_id': 'map'}}
    for k in range(300):
        recorder.write(TOPIC, field(k), 7 * S + k * 1000, 7 * S + k * 1000 - 300)
        if k % 100 == 0:
            recorder.write('/pose', encoder(pose)(content), 7 * S + k * 1000 + 1)
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == list(range(300)) and reports == []
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


def test_buffered_messages_are_written_without_further_input(tmp_path):
    recorder, _ = started(tmp_path / 'a')
    recorder.write(TOPIC, field(0), 5)
    recorder.tick(S + FLUSH_INTERVAL_NS - 1)
    assert numbers(tmp_path / 'a')[0] == []
    recorder.tick(S + FLUSH_INTERVAL_NS)
    assert numbers(tmp_path / 'a')[0] == [0] and FLUSH_INTERVAL_NS <= S // 2
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == [0]


def test_a_recording_without_messages_is_valid(tmp_path):
    recorder, _ = started(tmp_path / 'a')
    recorder.tick(9000 * S)
    recorder.close()
    recorder.close()
    assert numbers(tmp_path / 'a')[0] == [] and by_rosbags(tmp_path / 'a') == []
    assert [p.name for p in (tmp_path / 'a').glob('*.mcap')] == ['a_0.mcap']


@pytest.mark.parametrize('split_by', ['size', 'time'])
def test_each_file_of_a_split_recording_is_complete(tmp_path, split_by):
    limits = {'size': {'split_bytes': 20_000}, 'time': {'split_ns': 2 * S}}[split_by]
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
    assert len(files) == 5 if split_by == 'time' else max(p.stat().st_size for p in files) < 23_000
    assert len(files) >= 4
    # During the recording, metadata.yaml lists the finished files and the open file.
    listed = metadata['rosbag2_bagfile_information']['relative_file_paths']
    assert listed == [p.name for p in files[:len(listed)]] and 1 < len(listed) < len(files)
    all_rows = []
    for n, file in enumerate(files):
        rows = by_rosbags(file)
        assert rows and rows == by_rosbags(file) and numbers(file)[0] == [k for _, k in rows]
        # Later files begin with the latest latched message, at the log time of the next message.
        assert by_rosbags(file, '/map') == ([(107, 7), (108, 8), (109, 9)] if n == 0
                                            else [(rows[0][0], 9)])
        all_rows += rows
    assert all_rows == [(1000 + k, k) for k in range(1000)] == by_rosbags(tmp_path / 'a')
    assert recorder.repeated == len(files) - 1
    assert recorder.counts == {TOPIC: 1000, '/map': 3}
    with Reader(tmp_path / 'a') as reader:
        assert reader.message_count == 1003 + recorder.repeated
        assert (reader.start_time, reader.end_time) == (107, 2000)


def test_a_second_publisher_adds_a_latched_message(tmp_path):
    recorder, _ = started(tmp_path / 'a', split_ns=S)
    recorder.add_topic(TOPIC, MAGNETIC_FIELD, latched=1)
    recorder.write(TOPIC, field(1), 1)
    recorder.add_topic(TOPIC, MAGNETIC_FIELD, latched=2)
    recorder.write(TOPIC, field(2), 2)
    recorder.tick(3 * S)
    recorder.write(TOPIC, field(3), 3)
    recorder.close()
    assert by_rosbags(tmp_path / 'a' / 'a_1.mcap') == [(3, 1), (3, 2), (3, 3)]


@pytest.mark.parametrize('name', ['metadata.yaml', 'other_0.mcap', 'other.db3'])
def test_a_folder_with_another_recording_is_refused(tmp_path, name):
    (tmp_path / 'network.yaml').write_text('')
    (tmp_path / name).write_text('kept')
    with pytest.raises(OutputError, match=f'.{name}'):
        Recorder(tmp_path)
    assert (tmp_path / name).read_text() == 'kept' and len(list(tmp_path.iterdir())) == 2


def test_an_unwritable_folder_is_reported(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='a folder'):
        Recorder(tmp_path / 'file')
    with pytest.raises(OutputError, match='Not a'):
        Recorder(tmp_path / 'file' / 'a')

    def refuse(path):
        raise PermissionError(errno.EACCES, 'Permission denied')
    with pytest.raises(OutputError, match='Permission'):
        Recorder(tmp_path / 'a', opener=refuse)


def test_a_type_without_a_definition_is_recorded(tmp_path):
    recorder, _ = started(tmp_path / 'a')
    recorder.add_topic('/odd', 'odd_msgs/msg/Odd')
    recorder.write('/odd', b'\0\1\0\0abcd', 1)
    recorder.close()
    (message,) = Recording(tmp_path / 'a').messages()
    assert (message.type, message.data) == ('odd_msgs/msg/Odd', b'\0\1\0\0abcd')
    assert message.schema.encoding == ''
