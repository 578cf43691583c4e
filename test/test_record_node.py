"""Recording over the real middleware: equal to what was published, and every loss is told."""

import argparse
import csv
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter

import numpy as np
import pytest
import rclpy
from conftest import NETWORK_FILE, ROOT, vehicle_path
from geometry_msgs.msg import PoseStamped
from mcap.reader import make_reader
from node_processes import call, start, stop
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import Imu, MagneticField
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from mag_tracking.cli import record
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.io.bag import Recording
from mag_tracking.io.recorder import Recorder
from mag_tracking.io.recording_repair import repair
from mag_tracking.io.schema import decode
from mag_tracking.nodes import record_node
from mag_tracking.nodes.definitions import definition_of
from mag_tracking.nodes.record_node import RecordNode, Selection
from mag_tracking.nodes.stage_node import LATCHED, STREAM
from mag_tracking.offline import replay
from mag_tracking.pipeline import settings_for

pytestmark = pytest.mark.timeout(120)
S = 10**9
FIELDS = ('/mag_1/imu/mag', '/mag_2/imu/mag')
IMUS = ('/mag_1/imu/data_raw', '/mag_2/imu/data_raw')
COMMAND = ('import argparse, sys; from mag_tracking.cli import record; '
           'p = argparse.ArgumentParser(); record.add(p.add_subparsers()); '
           'a = p.parse_args(); sys.exit(a.run_command(a))')


def arguments_of(*words):
    """The parsed command line."""
    parser = argparse.ArgumentParser()
    record.add(parser.add_subparsers())
    return parser.parse_args([str(w) for w in words])


def recording_process(out, *options):
    """`mag-tracking record` in a process of its own, when it listens."""
    process = subprocess.Popen(
        [sys.executable, '-u', '-c', COMMAND, 'record', '--network', NETWORK_FILE, '--out', out,
         *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    line = process.stdout.readline()
    assert f'recording into {out}' in line, line + process.stdout.read()
    return process


def segments_of(pid):
    """Names in /dev/shm that a process has open."""
    files = [os.path.realpath(f'/proc/{pid}/fd/{n}') for n in os.listdir(f'/proc/{pid}/fd')]
    with open(f'/proc/{pid}/maps') as stream:
        files += [line.split()[-1] for line in stream]
    return {f.removeprefix('/dev/shm/') for f in files if f.startswith('/dev/shm/')}


def contents(path, topics):
    """{topic: [message as text]}; text, as the padding of the bytes is not defined."""
    out = {t: [] for t in topics}
    for m in Recording(path).messages(topics):
        out[m.topic].append(repr(decode(m)))
    return out


def poses(folder):
    """poses.csv as an array."""
    with open(folder / 'poses.csv', newline='') as stream:
        rows = list(csv.DictReader(stream))
    return np.array([[float(r[c]) for c in ('stamp_ns', 'x', 'y', 'vx', 'mx', 'weight')]
                     for r in rows])


def test_a_replay_that_is_recorded_is_the_same_recording(ros, tmp_path, road_network):
    """Every message, also for rosbags; and the same track. SIGTERM ends it cleanly."""
    before = set(os.listdir('/dev/shm'))
    original, out = vehicle_path('straight_car_right'), tmp_path / 'night'
    process = recording_process(out)
    player = start('replay_node', '-p', f'recording:={original}', '-p', 'rate:=5.0',
                   '-p', 'paused:=true', '-p', 'wait_for_subscribers:=30.0')
    expected = {t: n for t, n in Recording(original).message_counts.items() if '/imu/' in t}
    assert set(expected) == {*FIELDS, *IMUS}
    try:
        assert any('4 of 4 topics' in line for line in process.stdout)
        # What they have found has still to find them.
        time.sleep(1.0)
        assert call(ros, Trigger, '/replay_node/resume', Trigger.Request()).success
        assert 'messages played' in player.stdout.readline()
        time.sleep(0.2)
        used = segments_of(process.pid) - before
    finally:
        stop([player])
        process.send_signal(signal.SIGTERM)
        output = process.communicate(timeout=30)[0]
    assert process.returncode == 0 and 'warning' not in output, output
    for topic, n in expected.items():
        assert f'  {topic}  {n}\n' in output, output
    assert f'{out}: {sum(expected.values())} messages' in output
    theirs, ours = contents(original, expected), contents(out, expected)
    assert theirs == ours and set(Recording(out).types) == set(expected)
    with AnyReader([out], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        counts = Counter(c.topic for c, _, raw in reader.messages()
                         if reader.deserialize(raw, c.msgtype))
    assert counts == expected
    with open(out / 'night_0.mcap', 'rb') as stream:
        times = [m.log_time for _, _, m in make_reader(stream).iter_messages(log_time_order=False)]
    # In order also across topics, but for what comes between the fetches of two.
    assert np.mean(np.diff(times) >= 0) > 0.9
    patient = settings_for('vehicle', {'align.max_wait_s': 5.0})
    for path in (original, out):
        replay(Recording(path), road_network, patient, tmp_path / f'of_{path.stem}')
    np.testing.assert_allclose(*(poses(tmp_path / f'of_{path.stem}') for path in (original, out)),
                               rtol=1e-9, atol=1e-12)
    left = {n for n in used & set(os.listdir('/dev/shm')) if not n.startswith('sem.')}
    assert used and not left


def test_a_kill_of_the_command_loses_less_than_a_second(ros, tmp_path):
    node, spin_until = ros
    shm = set(os.listdir('/dev/shm'))
    sent = []
    publisher = node.create_publisher(MagneticField, FIELDS[0], STREAM)

    def publish():
        message = MagneticField()
        message.header.stamp.nanosec = len(sent)
        sent.append(time.time_ns())
        publisher.publish(message)
    process = recording_process(tmp_path / 'a')
    try:
        node.create_timer(0.005, publish)
        # Some chunks are in the file, and the next is in the making.
        assert spin_until(lambda: sum(
            p.stat().st_size for p in (tmp_path / 'a').glob('*.mcap')) > 6000)
        n = len(sent)
        spin_until(lambda: len(sent) > n + 150)
    finally:
        used = segments_of(process.pid)
        process.kill()
        killed = time.time_ns()
        process.communicate()
        # A killed process leaves its segments; those that were there before are ours.
        for name in used - shm & set(os.listdir('/dev/shm')):
            os.unlink(f'/dev/shm/{name}')
    messages = list(Recording(tmp_path / 'a').messages())
    numbers = [decode(m).header.stamp.nanosec for m in messages]
    assert numbers == sorted(set(numbers)) and len(numbers) > 100
    print(f'lost: {(killed - sent[numbers[-1]]) / S:.2f} s')
    assert killed - sent[numbers[-1]] < S
    # Received after it was sent, and soon: the time is of the arrival, not of the fetching.
    delays = [m.log_time_ns - sent[k] for m, k in zip(messages, numbers, strict=True)]
    assert min(delays) > 0 and np.median(delays) < record_node.POLL_S * S / 4
    assert repair(tmp_path / 'a', report=lambda _: None) == 1
    with Reader(tmp_path / 'a') as reader:
        assert reader.message_count == len(numbers)


class Desk:
    """A RecordNode in this process, and what it says."""

    def __init__(self, folder, selection, **arguments):
        self.told = []
        self.recorder = Recorder(folder, report=self.told.append, **arguments)
        self.node = RecordNode(self.recorder, selection, self.told.append)

    def until(self, condition, seconds=20.0):
        """Record until `condition()`; whether it came."""
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self.node.discover()
            self.node.poll()
            self.recorder.tick(time.monotonic_ns())
            time.sleep(0.01)
        return bool(condition())

    def close(self):
        """Finish the recording."""
        if self.node is not None:
            self.node.poll()
            self.recorder.close()
            self.node.destroy_node()
            self.node = None


@pytest.fixture
def desk(ros, tmp_path):
    """Makes desks, which it closes."""
    made = []

    def make(selection, **arguments):
        made.append(Desk(tmp_path / f'desk_{len(made)}', selection, **arguments))
        return made[-1]
    yield make
    for d in made:
        d.close()


def test_what_is_selected(ros, desk):
    node, _ = ros
    imu, names = IMUS[0], {
        FIELDS[0]: MagneticField, FIELDS[0] + '_calibrated': MagneticField, '/other': Header,
        '/tracker_node/pose': PoseStamped, '/_hidden': Header, '/_named': Header}
    publishers = [node.create_publisher(c, t, STREAM) for t, c in {**names, imu: Imu}.items()]
    desks = {frozenset({FIELDS[0], imu}): desk(Selection(FIELDS, IMUS)),
             frozenset({FIELDS[0], imu, '/other', '/_named'}): desk(
                 Selection(FIELDS, IMUS, ('/other', '/_named', '/never'))),
             frozenset({FIELDS[0], FIELDS[0] + '_calibrated', '/tracker_node/pose', imu}): desk(
                 Selection(FIELDS, IMUS, results=True)),
             frozenset({imu, *names} - {'/_hidden', '/_named'}): desk(
                 Selection(FIELDS, IMUS, everything=True))}

    def publish_all():
        for p in publishers:
            p.publish(p.msg_type())
        return all(d.recorder.counts.keys() >= topics for topics, d in desks.items())
    end = time.monotonic() + 20.0
    while not publish_all() and time.monotonic() < end:
        for d in desks.values():
            d.until(lambda: True)
            d.node.discover()
            d.node.poll()
        time.sleep(0.02)
    for topics, d in desks.items():
        found = set(d.recorder.counts) - {'/rosout', '/parameter_events'}
        assert found == topics, topics ^ found
        assert d.node.refused == {} == d.node.lost and d.told == []


def test_what_overflows_the_queue_is_counted(ros, desk, monkeypatch):
    monkeypatch.setattr(record_node, 'DEPTHS', {record_node.MAGNETIC_FIELD: 30})
    node, _ = ros
    publisher = node.create_publisher(MagneticField, FIELDS[0], QoSProfile(depth=500))
    d = desk(Selection(FIELDS[:1]))

    def publish(n):
        for _ in range(n):
            publisher.publish(MagneticField())
    assert d.until(lambda: publish(1) or d.recorder.counts[FIELDS[0]] > 0)
    d.until(lambda: False, 0.3)
    assert d.node.lost == {}
    n = d.recorder.counts[FIELDS[0]]
    publish(100)
    time.sleep(0.2)
    publish(1)
    d.until(lambda: d.node.lost, 5.0)
    d.until(lambda: False, 0.1)
    assert d.node.lost == {FIELDS[0]: 101 - (d.recorder.counts[FIELDS[0]] - n)}
    assert d.node.lost[FIELDS[0]] >= 60
    # The numbers begin anew before the change of publishers is known.
    before, n = d.node.lost, d.recorder.counts[FIELDS[0]]
    node.destroy_publisher(publisher)
    publisher = node.create_publisher(MagneticField, FIELDS[0], STREAM)
    end = time.monotonic() + 20.0
    while d.recorder.counts[FIELDS[0]] == n and time.monotonic() < end:
        publish(1)
        time.sleep(0.01)
        d.node.poll()
    assert d.recorder.counts[FIELDS[0]] > n and d.node.lost == before
    lines = list(record_node.summary(d.recorder, Selection(FIELDS, topics=('/gone',)), d.node.lost,
                                     {'/odd': 'odd_msgs/msg/Odd is not installed'}))
    assert f'  warning: {FIELDS[0]}: lost before they were recorded: ' \
           f'{d.node.lost[FIELDS[0]]}' in lines
    assert [x for x in lines if 'nothing on' in x] == [
        f'  warning: nothing on {FIELDS[1]}', '  warning: nothing on /gone']
    assert '  warning: /odd is not recorded: odd_msgs/msg/Odd is not installed' in lines


def test_a_publisher_that_begins_anew_or_a_second_one_is_no_loss(ros, desk):
    node, _ = ros
    d = desk(Selection(FIELDS[:1]))
    total = 0
    for _ in range(2):
        publisher = node.create_publisher(MagneticField, FIELDS[0], STREAM)
        assert d.until(publisher.get_subscription_count)
        for _ in range(20):
            publisher.publish(MagneticField())
        total += 20
        assert d.until(lambda: d.recorder.counts[FIELDS[0]] == total)  # noqa: B023
        node.destroy_publisher(publisher)
    pair = [node.create_publisher(MagneticField, FIELDS[0], STREAM) for _ in range(2)]
    assert d.until(lambda: all(p.get_subscription_count() for p in pair)
                   and node.count_publishers(FIELDS[0]) == 2)
    for k in range(40):
        for _ in range(1 + k % 3):
            pair[k % 2].publish(MagneticField())
        total += 1 + k % 3
        d.until(lambda: True)
    assert d.until(lambda: d.recorder.counts[FIELDS[0]] == total)
    assert d.node.lost == {}


def test_latched_messages_and_a_later_publisher_that_has_none(ros, desk):
    node, _ = ros
    early = node.create_publisher(Header, '/calibration_node/calibration', LATCHED)
    early.publish(Header(frame_id='early'))
    d = desk(Selection((), results=True), split_bytes=2000)
    topic = '/calibration_node/calibration'
    assert d.until(lambda: d.recorder.counts[topic] == 1)
    volatile = node.create_publisher(Header, topic, QoSProfile(
        depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    assert d.until(volatile.get_subscription_count)
    for k in range(60):
        volatile.publish(Header(frame_id=f'late {k}'))
        assert d.until(lambda: d.recorder.counts[topic] == 2 + k)  # noqa: B023
    d.close()
    files = sorted(d.recorder.folder.glob('*.mcap'), key=lambda p: int(p.stem.split('_')[-1]))
    assert len(files) > 1
    for n, file in enumerate(files):
        said = [decode(m).frame_id for m in Recording(file).messages([topic])]
        assert (said[0] == 'early') == (n == 0)
        if n:
            previous = [decode(m).frame_id for m in Recording(files[n - 1]).messages([topic])]
            assert said[0] == previous[-1]
    with Reader(d.recorder.folder) as reader:
        (connection,) = reader.connections
    assert connection.ext.offered_qos_profiles[0].durability.name == 'TRANSIENT_LOCAL'


def test_other_types_are_told(desk):
    # In one and the same context the middleware would refuse two types of one topic.
    context = rclpy.Context()
    context.init()
    node = Node('stranger', context=context)
    node.create_publisher(Header, FIELDS[0], STREAM)
    try:
        d = desk(Selection(FIELDS[:1]))
        assert d.until(lambda: d.told)
        d.until(lambda: False, 0.3)
    finally:
        node.destroy_node()
        context.shutdown()
    assert d.told == [f'{FIELDS[0]} as std_msgs/msg/Header is not recorded: it is expected as '
                      'sensor_msgs/msg/MagneticField']


def test_the_command_in_this_process(tmp_path, monkeypatch, capsys):
    """Lines of progress, a SIGINT, the summary; a best-effort driver's QoS is noted."""
    monkeypatch.setattr(record_node, 'LINE_S', 0.2)
    stopped = threading.Event()

    def drive():
        while not rclpy.ok() and not stopped.wait(0.01):
            pass
        node = Node('driver')
        publisher = node.create_publisher(MagneticField, FIELDS[0], QoSProfile(
            depth=10, reliability=ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.VOLATILE))
        end = time.monotonic() + 2.5
        while time.monotonic() < end:
            publisher.publish(MagneticField())
            time.sleep(0.01)
        last = MagneticField()
        last.header.frame_id = 'last'
        publisher.publish(last)
        time.sleep(0.003)
        os.kill(os.getpid(), signal.SIGINT)
        node.destroy_node()
    driver = threading.Thread(target=drive)
    driver.start()
    args = arguments_of('record', '--network', NETWORK_FILE, '--out', tmp_path / 'a',
                        '--split-s', 1)
    try:
        assert args.run_command(args) == 0
    finally:
        stopped.set()
        driver.join()
    out, err = capsys.readouterr()
    n = Recording(tmp_path / 'a').message_counts[FIELDS[0]]
    assert len(list((tmp_path / 'a').glob('*.mcap'))) > 1
    assert n > 50 and f'  {FIELDS[0]}  {n}\n  warning: nothing on {FIELDS[1]}\n' in out
    assert decode(list(Recording(tmp_path / 'a').messages())[-1]).header.frame_id == 'last'
    assert err.count(' s: ') >= 3 and ' messages, 0.0 MB' in err
    with Reader(tmp_path / 'a') as reader:
        assert reader.connections[0].ext.offered_qos_profiles[0].reliability.name == 'BEST_EFFORT'


def test_what_the_options_mean(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(record_node, 'run', lambda *a: calls.append(a) or 7)
    words = ('record', '--network', NETWORK_FILE, '--out', tmp_path)
    for more in ((), ('--topics', '/a', '/b', '--split-mb', 0.5, '--split-s', 60, '--all'),
                 ('--results',)):
        args = arguments_of(*words, *more)
        assert args.run_command(args) == 7
    assert calls == [
        (Selection(FIELDS, IMUS), tmp_path, 10**9, 3600 * S),
        (Selection(FIELDS, IMUS, ('/a', '/b'), everything=True), tmp_path, 500_000, 60 * S),
        (Selection(FIELDS, IMUS, results=True), tmp_path, 10**9, 3600 * S)]


@pytest.mark.parametrize(('options', 'message'), [
    (('--split-mb', '0'), '--split-mb: 0 is not a number of at least 0.1'),
    (('--split-mb', 'nan'), '--split-mb: nan'), (('--split-s', 'inf'), '--split-s: inf'),
    (('--split-s', '-5'), '--split-s: -5'), (('--topics', '/a', 'imu'), "--topics: 'imu'")])
def test_bad_options_are_named(tmp_path, options, message):
    args = arguments_of('record', '--network', NETWORK_FILE, '--out', tmp_path / 'a', *options)
    with pytest.raises(SettingsError, match=message):
        args.run_command(args)
    assert not (tmp_path / 'a').exists()


def test_another_recording_is_not_touched(tmp_path):
    (tmp_path / 'a_0.mcap').write_text('theirs')
    args = arguments_of('record', '--network', NETWORK_FILE, '--out', tmp_path)
    with pytest.raises(OutputError, match='holds a recording already'):
        args.run_command(args)
    assert not rclpy.ok() and [p.name for p in tmp_path.iterdir()] == ['a_0.mcap']


def test_the_command_repair(tmp_path, capsys):
    with Recorder(tmp_path / 'a') as recorder:
        recorder.add_topic('/x', 'std_msgs/msg/Header')
        recorder.write('/x', b'\0\1\0\0', 1)
    file = tmp_path / 'a' / 'a_0.mcap'
    file.write_bytes(file.read_bytes()[:-20])
    args = arguments_of('repair', tmp_path / 'a')
    assert args.run_command(args) == 0
    assert capsys.readouterr().out == (f'a_0.mcap: 1 messages, index written\n{tmp_path / "a"}: '
                                       'files that were not whole: 1\n')
    assert Recording(tmp_path / 'a').message_counts == {'/x': 1}


@pytest.mark.parametrize('type_name', [
    'sensor_msgs/msg/Imu', 'diagnostic_msgs/msg/DiagnosticArray', 'nav_msgs/msg/Odometry',
    'sensor_msgs/msg/PointCloud2', 'visualization_msgs/msg/MarkerArray',
    'rcl_interfaces/msg/ParameterEvent', 'nav_msgs/msg/Path', 'rosgraph_msgs/msg/Clock'])
def test_definitions_are_those_of_ros(type_name):
    """As rosbags has them of its own: every type, field and constant."""
    store = get_typestore(Stores.ROS2_JAZZY)
    found = get_types_from_msg(definition_of(type_name), type_name)
    needed = {type_name}
    while more := {n for t in needed for n in names_in(store.fielddefs[t])} - needed:
        needed |= more
    assert set(found) == needed
    assert found == {name: store.fielddefs[name] for name in needed}


def names_in(definition):
    """The message types that a type of rosbags names."""
    def walk(node):
        if isinstance(node, str):
            return {node} if '/msg/' in node else set()
        return set().union(*map(walk, node)) if isinstance(node, (tuple, list)) else set()
    return walk(definition[1])


def test_definitions_of_our_own_and_of_unknown_types(monkeypatch, tmp_path):
    ours = definition_of('mag_tracking_msgs/msg/HypothesisArray')
    assert ours.count('MSG: mag_tracking_msgs/Hypothesis\n') == 1
    assert ours.startswith((ROOT / 'msg_defs/msg/HypothesisArray.msg').read_text())
    assert definition_of('odd_msgs/msg/Odd') is None
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    folder = tmp_path / 'share' / 'new_msgs' / 'msg'
    folder.mkdir(parents=True)
    (folder / 'Outer.msg').write_text('int8 N=3 # Inner x\nInner[<=3] inner\nstring<=4 s "a/b c"')
    (folder / 'Inner.msg').write_text('float64[2] v\n# Odd odd\n')
    text = definition_of('new_msgs/msg/Outer')
    assert text.count('MSG: ') == 1 and text.endswith('MSG: new_msgs/Inner\nfloat64[2] v\n'
                                                      '# Odd odd\n')
    (folder / 'Inner.msg').unlink()
    definition_of.cache_clear()
    assert definition_of('new_msgs/msg/Outer') is None
