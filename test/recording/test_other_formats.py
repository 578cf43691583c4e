"""SQLite and ROS 1 bags, JSON and protobuf messages and tables give the same results as MCAP."""

import json

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

import mag_tracking as mt
from mag_tracking.cli import main
from mag_tracking.errors import RecordingError
from mag_tracking.messages.encodings import field_decoder
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.recording.reader import Recording
from support.bundled import NETWORK_FILE, QUICK, vehicle_path
from support.counters import assert_counts

NAME = 'straight_car_right'
HEADER = 'std_msgs/msg/Header'


@pytest.fixture(scope='module')
def source():
    return Recording(vehicle_path(NAME))


@pytest.fixture(scope='module')
def expected():
    return mt.track(vehicle_path(NAME), NETWORK_FILE, settings=QUICK)


def write_sqlite_bag(source, folder):
    """Write a recording as an SQLite bag with `rosbags`."""
    types = get_typestore(Stores.ROS2_JAZZY)
    with Ros2Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=types)
                       for topic, kind in source.types.items()}
        for m in source.messages():
            writer.write(connections[m.topic], m.log_time_ns, m.data)
    return folder


def write_ros1_bag(source, path):
    """Write a recording as a ROS 1 bag with `rosbags`."""
    ros2, ros1 = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(path) as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=ros1)
                       for topic, kind in source.types.items()}
        for k, m in enumerate(source.messages()):
            message = ros2.deserialize_cdr(m.data, m.type)
            fields = {name: getattr(message, name) for name in message.__dataclass_fields__
                      if not name.startswith('__')}
            fields['header'] = ros1.types[HEADER](
                seq=k, stamp=message.header.stamp, frame_id=message.header.frame_id)
            writer.write(connections[m.topic], m.log_time_ns,
                         ros1.serialize_ros1(ros1.types[m.type](**fields), m.type))
    return path


def assert_equal_results(result, expected):
    for table in ('poses', 'smoothed', 'detections'):
        np.testing.assert_array_equal(getattr(result, table), getattr(expected, table), table)
    assert result.errors() == expected.errors()
    assert result.report.rejected == expected.report.rejected


@pytest.mark.parametrize('kind', ['folder', 'db3', 'bag'])
def test_a_bag_gives_the_same_result_as_the_mcap_file(kind, source, expected, tmp_path):
    if kind == 'bag':
        path = write_ros1_bag(source, tmp_path / 'one.bag')
    else:
        path = write_sqlite_bag(source, tmp_path / 'two')
        path = path if kind == 'folder' else path / 'two.db3'
    found = Recording(path)
    assert found.types == source.types and found.message_counts == source.message_counts
    assert (found.start_ns, found.end_ns) == (source.start_ns, source.end_ns)
    done = []
    n = sum(1 for _ in found.messages(progress=done.append))
    assert n == source.message_counts.total() and sum(done) == found.size
    assert_equal_results(mt.track(path, NETWORK_FILE, settings=QUICK), expected)


@pytest.mark.parametrize('kind', ['db3', 'bag'])
@pytest.mark.parametrize('fraction', [0.0, 0.1, 0.5, 0.9])
def test_a_truncated_bag_is_refused_or_read_up_to_its_end(kind, fraction, source, tmp_path):
    path = write_ros1_bag(source, tmp_path / 'one.bag') if kind == 'bag' \
        else write_sqlite_bag(source, tmp_path / 'two') / 'two.db3'
    data = bytearray(path.read_bytes())
    path.write_bytes(data[:int(fraction * len(data))])
    try:
        recording = Recording(path)
        n = sum(1 for _ in recording.messages())
    except RecordingError as error:
        assert str(path) in str(error)
    else:
        assert n < source.message_counts.total() and recording.losses


@pytest.mark.parametrize('kind, seed', [('db3', 0), *(('bag', seed) for seed in range(6))])
def test_flipped_bytes_in_a_bag_do_not_crash_the_reader(kind, seed, source, tmp_path):
    path = write_ros1_bag(source, tmp_path / 'one.bag') if kind == 'bag' \
        else write_sqlite_bag(source, tmp_path / 'two') / 'two.db3'
    data, rng = bytearray(path.read_bytes()), np.random.default_rng(seed)
    for k in rng.integers(4096, len(data), 300 if kind == 'db3' else 20):
        data[k] ^= 0xFF
    path.write_bytes(data)
    try:
        read = mt.read_recording(path, NETWORK_FILE)
    except RecordingError as error:
        assert 'a bag' in str(error)
    else:
        assert len(read.readings) <= 2800


def write_mcap(path, encoding, schema, messages):
    """Write an MCAP file with the given messages [(topic, time [ns], bytes)]."""
    with open(path, 'wb') as stream:
        writer = Writer(stream)
        writer.start()
        name, schema_encoding, content = schema
        schema = writer.register_schema(name, schema_encoding, content)
        channels = {}
        for topic, time_ns, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], time_ns, data, time_ns)
        writer.finish()
    return path


def fields_of(source):
    """Read a recording as a list of (topic, timestamp [ns], field (3,) [T])."""
    read = mt.read_recording(source.path, NETWORK_FILE).readings
    return [(f'/{name}/imu/mag', stamp, field) for name, stamp, field in zip(
        read.sensor_names(), read.stamp_ns.tolist(), read.field, strict=True)]


SCHEMA = json.dumps({'type': 'object', 'properties': {
    'header': {'type': 'object'}, 'magnetic_field': {'type': 'object'}}}).encode()


@pytest.mark.parametrize('seconds, nanoseconds', [('sec', 'nanosec'), ('sec', 'nsec')])
def test_json_messages_of_a_magnetic_field_are_read(seconds, nanoseconds, source, expected,
                                                    tmp_path):
    messages = [(topic, t, json.dumps({
        'header': {'stamp': {seconds: t // 10**9, nanoseconds: t % 10**9}, 'frame_id': ''},
        'magnetic_field': dict(zip('xyz', b.tolist(), strict=True))}).encode())
        for topic, t, b in fields_of(source)]
    path = write_mcap(tmp_path / 'json.mcap', 'json', ('Magnetic', 'jsonschema', SCHEMA), messages)
    assert set(Recording(path).types.values()) == {MAGNETIC_FIELD}
    found = mt.track(path, NETWORK_FILE, settings=QUICK)
    np.testing.assert_array_equal(found.poses, expected.poses)


@pytest.mark.parametrize('stamp, tolerance_ns', [
    ({'sec': '1790000000', 'nanosec': '250000001'}, 0), ('1790000000250000001', 0),
    (1_790_000_000_250_000_001, 0), (1_790_000_000_250, 1), (1_790_000_000.250000001, 300)])
def test_the_time_of_a_json_message_may_be_text_of_digits_or_a_number(stamp, tolerance_ns):
    found = field_decoder('json', 'M', SCHEMA)(json.dumps({
        'stamp': stamp, 'magnetic_field': {'x': 1e-5, 'y': None, 'z': 2}}).encode())
    assert found['header']['stamp']['sec'] == 1_790_000_000
    assert abs(found['header']['stamp']['nanosec'] - 250_000_001) <= tolerance_ns


@pytest.mark.parametrize('change, cause', [
    (lambda m: m.pop('magnetic_field'), '^magnetic_field$'),
    (lambda m: m.pop('header'), 'header.stamp or timestamp'),
    (lambda m: m['header'].update(stamp={'sec': 'x'}), 'sec in'),
    (lambda m: m['header'].update(stamp={'sec': True, 'nanosec': 0}), 'sec in'),
    (lambda m: m['header']['stamp'].update(sec=10**10), ' sec .*: 1'),
    (lambda m: m['header']['stamp'].update(nanosec=10**25), 'nanosec .*: 1'),
    (lambda m: m['magnetic_field'].pop('z'), r'magnetic_field\.z$'),
    (lambda m: m['header'].update(stamp='noon'), '^sec .*text$'),
    (lambda m: m['header'].update(stamp=12.5), '1970'),
    (lambda m: m['magnetic_field'].update(z='1'), r'magnetic_field\.z$'),
    (lambda m: m.update(magnetic_field_covariance=[1.0]), 'covariance'),
    (lambda m: m.update(magnetic_field=3.0), r'magnetic_field\.x$')])
def test_invalid_json_messages_are_rejected(change, cause, tmp_path):
    message = {'header': {'stamp': {'sec': 1, 'nanosec': 2}},
               'magnetic_field': {'x': 1e-5, 'y': None, 'z': 2}}
    read = field_decoder('json', 'M', SCHEMA)
    good = read(json.dumps(message).encode())
    assert np.isnan(good['magnetic_field']['y']) and good['header']['stamp']['nanosec'] == 2
    change(message)
    bad = json.dumps(message).encode()
    with pytest.raises(ValueError, match=cause):
        read(bad)
    rest = json.dumps({'header': {'stamp': {'sec': 1, 'nanosec': 2}},
                       'magnetic_field': {'x': 1e-5, 'y': None, 'z': 2}}).encode()
    for last, n in ((rest, 1), (b'', 0)):
        path = write_mcap(tmp_path / 'a.mcap', 'json', ('M', 'jsonschema', SCHEMA), [
            ('/mag_1/imu/mag', k, data)
            for k, data in enumerate((bad, b'\xff{', b'[' * 100_000, last))])
        if n == 0:
            with pytest.raises(RecordingError, match='no message'):
                mt.read_recording(path, NETWORK_FILE)
            continue
        found = mt.read_recording(path, NETWORK_FILE)
        assert len(found.readings) == n and sum(found.rejected.values()) == 3
        assert all('/mag_1/imu/mag' in cause for cause in found.rejected)


def protobuf_class():
    """Create a message class with timestamp and magnetic_field; return class and descriptors."""
    double, integer, message = (FieldDescriptorProto.TYPE_DOUBLE, FieldDescriptorProto.TYPE_INT64,
                                FieldDescriptorProto.TYPE_MESSAGE)
    file = FileDescriptorProto(name='m.proto', package='lab', syntax='proto3')
    for name, fields in (('Time', (('seconds', integer, ''), ('nanos', integer, ''))),
                         ('Vector', tuple((a, double, '') for a in 'xyz')),
                         ('Magnetic', (('timestamp', message, '.lab.Time'),
                                       ('magnetic_field', message, '.lab.Vector')))):
        kind = file.message_type.add(name=name)
        for k, (field, type_, type_name) in enumerate(fields):
            kind.field.add(name=field, number=k + 1, type=type_, type_name=type_name or None,
                           label=FieldDescriptorProto.LABEL_OPTIONAL)
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    pool = DescriptorPool()
    pool.Add(file)
    return (GetMessageClass(pool.FindMessageTypeByName('lab.Magnetic')),
            FileDescriptorSet(file=[file]).SerializeToString())


def test_protobuf_messages_of_a_magnetic_field_are_read(source, expected, tmp_path):
    Magnetic, descriptors = protobuf_class()
    messages = []
    for topic, t, b in fields_of(source):
        m = Magnetic()
        m.timestamp.seconds, m.timestamp.nanos = divmod(t, 10**9)
        m.magnetic_field.x, m.magnetic_field.y, m.magnetic_field.z = b.tolist()
        messages.append((topic, t, m.SerializeToString()))
    path = write_mcap(tmp_path / 'p.mcap', 'protobuf', ('lab.Magnetic', 'protobuf', descriptors),
                      messages)
    found = mt.track(path, NETWORK_FILE, settings=QUICK)
    np.testing.assert_array_equal(found.poses, expected.poses)


@pytest.mark.parametrize('part, cause', [
    ('timestamp', 'header.stamp or timestamp'),
    ('magnetic_field', 'without magnetic_field')])
def test_protobuf_messages_without_a_part_are_rejected_by_its_name(part, cause, tmp_path):
    """Protobuf does not encode default values, so a message that was not set reads as zero."""
    Magnetic, descriptors = protobuf_class()
    messages = []
    for k in range(100):
        m = Magnetic()
        # The value 0 of a field that was set is a reading.
        m.timestamp.seconds, m.magnetic_field.x = 1_790_000_000 + k, 1e-5 if k else 0.0
        if k % 4 == 1:
            m.ClearField(part)
        messages.append(('/mag_1/imu/mag', k, m.SerializeToString()))
    found = mt.read_recording(write_mcap(
        tmp_path / 'p.mcap', 'protobuf', ('lab.Magnetic', 'protobuf', descriptors), messages),
        NETWORK_FILE)
    assert_counts(found.rejected, {f'{cause} on /mag_1/imu/mag': 25})
    assert len(found.readings) == 75 and found.readings.stamp_ns.min() == 1_790_000_000 * 10**9


def test_a_table_of_readings_becomes_a_recording(source, expected, tmp_path, capsys):
    rows = fields_of(source)
    table = tmp_path / 'long.csv'
    table.write_text('t;id'.replace(';', ', ') + ', bx, by, bz\n' + '\n'.join(
        f'{t}, {topic[5]}, ' + ', '.join(repr(float(v) / 1e-6) for v in b)
        for topic, t, b in rows[::-1]))
    assert main(['import', str(table), '--columns', 'time=t', 'sensor=id', 'x=bx', 'y=by', 'z=bz',
                 '--unit', 'uT', '--time-unit', 'ns', '--out', str(tmp_path / 'out')]) == 0
    assert '/mag_1/imu/mag  1400' in capsys.readouterr().out
    result = mt.track(tmp_path / 'out', NETWORK_FILE, settings=QUICK)
    np.testing.assert_allclose(result.poses['position'], expected.poses['position'], rtol=1e-6)
