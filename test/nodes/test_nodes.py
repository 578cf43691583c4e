"""The nodes over the real middleware, compared with the offline replay."""

import csv
import dataclasses
import os
import signal
from collections import Counter

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from mag_tracking_msgs.msg import (
    CalibrationState,
    HypothesisArray,
    NetworkFrame,
    PassEvent,
    SmoothedTrack,
    TrackArray,
    TrafficSummary,
    VehiclePassage,
)
from mag_tracking_msgs.srv import Seek
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import MagneticField
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

import mag_tracking as mt
from mag_tracking.apps.replay import replay
from mag_tracking.messages.schema import (
    pass_event_dict,
    stamp_ns,
    traffic_summary_dict,
    vehicle_passage_dict,
)
from mag_tracking.network.file import read_network, write_network
from mag_tracking.nodes.convert import to_message, track_of
from mag_tracking.nodes.runner import run
from mag_tracking.nodes.stage_node import LATCHED_QOS, RESULT_QOS, STREAM_QOS
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from support.bundled import NETWORK_FILE, VEHICLES, vehicle_path
from support.busy_recordings import BUSY, network_of_recording
from support.marks import studied
from support.node_processes import MAX_S, call, start, stop, until_quiet, without_info_lines
from support.shared_memory import orphaned_segments, segments_of

pytestmark = pytest.mark.timeout(600)

# At a higher rate, the messages of a sensor may be late by more than the 0.5 s of recording time
# after which a sensor is treated as silent.
LONG_WAIT = {'align.max_wait_s': 5.0}


class Collector(Node):
    """Stores the messages of the tracker."""

    def __init__(self):
        super().__init__('collector')
        self.poses, self.tracks, self.hypotheses, self.paths = [], [], [], []
        self.fixed_lag, self.smoothed, self.passages, self.summaries = [], [], [], []
        self.create_subscription(VehiclePassage, '/tracker_node/passages', self.passages.append,
                                 RESULT_QOS)
        self.create_subscription(TrafficSummary, '/tracker_node/traffic', self.summaries.append,
                                 RESULT_QOS)
        self.create_subscription(SmoothedTrack, '/tracker_node/smoothed', self.smoothed.append,
                                 RESULT_QOS)
        self.create_subscription(Path, '/tracker_node/path_smoothed', self.paths.append, RESULT_QOS)
        self.create_subscription(PoseWithCovarianceStamped, '/tracker_node/pose_smoothed',
                                 self.fixed_lag.append, STREAM_QOS)
        self.create_subscription(PoseWithCovarianceStamped, '/tracker_node/pose',
                                 self.poses.append, STREAM_QOS)
        self.create_subscription(TrackArray, '/tracker_node/tracks', self.tracks.append, STREAM_QOS)
        self.create_subscription(HypothesisArray, '/tracker_node/hypotheses',
                                 self.hypotheses.append, STREAM_QOS)


def compare_with_offline(collector, folder):
    """Compare published poses with poses.csv; return the largest relative difference."""
    with open(folder / 'poses.csv', newline='') as stream:
        offline = {(int(r['stamp_ns']), int(r['track_id'])): r for r in csv.DictReader(stream)}
    tracks = [track_of(t) for m in collector.tracks for t in m.tracks]
    live = [t for t in tracks if not t.ended]
    assert len(live) == len(collector.poses)
    # At the end of a stream, one or two frames may be queued in the nodes until a flush.
    assert len(offline) - 2 <= len(live) <= len(offline)
    max_difference = 0.0
    for t, pose in zip(live, collector.poses, strict=True):
        row = offline[t.stamp_ns, t.id]
        expected = np.array([float(row[c]) for c in (
            'x', 'y', 'z', 'vx', 'vy', 'vz', 'sd_x', 'sd_y', 'sd_z', 'sd_vx', 'sd_vy', 'sd_vz',
            'mx', 'my', 'mz', 'weight')])
        online = np.r_[t.position, t.velocity, np.sqrt(np.diagonal(t.covariance)), t.moment,
                       t.weight]
        max_difference = max(
            max_difference, np.abs(online - expected).max() / np.abs(expected).max(),
            (np.abs(online - expected) / np.maximum(np.abs(expected), 1e-9)).max())
        assert t.ambiguous == bool(int(row['ambiguous']))
        p = pose.pose.pose.position
        assert (p.x, p.y, p.z) == tuple(t.position) and stamp_ns(pose.header.stamp) == t.stamp_ns
    return max_difference


def compare_traffic(collector, offline):
    """Assert that passages and summaries equal those offline; the last two may be missing."""
    n = len(collector.passages)
    assert len(offline.vehicles) - 2 <= n <= len(offline.vehicles) and n > 5
    for online, vehicle in zip(collector.passages, offline.vehicles, strict=False):
        expected = to_message(VehiclePassage, vehicle_passage_dict(
            vehicle.passage, offline.class_names, 'map'))
        # Compared as strings, because NaN is not equal to itself.
        assert str(online) == str(expected)
    for online, summary in zip(collector.summaries, offline.summaries, strict=False):
        assert str(online) == str(to_message(TrafficSummary, traffic_summary_dict(summary, 'map')))


def compare_smoothed(collector, folder):
    """Assert that the smoothed path equals poses_smoothed.csv and is close to fixed-lag poses."""
    with open(folder / 'poses_smoothed.csv', newline='') as stream:
        offline = list(csv.DictReader(stream))
    assert len(collector.paths) == 1
    steps = collector.paths[0].poses
    assert [stamp_ns(s.header.stamp) for s in steps] == [int(r['stamp_ns']) for r in offline]
    online = np.array([[getattr(s.pose.position, a) for a in 'xyz'] for s in steps])
    expected = np.array([[float(r[a]) for a in 'xyz'] for r in offline])
    np.testing.assert_allclose(online, expected, rtol=0, atol=1e-9)
    smoothed_track = collector.smoothed[0]
    assert len(collector.smoothed) == 1 and smoothed_track.track_id == int(offline[0]['track_id'])
    flags = [row['ambiguous'] == '1' for row in offline]
    assert (smoothed_track.kind, smoothed_track.ambiguous) == (offline[-1]['kind'], any(flags))
    assert list(smoothed_track.pose_ambiguous) == flags
    assert smoothed_track.length == float(offline[-1]['length'])
    for p, v, row in zip(smoothed_track.poses, smoothed_track.velocities, offline, strict=True):
        C = np.array(p.pose.covariance).reshape(6, 6)
        published = [p.pose.pose.position.x, p.pose.pose.position.y, v.x, v.y, C[0, 0]**0.5]
        np.testing.assert_allclose(
            published, [float(row[c]) for c in ('x', 'y', 'vx', 'vy', 'sd_x')], rtol=0, atol=1e-9)
    fixed_lag = {stamp_ns(m.header.stamp): m.pose.pose.position for m in collector.fixed_lag}
    # Ambiguous fixed-lag poses are withheld: they have no flag and no covariance of a mixture.
    assert fixed_lag.keys() <= {stamp_ns(s.header.stamp) for s in steps}
    assert len(fixed_lag) > 0.4 * len(steps)
    position = {stamp_ns(s.header.stamp): point for s, point in zip(steps, expected, strict=True)}
    distances = [np.hypot(p.x - position[s][0], p.y - position[s][1]) for s, p in fixed_lag.items()]
    assert 0.01 < np.median(distances) < 2.0


def collect_from_nodes(network_file, settings, recording, rate):
    """`Collector` of a recording that is played through all nodes."""
    collectors = []
    run(network_file, settings, recording, rate,
        observers=[lambda: collectors.append(Collector()) or collectors[-1]])
    return collectors[0]


@pytest.mark.parametrize('name', studied(VEHICLES, ['junction_rear_turns_right']))
def test_nodes_equal_offline_on_vehicles(name, tmp_path, road_network):
    settings = settings_for('vehicle', {**LONG_WAIT, 'track.smoothing_lag_s': 0.3})
    replay(Recording(vehicle_path(name)), road_network, settings, tmp_path)
    collector = collect_from_nodes(NETWORK_FILE, settings, vehicle_path(name), 6.0)
    max_difference = compare_with_offline(collector, tmp_path)
    compare_smoothed(collector, tmp_path)
    print(f'{name}: nodes against offline, largest relative difference {max_difference:.1e}')
    assert max_difference <= 1e-9


def test_nodes_equal_offline_on_several_vehicles(tmp_path):
    """Twelve vehicles in 45 s; each track is smoothed once."""
    name = 'traffic_2_sensors'
    network = network_of_recording(name)
    write_network(network_file := tmp_path / 'network.yaml', network)
    settings, recording = settings_for('vehicle', LONG_WAIT), BUSY / f'{name}.mcap'
    replay(Recording(recording), network, settings, tmp_path)
    collector = collect_from_nodes(network_file, settings, recording, 2.0)
    max_difference = compare_with_offline(collector, tmp_path)
    ids = {t.id for m in collector.tracks for t in m.tracks}
    busy_seconds = [s for s, n in Counter(t.header.stamp.sec for m in collector.tracks
                                          for t in m.tracks).items() if n > 13]
    assert len(ids) > 5 and busy_seconds
    smoothed = [m.track_id for m in collector.smoothed]
    assert len(smoothed) == len(set(smoothed)) and set(smoothed) <= ids
    compare_traffic(collector, mt.traffic(recording, network, LONG_WAIT))
    print('several vehicles: nodes against offline, largest relative difference '
          f'{max_difference:.1e}')
    assert max_difference <= 1e-9


def test_nodes_flag_a_sensor_that_contradicts_the_earth_field(tmp_path, road_network):
    """The network file states that a sensor is mounted upside down, which is wrong."""
    R_ws = road_network.R_ws.copy()
    R_ws[1] = np.diag([1.0, -1.0, -1.0])
    network = dataclasses.replace(road_network, R_ws=R_ws)
    write_network(network_file := tmp_path / 'network.yaml', network)
    settings, recording = settings_for('vehicle', LONG_WAIT), vehicle_path('straight_car_right')
    replay(Recording(recording), network, settings, tmp_path)
    collector = collect_from_nodes(network_file, settings, recording, 6.0)
    compare_with_offline(collector, tmp_path)
    tracks = [t for m in collector.tracks for t in m.tracks]
    assert tracks and all('contradicts_earth_field' in t.doubts for t in tracks)


def test_nodes_equal_offline_at_the_defaults(tmp_path, road_network):
    """In real time, no message is later than the default `align.max_wait_s`, half a second."""
    settings, recording = settings_for('vehicle'), vehicle_path('straight_car_fast_left')
    replay(Recording(recording), road_network, settings, tmp_path)
    max_difference = compare_with_offline(
        collect_from_nodes(NETWORK_FILE, settings, recording, 1.0), tmp_path)
    print(f'defaults: nodes against offline, largest relative difference {max_difference:.1e}')
    assert max_difference <= 1e-9


@pytest.mark.parametrize('run_number', studied([1, 2], [1]))
def test_nodes_equal_offline_on_magnets(run_number, magnet_runs, tmp_path):
    recording, network_file = magnet_runs[run_number]
    settings = settings_for('magnet', {'align.max_wait_s': 60.0})
    replay(Recording(recording), read_network(network_file), settings, tmp_path)
    max_difference = compare_with_offline(
        collect_from_nodes(network_file, settings, recording, 80.0), tmp_path)
    print(f'magnet run {run_number}: nodes against offline, largest relative difference '
          f'{max_difference:.1e}')
    assert max_difference <= 1e-9


def receive_topics(node):
    """Subscribe to the topics of the nodes; return {message type: [messages]}."""
    topics = {NetworkFrame: '/network_frame', TrackArray: '/tracker_node/tracks',
              Odometry: '/tracker_node/odometry', MarkerArray: '/tracker_node/markers',
              PassEvent: '/detection_node/events', Clock: '/clock',
              CalibrationState: '/calibration_state'}
    received = {kind: [] for kind in topics}
    for kind, topic in topics.items():
        node.create_subscription(kind, topic, received[kind].append,
                                 LATCHED_QOS if kind is CalibrationState else STREAM_QOS)
    return received


def play_through_processes(ros, recording, received):
    """Play a recording through one process per node until its track and events have arrived.

    The rate is twice real time, at which a `STREAM_QOS` queue holds 2.5 s of samples: on a machine
    four times slower, a node may be busy for more than a second.
    """
    node, spin_until = ros
    network = ['-p', f'network:={NETWORK_FILE}', '-p', 'reliable_input:=true']
    long_wait = ['-p', 'align.max_wait_s:=5.0']
    processes = [start('calibration_node', *network), start('detection_node', *network, *long_wait),
                 start('tracker_node', *network)]
    try:
        sources, listeners = node.count_publishers, node.count_subscribers
        assert spin_until(lambda: sources('/network_frame')
                          and sources('/tracker_node/tracks')
                          and sources('/mag_1/imu/mag_calibrated')
                          and listeners('/network_frame') > 1
                          and listeners('/mag_1/imu/mag_calibrated'))
        processes.append(start('replay_node', '-p', f'recording:={recording}', '-p', 'rate:=2.0',
                               '-p', 'start_delay:=3.0', '-p', 'wait_for_subscribers:=300.0'))
        assert spin_until(lambda: any(t.status == t.ENDED for m in received[TrackArray]
                                      for t in m.tracks))
        assert spin_until(lambda: len(received[PassEvent]) == 2)
    finally:
        exit_codes, outputs = stop(processes)
    assert exit_codes == [0, 0, 0, 0], outputs
    assert not any('Traceback' in text for text in outputs), outputs


def test_nodes_in_four_processes_equal_offline(ros, tmp_path, road_network):
    """One process per node, as on a robot; all processes end with status 0."""
    recording, received = vehicle_path('straight_car_right'), receive_topics(ros[0])
    play_through_processes(ros, recording, received)
    replay(Recording(recording), road_network, settings_for('vehicle', LONG_WAIT), tmp_path)
    with open(tmp_path / 'poses.csv', newline='') as stream:
        offline = {int(r['stamp_ns']): [float(r['x']), float(r['y'])]
                   for r in csv.DictReader(stream)}
    live = [t for m in received[TrackArray] for t in map(track_of, m.tracks) if not t.ended]
    assert [t.stamp_ns for t in live] == list(offline)
    np.testing.assert_allclose([t.position[:2] for t in live], list(offline.values()), rtol=1e-9)
    assert received[Clock] and len(received[Odometry]) == len(live)
    assert received[Odometry][0].child_frame_id == 'track_1'
    # Action 2 deletes the markers at the end of the track.
    assert {m.action for m in received[MarkerArray][-1].markers} == {2}
    state = received[CalibrationState]
    assert state and all(s.ready for s in state[-1].sensors)
    offline = {e.sensor: pass_event_dict(e) for e in mt.events(
        recording, road_network, LONG_WAIT).events}
    for event in received[PassEvent]:
        expected = offline[event.sensor]
        assert event.left_to_right == expected['left_to_right']
        assert event.closest_std == pytest.approx(expected['closest_std'])
        np.testing.assert_array_equal(event.signature, expected['signature'])


def test_replay_services_pause_seek_and_resume(ros):
    node, spin_until = ros
    fields = []
    node.create_subscription(MagneticField, '/mag_1/imu/mag', fields.append, STREAM_QOS)
    process = start('replay_node', '-p', f'recording:={vehicle_path("straight_car_right")}',
                    '-p', 'topics:=[/mag_1/imu/mag]', '-p', 'start_offset:=4.0', '-p', 'loop:=true',
                    '-p', 'wait_for_subscribers:=300.0')
    try:
        assert spin_until(lambda: len(fields) > 20)
        first = stamp_ns(fields[0].header.stamp)
        begin = Recording(vehicle_path('straight_car_right')).start_ns
        assert 4.0 <= (first - begin) / 1e9 < 5.5
        assert call(ros, Trigger, '/replay_node/pause', Trigger.Request()).success
        n = until_quiet(spin_until, fields)
        assert call(ros, Seek, '/replay_node/seek', Seek.Request(offset=13.5)).success
        assert not call(ros, Seek, '/replay_node/seek', Seek.Request(offset=99.0)).success
        assert call(ros, Trigger, '/replay_node/resume', Trigger.Request()).success
        # At the end, playback restarts, so the timestamps return to the first one.
        assert spin_until(lambda: stamp_ns(fields[-1].header.stamp) - begin < 1_000_000_000
                          and len(fields) > n)
        assert (stamp_ns(fields[n].header.stamp) - begin) / 1e9 >= 13.4
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs


def test_parameters_have_descriptors_and_are_checked(ros):
    process = start('tracker_node', '-p', f'network:={NETWORK_FILE}')
    try:
        descriptors = call(ros, DescribeParameters, '/tracker_node/describe_parameters',
                           DescribeParameters.Request(names=[
                               'track.field_error', 'track.vehicle.induced_share'])).descriptors
        assert all(d.description for d in descriptors)
        assert descriptors[0].floating_point_range[0].to_value == 10.0
        assert [d.read_only for d in descriptors] == [False, True]

        def set_parameter(name, value):
            return call(ros, SetParameters, '/tracker_node/set_parameters',
                        SetParameters.Request(parameters=[
                            Parameter(name, value=value).to_parameter_msg()])).results[0]
        assert set_parameter('track.field_error', 0.03).successful
        for name, value in (('track.field_error', -1.0), ('track.nonsense', 1.0),
                            ('track.vehicle.induced_share', 0.5)):
            assert not set_parameter(name, value).successful
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs


def test_a_track_is_unchanged_by_conversion_to_messages_and_back():
    from mag_tracking.messages.schema import hypotheses_dict, track_dict
    from mag_tracking.stages.track.manager import TrackManager
    from support.track_runs import magnet_frames
    network, frames, _ = magnet_frames(3)
    stage = TrackManager(network, settings_for('magnet').track)
    track = dataclasses.replace(
        [t for f in frames for t in stage.feed(f)][-1],
        mounting=np.arange(27.0).reshape(9, 3),
        mounting_covariance=np.arange(81.0).reshape(9, 3, 3) / 7.0)
    from mag_tracking_msgs.msg import Track as TrackMessage
    converted = track_of(to_message(TrackMessage, track_dict(track, 'map')),
                         to_message(HypothesisArray, hypotheses_dict(track, 'map')))
    for name in ('stamp_ns', 'id', 'ended', 'existence', 'weight', 'nis', 'degrees_of_freedom',
                 'arrival', 'ambiguous', 'unobservable', 'kind', 'kind_weight', 'length',
                 'length_std'):
        assert getattr(converted, name) == getattr(track, name), name
    for name in ('position', 'velocity', 'covariance', 'orientation', 'orientation_covariance',
                 'position_orientation_covariance', 'moment', 'moment_covariance', 'predicted',
                 'mounting', 'mounting_covariance', 'nis_by_sensor'):
        np.testing.assert_array_equal(getattr(converted, name), getattr(track, name))
    assert len(converted.hypotheses) == len(track.hypotheses)


@pytest.mark.parametrize('signum', [signal.SIGINT, signal.SIGTERM])
def test_ended_nodes_leave_no_shared_memory(ros, signum):
    """Unlike a killed node, an interrupted node removes its segments from /dev/shm."""
    node, spin_until = ros
    before = set(os.listdir('/dev/shm'))
    process = start('tracker_node', '-p', f'network:={NETWORK_FILE}')
    try:
        assert spin_until(lambda: node.count_publishers('/tracker_node/tracks'))
        segments = segments_of(process.pid) - before
    finally:
        process.send_signal(signum)
        output, _ = process.communicate(timeout=MAX_S)
    assert (process.returncode, without_info_lines(output)) == (0, '')
    assert segments and not orphaned_segments(segments)
