"""Recording node: selection of topics, and report of every loss."""

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
from mag_tracking.nodes.stage_node import LATCHED_QOS, STREAM_QOS
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.recorder import Recorder
from support.node_processes import MAX_S
from support.recorded_topics import FIELDS, IMUS

pytestmark = pytest.mark.timeout(600)


class Session:
    """Recording in this process, with the reports of its `RecordNode`."""

    def __init__(self, folder, selection, **arguments):
        self.reports = []
        self.recorder = Recorder(folder, report=self.reports.append, **arguments)
        self.node = RecordNode(self.recorder, selection, self.reports.append)

    def until(self, condition, seconds=MAX_S):
        """Record until a condition holds, at most for `seconds`; return whether it holds."""
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
def record(ros, tmp_path):
    """Function that opens a `Session`; all sessions are closed after the test."""
    sessions = []

    def make(selection, **arguments):
        sessions.append(Session(tmp_path / f'session_{len(sessions)}', selection, **arguments))
        return sessions[-1]
    yield make
    for session in sessions:
        session.close()


def test_selected_topics_are_recorded(ros, record):
    node, _ = ros
    imu, names = IMUS[0], {
        FIELDS[0]: MagneticField, FIELDS[0] + '_calibrated': MagneticField, '/other': Header,
        '/tracker_node/pose': PoseStamped, '/_hidden': Header, '/_named': Header}
    publishers = [node.create_publisher(c, t, STREAM_QOS) for t, c in {**names, imu: Imu}.items()]
    sessions = {
        frozenset({FIELDS[0], imu}): record(Selection(FIELDS, IMUS)),
        frozenset({FIELDS[0], imu, '/other', '/_named'}): record(
            Selection(FIELDS, IMUS, ('/other', '/_named', '/never'))),
        frozenset({FIELDS[0], FIELDS[0] + '_calibrated', '/tracker_node/pose', imu}): record(
            Selection(FIELDS, IMUS, results=True)),
        frozenset({imu, *names} - {'/_hidden', '/_named'}): record(
            Selection(FIELDS, IMUS, all_topics=True))}

    def publish_all():
        for p in publishers:
            p.publish(p.msg_type())
        return all(session.recorder.counts.keys() >= topics for topics, session in sessions.items())
    end = time.monotonic() + MAX_S
    while not publish_all() and time.monotonic() < end:
        for session in sessions.values():
            session.until(lambda: True)
            session.node.discover()
            session.node.poll()
        time.sleep(0.02)
    for topics, session in sessions.items():
        recorded = set(session.recorder.counts) - {'/rosout', '/parameter_events'}
        assert recorded == topics, topics ^ recorded
        assert session.node.refused == {} == session.node.lost and session.reports == []


def test_messages_lost_in_the_queue_are_counted(ros, record, monkeypatch):
    monkeypatch.setattr(record_node, 'DEPTHS', {record_node.types.MAGNETIC_FIELD: 30})
    node, _ = ros
    publisher = node.create_publisher(MagneticField, FIELDS[0], QoSProfile(depth=500))
    session = record(Selection(FIELDS[:1]))

    def publish(n):
        for _ in range(n):
            publisher.publish(MagneticField())
    assert session.until(lambda: publish(1) or session.recorder.counts[FIELDS[0]] > 0)
    session.until(lambda: False, 0.3)
    assert session.node.lost == {}
    n = session.recorder.counts[FIELDS[0]]
    publish(100)
    time.sleep(0.2)
    publish(1)
    session.until(lambda: session.node.lost)
    session.until(lambda: False, 0.1)
    assert session.node.lost == {FIELDS[0]: 101 - (session.recorder.counts[FIELDS[0]] - n)}
    assert session.node.lost[FIELDS[0]] >= 60
    # Sequence numbers restart before the change of publishers is discovered.
    before, n = session.node.lost, session.recorder.counts[FIELDS[0]]
    node.destroy_publisher(publisher)
    publisher = node.create_publisher(MagneticField, FIELDS[0], STREAM_QOS)
    end = time.monotonic() + MAX_S
    while session.recorder.counts[FIELDS[0]] == n and time.monotonic() < end:
        publish(1)
        time.sleep(0.01)
        session.node.poll()
    assert session.recorder.counts[FIELDS[0]] > n and session.node.lost == before
    lines = list(summary(session.recorder, Selection(FIELDS, topics=('/gone',)), session.node.lost,
                         {'/odd': 'odd_msgs/msg/Odd is not installed'}))
    n_lost = session.node.lost[FIELDS[0]]
    assert any(x.startswith(f'  warning: {FIELDS[0]}: ') and x.endswith(f': {n_lost}')
               for x in lines)
    assert [x.split()[-1] for x in lines if 'no messages' in x] == [FIELDS[1], '/gone']
    assert any('/odd was' in x and 'odd_msgs/msg/Odd' in x for x in lines)


def test_a_restarted_or_second_publisher_is_no_loss(ros, record):
    node, _ = ros
    session = record(Selection(FIELDS[:1]))
    total = 0
    for _ in range(2):
        publisher = node.create_publisher(MagneticField, FIELDS[0], STREAM_QOS)
        assert session.until(publisher.get_subscription_count)
        for _ in range(20):
            publisher.publish(MagneticField())
        total += 20
        assert session.until(lambda: session.recorder.counts[FIELDS[0]] == total)  # noqa: B023
        node.destroy_publisher(publisher)
    publishers = [node.create_publisher(MagneticField, FIELDS[0], STREAM_QOS) for _ in range(2)]
    assert session.until(lambda: all(p.get_subscription_count() for p in publishers)
                         and node.count_publishers(FIELDS[0]) == 2)
    for k in range(40):
        for _ in range(1 + k % 3):
            publishers[k % 2].publish(MagneticField())
        total += 1 + k % 3
        session.until(lambda: True)
    assert session.until(lambda: session.recorder.counts[FIELDS[0]] == total)
    assert session.node.lost == {}


def test_each_file_begins_with_the_last_latched_message(ros, record):
    node, _ = ros
    early = node.create_publisher(Header, '/calibration_state', LATCHED_QOS)
    early.publish(Header(frame_id='early'))
    session = record(Selection((), results=True), split_bytes=2000)
    topic = '/calibration_state'
    assert session.until(lambda: session.recorder.counts[topic] == 1)
    volatile = node.create_publisher(Header, topic, QoSProfile(
        depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    assert session.until(volatile.get_subscription_count)
    for k in range(60):
        volatile.publish(Header(frame_id=f'late {k}'))
        assert session.until(lambda: session.recorder.counts[topic] == 2 + k)  # noqa: B023
    session.close()
    files = sorted(session.recorder.folder.glob('*.mcap'), key=lambda p: int(p.stem.split('_')[-1]))
    assert len(files) > 1
    for n, file in enumerate(files):
        recorded = [decode(m).frame_id for m in Recording(file).messages([topic])]
        assert (recorded[0] == 'early') == (n == 0)
        if n:
            previous = [decode(m).frame_id for m in Recording(files[n - 1]).messages([topic])]
            assert recorded[0] == previous[-1]
    with Reader(session.recorder.folder) as reader:
        (connection,) = reader.connections
    assert connection.ext.offered_qos_profiles[0].durability.name == 'TRANSIENT_LOCAL'


def test_other_types_are_reported(record):
    # Within one context, the middleware would refuse two types of one topic.
    context = rclpy.Context()
    context.init()
    node = Node('stranger', context=context)
    node.create_publisher(Header, FIELDS[0], STREAM_QOS)
    try:
        session = record(Selection(FIELDS[:1]))
        assert session.until(lambda: session.reports)
        session.until(lambda: False, 0.3)
    finally:
        node.destroy_node()
        context.shutdown()
    (report,) = session.reports
    assert all(part in report for part in (
        f'{FIELDS[0]} ', 'std_msgs/msg/Header', 'sensor_msgs/msg/MagneticField'))
