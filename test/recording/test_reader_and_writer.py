"""Recordings: other software can read them, and the reader tolerates damaged files."""

import io
import re
import tracemalloc

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.messages.schema import header_dict, reading_of, track_dict
from mag_tracking.messages.types import DEFINITIONS, MAGNETIC_FIELD, TRACK_ARRAY, decode
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.recording.writer import MAX_TOPICS, RecordingWriter
from mag_tracking.units import LATEST_NS
from support.bundled import ROOT, vehicle_path
from support.samples import MagSample, recorded, sample_dict, samples_of

JUNCTION = 'junction_left_to_right'


def write(path, n, topics=2, step_ms=10):
    """Write a recording with `n` samples per topic; return the samples."""
    rng = np.random.default_rng(0)
    samples = []
    with RecordingWriter(path) as writer:
        for k in range(n):
            for j in range(topics):
                s = MagSample(k * step_ms * 1_000_000 + j, f'mag_{j + 1}',
                              rng.standard_normal(3) * 1e-5, np.diag(rng.uniform(1, 2, 3)) * 1e-16)
                samples.append(s)
                writer.write(f'/{s.sensor}/imu/mag', MAGNETIC_FIELD, sample_dict(s, s.sensor),
                             s.stamp_ns)
    return samples


def read(path, network=None):
    """Read a recording; return its messages and the `Recording`."""
    recording = Recording(path)
    return list(recording.messages()), recording


def test_too_many_topics_are_refused(tmp_path):
    message = sample_dict(MagSample(10**18, 'mag_1', np.zeros(3)), 'mag_1')
    with pytest.raises(OutputError, match=f'more than {MAX_TOPICS} topics'), \
            RecordingWriter(tmp_path / 'a.mcap') as writer:
        for k in range(MAX_TOPICS + 1):
            writer.write(f'/mag_{k}/imu/mag', MAGNETIC_FIELD, message, 10**18 + k)
    assert len(Recording(tmp_path / 'a.mcap').types) == MAX_TOPICS


def test_written_samples_are_read_back(tmp_path):
    samples = write(tmp_path / 'a.mcap', 200)
    for path in (tmp_path, tmp_path / 'a.mcap'):
        messages, recording = read(path)
        assert not recording.losses and sum(recording.message_counts.values()) == 400
        for m, s in zip(messages, samples, strict=True):
            (back,) = samples_of(reading_of(decode(m), s.sensor))
            assert back.stamp_ns == s.stamp_ns == m.log_time_ns
            np.testing.assert_array_equal(back.field, s.field)
            np.testing.assert_array_equal(back.covariance, s.covariance)


def test_rosbags_reads_written_samples(tmp_path):
    samples = write(tmp_path / 'a.mcap', 50)
    with AnyReader([tmp_path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        rows = [(t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
    assert len(rows) == 100
    for (t, m), s in zip(rows, samples, strict=True):
        assert t == s.stamp_ns == m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
        assert (m.magnetic_field.x, m.magnetic_field.y, m.magnetic_field.z) == tuple(s.field)
        np.testing.assert_array_equal(m.magnetic_field_covariance, s.covariance.ravel())


def test_rosbags_reads_poses_and_tracks(vehicle_replays):
    run, folder = vehicle_replays['straight_car_right']
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        poses = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()
                 if c.topic == '/tracker_node/pose']
        tracks = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()
                  if c.topic == '/tracker_node/tracks']
    log = next(iter(run.logs.values()))
    assert len(poses) == len(log.stamp_ns) and len(tracks) == len(poses) + 1
    for m, position, C, ambiguous in zip(poses, log.position, log.covariance, log.ambiguous,
                                         strict=True):
        p = m.pose.pose.position
        np.testing.assert_array_equal([p.x, p.y, p.z], position)
        covariance = m.pose.covariance.reshape(6, 6)[:3, :3]
        if ambiguous:
            # A pose message has no flag: its covariance covers all hypotheses.
            assert np.linalg.eigvalsh(covariance - C[:3, :3]).min() > -1e-9
        else:
            np.testing.assert_array_equal(covariance, C[:3, :3])
    assert [t.tracks[0].status for t in tracks] == [0] * len(poses) + [1]


def declarations(text):
    """Declarations of a message definition, without comments and with single spaces."""
    lines = (line.split('#')[0].split() for line in text.splitlines())
    return [' '.join(line) for line in lines if line]


def test_definitions_match_the_message_package():
    for name, text in DEFINITIONS.items():
        if name.startswith('mag_tracking_msgs/'):
            source = ROOT / 'msg_defs' / 'msg' / f'{name.split("/")[-1]}.msg'
            assert declarations(source.read_text()) == declarations(text), name


def test_definitions_match_ros_jazzy():
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in DEFINITIONS.items():
        if not name.startswith('mag_tracking_msgs/'):
            ours = get_types_from_msg(text, name)[name]
            # Only the names and the order of the fields are compared.
            theirs = store.fielddefs[name]
            assert [f[0] for f in ours[1]] == [f[0] for f in theirs[1]], name


def test_every_field_of_a_track_is_written(vehicle_replays):
    """The encoder silently writes zero for a missing field."""
    names = {line.split()[1] for line in declarations(DEFINITIONS['mag_tracking_msgs/msg/Track'])
             if '=' not in line}
    _, folder = vehicle_replays['straight_car_right']
    message = next(m for m in Recording(folder / 'tracks.mcap').messages()
                   if m.type == TRACK_ARRAY)
    assert {s for s in type(decode(message).tracks[0]).__slots__ if not s.startswith('_')} == names
    import inspect
    source = inspect.getsource(track_dict)
    assert all(f"'{name}'" in source for name in names)


@pytest.mark.parametrize('n_bytes', [9, 17, 40])
def test_a_file_of_a_few_bytes_is_reported_as_truncated(n_bytes, tmp_path):
    path = tmp_path / 'cut.mcap'
    path.write_bytes(vehicle_path('straight_car_right').read_bytes()[:n_bytes])
    recording = Recording(path)
    assert list(recording.messages()) == []
    assert any('possibly truncated' in cause for cause in recording.losses)


def test_a_truncated_file_is_read_up_to_its_end(tmp_path):
    path = tmp_path / 'cut.mcap'
    write(tmp_path / 'a.mcap', 15_000)
    complete_data = (tmp_path / 'a.mcap').read_bytes()
    path.write_bytes(complete_data[:int(0.6 * len(complete_data))])
    messages, recording = read(path)
    assert 0.3 * 30_000 < len(messages) < 0.65 * 30_000
    no_index, partially_read = sorted(recording.losses)
    assert '(cut.mcap' in no_index
    match = re.fullmatch(r'partially read files \(cut.mcap, up to byte ([0-9]+) of ([0-9]+)\)',
                         partially_read)
    end, size = map(int, match.groups())
    assert 0.5 * size < end < size == path.stat().st_size
    assert [m.log_time_ns for m in messages] == sorted(m.log_time_ns for m in messages)


def test_flipped_bytes_lose_only_their_chunk_and_are_reported(tmp_path):
    path = tmp_path / 'a.mcap'
    write(path, 15_000)
    data = bytearray(path.read_bytes())
    chunks = make_reader(io.BytesIO(data)).get_summary().chunk_indexes
    middle = chunks[len(chunks) // 2]
    for i in range(200):
        data[middle.chunk_start_offset + middle.chunk_length // 2 + i] ^= 0xFF
    path.write_bytes(data)
    messages, recording = read(path)
    assert 0.5 * 30_000 < len(messages) < 30_000
    ((loss, n),) = recording.losses.items()
    assert n == 1 and re.fullmatch(
        r'.*\(a.mcap, [0-9.]+ s .*, [0-9.]+ s .*\)', loss)


@pytest.mark.parametrize('has_index', [True, False])
def test_a_loss_is_counted_once_if_a_recording_is_read_repeatedly(tmp_path, has_index):
    path = tmp_path / 'a.mcap'
    write(path, 15_000)
    data = bytearray(path.read_bytes())
    for chunk in make_reader(io.BytesIO(data)).get_summary().chunk_indexes[1:3]:
        data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    path.write_bytes(data if has_index else data[:-100])
    recording = Recording(path)
    for _ in range(2):
        assert sum(1 for _ in recording.messages()) < 30_000
        n_damaged = {loss.partition(' (')[0]: n for loss, n in recording.losses.items()}
        assert sum(n for loss, n in recording.losses.items() if loss.startswith('damaged')) == 2
        assert has_index or n_damaged['damaged chunks'] == 2


def test_a_file_that_ends_after_a_complete_record_lacks_only_its_index(tmp_path):
    write(tmp_path / 'a.mcap', 15_000)
    data = (tmp_path / 'a.mcap').read_bytes()
    chunk = make_reader(io.BytesIO(data)).get_summary().chunk_indexes[1]
    (tmp_path / 'cut.mcap').write_bytes(data[:chunk.chunk_start_offset + chunk.chunk_length])
    _, recording = read(tmp_path / 'cut.mcap')
    ((loss, n),) = recording.losses.items()
    assert '(cut.mcap' in loss and n == 1


@pytest.mark.parametrize('seed', range(12))
def test_random_damage_does_not_crash_the_reader(tmp_path, seed):
    rng = np.random.default_rng(seed)
    data = bytearray(vehicle_path(JUNCTION).read_bytes())
    for i in rng.integers(0, len(data), 30):
        data[i] ^= 1 << rng.integers(8)
    path = tmp_path / 'a.mcap'
    path.write_bytes(data)
    try:
        messages, recording = read(path)
    except RecordingError as error:
        assert str(path) in str(error)
        return
    intact = len(list(Recording(vehicle_path(JUNCTION)).messages()))
    assert len(messages) == intact or recording.losses


@pytest.mark.study
def test_reader_memory_does_not_grow_with_the_recording(tmp_path):
    peaks = []
    for n in (10_000, 40_000):
        path = tmp_path / str(n) / 'a.mcap'
        path.parent.mkdir()
        write(path, n)
        tracemalloc.start()
        assert sum(1 for _ in Recording(path).messages()) == 2 * n
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # The messages alone are 3 and 11 MB.
    assert peaks[1] < 1.2 * peaks[0] < 9e6, peaks


def test_overlapping_chunks_are_read_in_order(tmp_path):
    """The file is written topic by topic, so the second topic begins again at the start time."""
    path = tmp_path / 'a.mcap'
    with RecordingWriter(path) as writer:
        for j in range(2):
            for k in range(20_000):
                s = MagSample(k * 10_000_000 + j, f'mag_{j}', np.zeros(3))
                writer.write(f'/mag_{j}', MAGNETIC_FIELD, sample_dict(s, 'x'), s.stamp_ns)
    times = [m.log_time_ns for m in Recording(path).messages()]
    assert len(times) == 40_000 and times == sorted(times)


def test_messages_are_selected_by_topic_and_start_time():
    recording = Recording(vehicle_path(JUNCTION))
    start = recording.start_ns + 5_000_000_000
    messages = list(recording.messages({'/mag_1/imu/mag'}, start))
    assert {m.topic for m in messages} == {'/mag_1/imu/mag'}
    assert min(m.log_time_ns for m in messages) >= start
    assert len(messages) == 1500


def test_unusable_recordings_are_refused(tmp_path, road_network):
    empty = tmp_path / 'empty.mcap'
    empty.write_bytes(b'')
    text = tmp_path / 'text.mcap'
    text.write_text('this is no recording')
    sqlite = tmp_path / 'a.db3'
    sqlite.write_text('SQLite')
    folder = tmp_path / 'folder'
    folder.mkdir()
    for path, message in ((tmp_path / 'nowhere.mcap', 'does not exist'), (empty, 'is empty'),
                          (text, 'not a recording but a text file'), (sqlite, 'not a recording'),
                          (folder, 'contains no recording')):
        with pytest.raises(RecordingError, match=message):
            Recording(path)
    for text in ('a: 1', 'rosbag2_bagfile_information: 3'):
        (folder / 'metadata.yaml').write_text(text)
        with pytest.raises(RecordingError, match='relative_file_paths'):
            Recording(folder)


def test_the_error_for_missing_topics_lists_the_recorded_ones(tmp_path, road_network):
    path = tmp_path / 'a.mcap'
    with RecordingWriter(path) as writer:
        s = MagSample(0, 'x', np.zeros(3))
        writer.write('/elsewhere/mag', MAGNETIC_FIELD, sample_dict(s, 'x'), 0)
    with pytest.raises(RecordingError, match='/elsewhere/mag'):
        SampleReader(Recording(path), road_network)


def test_a_topic_of_another_type_is_refused(tmp_path, road_network):
    path = tmp_path / 'a.mcap'
    with RecordingWriter(path) as writer:
        writer.write('/mag_1/imu/mag', 'std_msgs/msg/Header', header_dict(0, 'x'), 0)
    with pytest.raises(RecordingError, match='carries std_msgs/msg/Header'):
        SampleReader(Recording(path), road_network)


def test_a_recording_without_messages_has_no_samples(tmp_path, road_network):
    path = tmp_path / 'a.mcap'
    with RecordingWriter(path):
        pass
    assert recorded(SampleReader(Recording(path), road_network)) == []


def test_an_unwritable_path_is_reported(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(OutputError, match='cannot write'):
        RecordingWriter(tmp_path / 'file' / 'a.mcap')


def write_raw(path, log_times, use_chunking=True):
    """Write a recording of one topic with arbitrary log times."""
    with open(path, 'wb') as stream:
        writer = Writer(stream, use_chunking=use_chunking)
        writer.start('ros2', 'test')
        schema = writer.register_schema(MAGNETIC_FIELD, 'ros2msg', b'x')
        channel = writer.register_channel('/mag_1/imu/mag', 'cdr', schema)
        for k, log_time in enumerate(log_times):
            writer.add_message(channel, log_time, b'message %d' % k, log_time)
        writer.finish()


@pytest.mark.parametrize('use_chunking', [True, False])
def test_log_times_beyond_63_bits_are_clipped_without_loss(tmp_path, use_chunking):
    """MCAP stores log times as unsigned 64-bit integers."""
    write_raw(tmp_path / 'a.mcap', [1, 2, 2**63, 2**64 - 1], use_chunking)
    messages, recording = read(tmp_path / 'a.mcap')
    assert [m.data for m in messages] == [b'message %d' % k for k in range(4)]
    assert messages[-1].log_time_ns == LATEST_NS and not recording.losses


def test_messages_without_chunks_are_read_in_blocks(tmp_path):
    """A truncated file is read up to its last complete message."""
    write_raw(tmp_path / 'a.mcap', range(1000), use_chunking=False)
    blocks = list(Recording(tmp_path / 'a.mcap').blocks())
    assert sum(map(len, blocks)) == 1000 and len(blocks) <= 5
    data = (tmp_path / 'a.mcap').read_bytes()
    (tmp_path / 'cut.mcap').write_bytes(data[:data.index(b'message 700') + 3])
    messages, recording = read(tmp_path / 'cut.mcap')
    assert [m.data for m in messages] == [b'message %d' % k for k in range(700)]
    assert recording.losses
