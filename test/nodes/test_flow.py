"""Diagnostics of the connections between nodes: latency, queues and missing peers."""

from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.time import Time
from sensor_msgs.msg import MagneticField

from mag_tracking.nodes import connections as module
from mag_tracking.nodes.connections import MAX_LATENCIES, Flow, SubscriberMonitor
from mag_tracking.nodes.stage_node import RESULT_QOS, STREAM_QOS
from mag_tracking.nodes.tracker_node import TRANSPORT_MARGIN_S, TrackerNode
from mag_tracking.pipeline import settings_for
from support.bundled import NETWORK_FILE
from support.node_processes import start, stop

NS = 1_000_000_000


@pytest.fixture
def clock(monkeypatch):
    """List of one element, the value of `time.monotonic` [s]."""
    now = [100.0]
    monkeypatch.setattr(module.time, 'monotonic', lambda: now[0])
    return now


def status_of(flow, sender_exists=True):
    """DiagnosticStatus of a `Flow` with or without a sender."""
    return flow.status('me', lambda: sender_exists)


def values(status):
    """{key: value} of a status."""
    return {v.key: v.value for v in status.values}


def test_latency_is_measured_from_timestamp_to_end_of_processing(clock):
    flow = Flow('a_node')
    begin = clock[0]
    for k in range(101):
        clock[0] = begin + 0.01 * k
        flow.add(10 * NS, 10 * NS + (k - 2) * 1_000_000, clock[0] - 0.002)
    clock[0] = begin + 1.01
    status = status_of(flow)
    assert status.name == 'me: from a_node' and status.level == DiagnosticStatus.OK
    reported = values(status)
    assert reported['messages'] == '101'
    assert float(reported['latency, median [ms]']) == pytest.approx(50.0)
    assert float(reported['latency, 99 % [ms]']) == pytest.approx(99.0)
    # 101 times 2 ms in 1.01 s.
    assert float(reported['busy [%]']) == pytest.approx(20.0)
    clock[0] += 1.0
    next_report = values(status_of(flow))
    assert next_report['messages'] == '101' and next_report['busy [%]'] == '0'
    assert next_report['latency, median [ms]'] == 'nan'


def test_a_silent_input_is_reported_until_it_returns(clock):
    flow = Flow('a_node')
    flow.topics.append('/a')
    clock[0] += 5.0
    first = status_of(flow)
    # At first, it is normal to receive nothing, because the calibration learns the background.
    assert first.level == DiagnosticStatus.OK and first.message == 'waiting for /a'
    clock[0] += module.FIRST_MESSAGE_TIMEOUT_S
    overdue = status_of(flow, sender_exists=False)
    assert overdue.level == DiagnosticStatus.WARN
    assert '/a: no publisher' in overdue.message
    assert status_of(flow).message.endswith(' /a')
    flow.add(0, 0, clock[0])
    clock[0] += module.SILENCE_TIMEOUT_S
    assert status_of(flow).message == 'running'
    clock[0] += 1.0
    silent = status_of(flow)
    # A sender that exists may have nothing to publish, so the level is not ERROR.
    assert silent.level == DiagnosticStatus.WARN
    assert 'a_node for 3 s' in silent.message
    no_sender = status_of(flow, sender_exists=False)
    assert no_sender.level == DiagnosticStatus.ERROR
    assert 'no publisher' in no_sender.message and 'no publisher' not in silent.message
    flow.add(0, 0, clock[0])
    assert status_of(flow).message == 'running'


def test_lost_messages_are_reported_once(clock):
    flow = Flow('a_node')
    flow.add(0, 0, clock[0])
    flow.n_lost += 7
    status = status_of(flow)
    assert status.level == DiagnosticStatus.WARN and status.message.startswith('7 messages from')
    assert values(status)['lost in the queue'] == '7'
    assert status_of(flow).level == DiagnosticStatus.OK
    flow.n_lost += 1
    assert status_of(flow).message.startswith('1 message from')


def test_an_old_recording_is_neither_late_nor_live(clock):
    flow = Flow('a_node')
    assert not flow.is_live
    flow.add(0, 10**18, clock[0])
    assert not flow.is_live
    assert values(status_of(flow))['latency, median [ms]'] == 'nan'
    flow.add(10**18, 10**18 + NS, clock[0])
    assert flow.is_live
    status_of(flow)
    assert flow.is_live


@pytest.mark.parametrize('busy_s, latency_s', [(0.99, 0.0), (0.01, 2.0)])
def test_a_computer_that_is_too_slow_is_reported(clock, busy_s, latency_s):
    flow = Flow('a_node')
    clock[0] += 1.0
    flow.add(10 * NS, round((10 + latency_s) * NS), clock[0] - busy_s)
    status = status_of(flow)
    assert status.level == DiagnosticStatus.WARN and 'too slow' in status.message
    clock[0] += 1.0
    flow.add(11 * NS, 11 * NS, clock[0] - 0.01)
    assert status_of(flow).level == DiagnosticStatus.OK


def test_the_number_of_stored_latencies_is_bounded(clock):
    flow = Flow('a_node')
    for _ in range(MAX_LATENCIES + 50):
        flow.add(0, 0, clock[0])
    assert flow.n_latencies == MAX_LATENCIES
    assert values(status_of(flow))['messages'] == str(MAX_LATENCIES + 50)


def test_a_subscriber_that_disappears_is_reported():
    monitor = SubscriberMonitor('tracker', '/network_frame', 'its type')

    def status(*names):
        return monitor.status('me', set(names), lambda name: {
            '/other': {'its type'}, '/second': {'its type', 'more'}}.get(name, set()))
    assert '/network_frame' in status('/rviz').message
    assert status('/rviz', '/other').message == 'running'
    disappeared = status('/rviz')
    assert disappeared.level == DiagnosticStatus.ERROR and disappeared.name == 'me: to tracker'
    assert disappeared.message.startswith('/other ')
    assert status('/other').level == DiagnosticStatus.OK
    assert status('/other', '/second').message == 'running'
    assert status().message.startswith('/other, /second ')
    # A tracker with another name may replace the first; other subscribers may disappear.
    assert status('/second').level == DiagnosticStatus.OK
    assert status('/second', '/rviz').message == status('/second').message == 'running'


class StandIn:
    """Stand-in for a tracker node, with the attributes that `end_tracks_on_timeout` uses."""

    def __init__(self, clock, is_replayed=False):
        self._clock, self.is_replayed, self._is_silent = clock, is_replayed, False
        self.flows = {'detection': Flow('detection')}
        self.settings = settings_for('magnet')
        self._stage = SimpleNamespace(bank=object(), end_tracks=lambda why: [why])
        self.published = []

    def _publish_all(self, records, frame):
        self.published += records

    def run_timer(self, seconds, frames):
        """Run the timer at 4 Hz; with `frames`, an hour-old frame arrives before each tick."""
        for _ in range(round(4 * seconds)):
            self._clock[0] += 0.25
            if frames:
                self.flows['detection'].add(0, 3600 * NS, self._clock[0])
            TrackerNode.end_tracks_on_timeout(self)


def test_a_track_ends_when_frames_stop_not_when_they_are_old(clock):
    end_s = settings_for('magnet').track.end_gap_s + TRANSPORT_MARGIN_S
    node = StandIn(clock)
    node.run_timer(end_s + 5.0, frames=True)
    assert not node.published
    node.run_timer(end_s, frames=False)
    assert not node.published
    node.run_timer(0.5, frames=False)
    assert node.published[0] == 'no frames received'


def test_a_busy_node_does_not_end_its_track(clock):
    node = StandIn(clock)
    node.run_timer(1.0, frames=True)
    # The timer runs before the queued frames are processed.
    clock[0] += 100.0
    TrackerNode.end_tracks_on_timeout(node)
    node.run_timer(5.0, frames=True)
    assert not node.published


def test_a_paused_recording_does_not_end_its_track(clock):
    node = StandIn(clock, is_replayed=True)
    node.run_timer(1.0, frames=True)
    node.run_timer(1000.0, frames=False)
    assert not node.published


@pytest.mark.alone
def test_a_node_reports_its_queue_and_latency(ros):
    node, spin_until = ros
    statuses = {}
    node.create_subscription(
        DiagnosticArray, '/diagnostics',
        lambda m: statuses.update({s.name: values(s) for s in m.status}), RESULT_QOS)
    out = node.create_publisher(MagneticField, '/mag_1/imu/mag_calibrated', STREAM_QOS)
    process = start('detection_node', '-p', f'network:={NETWORK_FILE}')
    try:
        assert spin_until(lambda: out.get_subscription_count())
        message = MagneticField()
        sent_ns = node.get_clock().now().nanoseconds
        message.header.stamp = Time(nanoseconds=sent_ns).to_msg()
        message.magnetic_field_covariance[::4] = 1e-16
        # The other sensor is silent, so the reading waits in the queue.
        out.publish(message)
        assert spin_until(lambda: statuses.get(
            'detection_node: from calibration', {}).get('messages') == '1')
        elapsed_ms = (node.get_clock().now().nanoseconds - sent_ns) / 1e6
        assert 0.0 < float(statuses['detection_node: from calibration']
                           ['latency, median [ms]']) < elapsed_ms
        assert spin_until(lambda: statuses['detection_node: align']['queue'] == '1')
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs
