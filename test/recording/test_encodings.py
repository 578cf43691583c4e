"""Encodings of messages: read with the same result as CDR, or refused by their name."""

import json
import struct

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

import mag_tracking as mt
from mag_tracking.errors import RecordingError
from mag_tracking.messages.types import MAGNETIC_FIELD, definition
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.reader import Recording
from support.counters import count_of

EPOCH_S, N = 1_790_000_000, 240
NAMES = ('mag_1', 'a', 'ab', 'abc')
"""Sensors whose names, with the terminating zero, need 2, 2, 1 and 0 bytes to the next multiple
of four."""
ROS2 = (MAGNETIC_FIELD, 'ros2msg', definition(MAGNETIC_FIELD).encode())
IDL = ('sensor_msgs::msg::MagneticField', 'omgidl', b'module sensor_msgs { };')


def network(topics=None):
    return SensorNetwork(NAMES, np.eye(4, 3), np.tile(np.eye(3), (4, 1, 1)),
                         topics or tuple(f'{name}/imu/mag' for name in NAMES))


def readings():
    """(time [ns], sensor, field [T]) in order of time."""
    for k in range(N):
        yield EPOCH_S * 10**9 + 10_000_000 * k, NAMES[k % 4], (1e-5 + 1e-9 * k, -2e-5, 4e-5)


def cdr(time_ns, name, field, kind=1, extra=b'', frame=None):
    """Serialise sensor_msgs/MagneticField with the encapsulation `kind`."""
    order, alignment = '<' if kind & 1 else '>', 8 if kind < 6 else 4
    text = (name if frame is None else frame).encode() + b'\0'
    head = struct.pack(f'{order}iII', time_ns // 10**9, time_ns % 10**9, len(text)) + text
    return bytes([0, kind, 0, 0]) + head + bytes(-len(head) % alignment) + struct.pack(
        f'{order}12d', *field, *[0.0] * 9) + extra


def ros1(time_ns, name, field):
    """Serialise sensor_msgs/MagneticField of ROS 1."""
    return struct.pack('<IIII', 7, time_ns // 10**9, time_ns % 10**9, len(name)) \
        + name.encode() + struct.pack('<12d', *field, *[0.0] * 9)


def in_json(time_ns, name, field):
    return json.dumps({
        'header': {'stamp': {'sec': time_ns // 10**9, 'nanosec': time_ns % 10**9},
                   'frame_id': name}, 'magnetic_field': dict(zip('xyz', field, strict=True)),
        'magnetic_field_covariance': [0.0] * 9}).encode()


def write(path, encoding, schema, serialise, topic='/{}/imu/mag'):
    """Write the readings to an MCAP file."""
    with open(path, 'wb') as stream:
        writer, channels = Writer(stream), {}
        writer.start('ros2')
        schema_id = writer.register_schema(*schema) if schema else 0
        for time_ns, name, field in readings():
            key = topic.format(name)
            if key not in channels:
                channels[key] = writer.register_channel(key, encoding, schema_id)
            writer.add_message(channels[key], time_ns, serialise(time_ns, name, field), time_ns)
        writer.finish()
    return path


def assert_read(path, rejected=()):
    """Check that the readings are exact, and which causes are reported."""
    found = mt.read_recording(path, network())
    times, names, fields = zip(*readings(), strict=True)
    assert tuple(found.readings.sensor_names()) == names
    np.testing.assert_array_equal(found.readings.stamp_ns, times)
    np.testing.assert_array_equal(found.readings.field, fields)
    assert set(found.rejected) == set(rejected) and not found.lost


@pytest.mark.parametrize('encoding, schema, serialise', [
    ('cdr', ROS2, cdr),
    ('cdr', IDL, cdr),
    ('cdr', ROS2, lambda *m: cdr(*m, kind=0)),
    ('cdr', ROS2, lambda *m: cdr(*m, kind=6)),
    ('cdr', ROS2, lambda *m: cdr(*m, kind=7)),
    ('cdr', ROS2, lambda *m: cdr(*m, kind=7, extra=bytes(4))),
    ('cdr', ROS2, lambda *m: zstandard.compress(cdr(*m))),
    ('cdr', ROS2, lambda *m: lz4.frame.compress(cdr(*m))),
    ('ros1', ('sensor_msgs/MagneticField', 'ros1msg', b''), ros1),
    ('json', ROS2, in_json),
    ('json', (MAGNETIC_FIELD, 'jsonschema', b'{}'), in_json)])
def test_an_encoding_is_read_exactly(encoding, schema, serialise, tmp_path):
    assert_read(write(tmp_path / 'a.mcap', encoding, schema, serialise))


def without(key):
    """Serialiser of JSON messages without a part."""
    def serialise(*reading):
        message = json.loads(in_json(*reading))
        del message[key]
        return json.dumps(message).encode()
    return serialise


def vector(time_ns, name, field):
    return cdr(time_ns, name, field)[:-72]


@pytest.mark.parametrize('encoding, schema, serialise, cause', [
    ('cbor', ROS2, cdr, r'/mag_1/imu/mag carries sensor_msgs/msg/MagneticField \(cbor\)'),
    ('flatbuffer', ('M', 'flatbuffer', b'magnetic_field'), cdr, r'M \(flatbuffer\)'),
    ('json', None, in_json, r'no schema \(json\)'),
    ('cdr', ('geometry_msgs/msg/Vector3Stamped', 'ros2msg', b''), vector, 'Vector3Stamped'),
    ('cdr', ROS2, lambda *m: cdr(*m, kind=9, extra=bytes(8)), 'XCDR2 with delimiters'),
    ('cdr', ROS2, lambda *m: cdr(*m, kind=3), 'parameter lists'),
    ('json', ROS2, without('header'), 'header.stamp or timestamp .*/mag_1/imu/mag'),
    ('json', ROS2, without('magnetic_field'), 'without magnetic_field on /mag_1/imu/mag')])
def test_another_encoding_is_refused_by_its_name(encoding, schema, serialise, cause, tmp_path):
    path = write(tmp_path / 'a.mcap', encoding, schema, serialise)
    with pytest.raises(RecordingError, match=cause):
        mt.read_recording(path, network())


@pytest.mark.parametrize('plugin, mode', [
    (plugin, mode) for plugin in StoragePlugin for mode in CompressionMode
    if (plugin, mode) != (StoragePlugin.SQLITE3, CompressionMode.STORAGE)])
def test_a_compressed_rosbag2_folder_is_read_or_its_compression_is_named(plugin, mode, tmp_path):
    types = get_typestore(Stores.ROS2_JAZZY)
    writer = Ros2Writer(tmp_path / 'bag', version=9, storage_plugin=plugin)
    if mode != CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {name: writer.add_connection(f'/{name}/imu/mag', MAGNETIC_FIELD,
                                                   typestore=types) for name in NAMES}
        for time_ns, name, field in readings():
            writer.write(connections[name], time_ns, cdr(time_ns, name, field))
    if mode == CompressionMode.FILE:
        file, = (tmp_path / 'bag').glob('*.zstd')
        with pytest.raises(RecordingError, match='zstd'):
            Recording(tmp_path / 'bag')
        with pytest.raises(RecordingError, match='zstd'):
            Recording(file)
        # As after the command in the error.
        with open(file, 'rb') as source, open(file.with_suffix(''), 'wb') as target:
            zstandard.ZstdDecompressor().copy_stream(source, target)
    assert_read(tmp_path / 'bag')


def test_messages_without_a_timestamp_are_read_with_their_log_time(tmp_path):
    path = write(tmp_path / 'a.mcap', 'cdr', ROS2, lambda t, n, b: cdr(0, n, b))
    causes = [f'message with header.stamp 0 on /{name}/imu/mag, read with its log time'
              for name in NAMES]
    assert_read(path, causes)
    path = write(tmp_path / 'b.mcap', 'json', ROS2, lambda t, n, b: in_json(0, n, b))
    assert_read(path, causes)
    # Some messages have no timestamp.
    path = write(tmp_path / 'd.mcap', 'cdr', ROS2, lambda t, n, b: cdr(t * (n != 'ab'), n, b)
                 if t % 7 else cdr(0, n, b))
    found = mt.read_recording(path, network())
    n_zero = sum(t % 7 == 0 and n != 'ab' for t, n, _ in readings())
    assert count_of(found.rejected, '/ab/imu/mag, ') == N // 4
    assert sum(found.rejected.values()) == N // 4 + n_zero > N // 4
    assert len(found.rejected) == len(NAMES) and all(
        count_of(found.rejected, f'/{name}/imu/mag') for name in NAMES)
    assert len(found.readings) == N - n_zero
    # The first message of a simulation has the timestamp 0.
    path = write(tmp_path / 'c.mcap', 'cdr', ROS2, lambda t, n, b: cdr(t - EPOCH_S * 10**9, n, b))
    found = mt.read_recording(path, network())
    assert found.readings.stamp_ns[0] == 0 and not found.rejected


@pytest.mark.parametrize('topic', ['/imu/mag', '/mag_1/imu/mag'])
def test_sensors_on_one_topic_are_told_apart_by_their_frame(topic, tmp_path):
    assert_read(write(tmp_path / 'a.mcap', 'cdr', ROS2, cdr, topic))
    path = write(tmp_path / 'b.mcap', 'cdr', ROS2,
                 lambda *m: cdr(*m, frame=f'{m[1]}_link'), topic)
    with pytest.raises(RecordingError, match='frame_ids a_link, ab_link, abc_link, mag_1_link'):
        mt.read_recording(path, network())


def test_a_driver_may_change_its_frame_once(tmp_path):
    assert_read(write(tmp_path / 'a.mcap', 'cdr', ROS2, lambda t, n, b: cdr(
        t, n, b, frame=f'{n}_link' if t > EPOCH_S * 10**9 + 10**9 else n)))
