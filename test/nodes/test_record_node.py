"""The recording node: what it selects, and every loss is told."""

import time

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import Imu, MagneticField
from std_msgs.msg import Header

from mag_tracking.apps.record import Selection, summary
from mag_tracking.messages.types import decode
from mag_tracking.nodes import record_node
from mag_tracking.nodes.record_node import RecordNode
from mag_tracking.nodes.stage_node import LATCHED, STREAM
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.recorder import Recorder
from support.node_processes import MAX_S
from support.recorded_topics import FIELDS, IMUS

pytestmark = pytest.mark.timeout(600)


class Desk:
    """A RecordNode in this process, and what it says."""

    def __init__(self, folder, selection, **arguments):
        self.told = []
        self.recorder = Recorder(folder, report=self.told.append, **arguments)
        self.node = RecordNode(self.recorder, selection, self.told.append)

    def until(self, condition, seconds=MAX_S):
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
    end = time.monotonic() + MAX_S
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
    d.until(lambda: d.node.lost)
    d.until(lambda: False, 0.1)
    assert d.node.lost == {FIELDS[0]: 101 - (d.recorder.counts[FIELDS[0]] - n)}
    assert d.node.lost[FIELDS[0]] >= 60
    # The numbers begin anew before the change of publishers is known.
    before, n = d.node.lost, d.recorder.counts[FIELDS[0]]
    node.destroy_publisher(publisher)
    publisher = node.create_publisher(MagneticField, FIELDS[0], STREAM)
    end = time.monotonic() + MAX_S
    while d.recorder.counts[FIELDS[0]] == n and time.monotonic() < end:
        publish(1)
        time.sleep(0.01)
        d.node.poll()
    assert d.recorder.counts[FIELDS[0]] > n and d.node.lost == before
    lines = list(summary(d.recorder, Selection(FIELDS, topics=('/gone',)), d.node.lost,
                                     {'/odd': 'odd_msgs/msg/Odd is not installed'}))
    assert f'  warning: {FIELDS[0]}: messages lost before recording: ' \
           f'{d.node.lost[FIELDS[0]]}' in lines
    assert [x for x in lines if 'no messages on' in x] == [
        f'  warning: no messages on {FIELDS[1]}', '  warning: no messages on /gone']
    assert '  warning: /odd was not recorded: odd_msgs/msg/Odd is not installed' in lines


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
    early = node.create_publisher(Header, '/calibration_state', LATCHED)
    early.publish(Header(frame_id='early'))
    d = desk(Selection((), results=True), split_bytes=2000)
    topic = '/calibration_state'
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
    assert d.told == [f'{FIELDS[0]} as std_msgs/msg/Header is not recorded: the topic has type '
                      'sensor_msgs/msg/MagneticField']
