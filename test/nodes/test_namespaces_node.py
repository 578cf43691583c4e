"""Two networks on one graph: namespaces, node names and remapped topics."""

import csv
import itertools
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from mag_tracking_msgs.msg import TrackArray

from mag_tracking.apps.replay import replay
from mag_tracking.messages.schema import stamp_ns
from mag_tracking.messages.types import MAGNETIC_FIELD, decode
from mag_tracking.nodes.convert import track_of
from mag_tracking.nodes.stage_node import RESULT_QOS, STREAM_QOS
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.writer import RecordingWriter
from support.bundled import NETWORK_FILE, vehicle_path
from support.node_processes import MAX_S, USUAL_START_S, environment, start, stop
from support.samples import MagSample, sample_dict

pytestmark = [pytest.mark.alone, pytest.mark.timeout(900)]

LONG_WAIT = {'align.max_wait_s': 60.0}
NODES = {'calibration_node': 'magnetic_calibration', 'detection_node': 'watchman',
         'tracker_node': 'follower', 'replay_node': 'player'}
"""{node: its name in these tests}."""
NETWORKS = {'/north': ('straight_car_right', {}),
            '/a/b': ('straight_car_fast_left', {'mag_1/imu/mag': '/yard/first'})}
"""{namespace: (recording, {topic: topic to which it is remapped})}."""


def start_network(namespace, remapped):
    """Start the nodes of one network except its replay node."""
    names = [a for topic, new_topic in remapped.items() for a in ('-r', f'{topic}:={new_topic}')]
    return [start(node, *names, *name_arguments(namespace, node), '-p', f'network:={NETWORK_FILE}',
                  '-p', 'reliable_input:=true',
                  *(['-p', 'align.max_wait_s:=60.0'] if node == 'detection_node' else []))
            for node in list(NODES)[:3]]


def name_arguments(namespace, node):
    """Arguments that set the namespace and name of a node."""
    return ['-r', f'__ns:={namespace}', '-r', f'__node:={NODES[node]}']


def play(namespace, recording, remapped, start_s):
    """Start the replay node of one network.

    On a busy machine, where the other nodes needed `start_s` to start, it plays more slowly. At a
    higher rate, queues would overflow while a node waits for the processor.
    """
    rate = 2.5 / max(1.0, start_s / (6 * USUAL_START_S))
    names = [a for topic, new_topic in remapped.items() for a in ('-r', f'{topic}:={new_topic}')]
    return start('replay_node', *names, *name_arguments(namespace, 'replay_node'),
                 '-p', f'recording:={vehicle_path(recording)}', '-p', f'rate:={rate}',
                 '-p', 'start_delay:=3.0', '-p', 'wait_for_subscribers:=300.0')


def positions(folder):
    """{stamp_ns: [x, y]} of poses.csv."""
    with open(folder / 'poses.csv', newline='') as stream:
        return {int(r['stamp_ns']): [float(r['x']), float(r['y'])] for r in csv.DictReader(stream)}


def test_two_networks_on_one_graph_do_not_interfere(ros, tmp_path, road_network):
    node, spin_until = ros
    received, statuses = {ns: [] for ns in NETWORKS}, {}
    for namespace, messages in received.items():
        node.create_subscription(TrackArray, f'{namespace}/follower/tracks', messages.append,
                                 STREAM_QOS)
    node.create_subscription(DiagnosticArray, '/diagnostics', lambda m: statuses.update(
        {s.name: s.message for s in m.status}), RESULT_QOS)
    begin = time.monotonic()
    processes = [p for ns, (_, remapped) in NETWORKS.items() for p in start_network(ns, remapped)]
    try:
        assert spin_until(lambda: all(
            node.count_publishers(f'{ns}/follower/tracks')
            and node.count_subscribers(f'{ns}/network_frame')
            and node.count_publishers(f'{ns}/calibration_state') for ns in NETWORKS))
        assert spin_until(lambda: node.count_subscribers('/yard/first'))
        assert not node.count_subscribers('/a/b/mag_1/imu/mag')
        start_s = time.monotonic() - begin
        processes += [play(ns, *entry, start_s) for ns, entry in NETWORKS.items()]
        assert spin_until(lambda: all(any(t.status == t.ENDED for m in messages for t in m.tracks)
                                      for messages in received.values()), 3 * MAX_S)
        # Each node identifies its peers although they are renamed.
        assert spin_until(lambda: all(
            statuses.get(f'{ns[1:]}/magnetic_calibration: to detection') == 'running'
            and statuses.get(f'{ns[1:]}/watchman: to tracker') == 'running' for ns in NETWORKS))
        killed = processes.pop(2)
        killed.kill()
        killed.communicate(timeout=MAX_S)
        assert spin_until(lambda: statuses['north/watchman: to tracker'].startswith(
            '/north/follower '))
        assert statuses['a/b/watchman: to tracker'] == 'running'
    finally:
        exit_codes, outputs = stop(processes)
    assert not any(exit_codes), outputs
    assert not any('Traceback' in text for text in outputs), outputs
    assert 'waiting for /yard/first, /a/b/mag_2/imu/mag' in outputs[2], outputs[2]
    for namespace, messages in received.items():
        folder = tmp_path / namespace[1:].replace('/', '_')
        replay(Recording(vehicle_path(NETWORKS[namespace][0])), road_network,
               settings_for('vehicle', LONG_WAIT), folder)
        offline = positions(folder)
        live = [t for m in messages for t in map(track_of, m.tracks) if not t.ended]
        assert [t.stamp_ns for t in live] == list(offline)
        np.testing.assert_allclose([t.position[:2] for t in live], list(offline.values()),
                                   rtol=1e-9)


def run_command(*arguments):
    """Run the command; return (exit status, output)."""
    process = subprocess.run([sys.executable, '-m', 'mag_tracking.cli', *arguments], text=True,
                             stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=MAX_S * 2,
                             env=environment(ROS_HOME=os.environ['ROS_HOME']), check=False)
    return process.returncode, process.stdout


def test_the_runner_accepts_ros_arguments():
    code, output = run_command(
        'run', '--network', str(NETWORK_FILE), '--recording',
        str(vehicle_path('straight_car_fast_left')), '--rate', '3', '--ros-args', '-r',
        '__ns:=/robot1', '-r', 'tracker_node:__node:=follower', '-p', 'align.max_wait_s:=5.0')
    assert code == 0, output
    assert 'track 1 ' in output and 'track 1 has ended' in output, output
    assert '[robot1.follower]' in output and 'waiting for /robot1/mag_1/imu/mag' in output, output


def test_a_recording_of_another_namespace_is_refused(tmp_path):
    source, path = Recording(vehicle_path('straight_car_right')), tmp_path / 'a.mcap'
    with RecordingWriter(path) as writer:
        for message in itertools.islice(source.messages(), 50):
            if message.type == MAGNETIC_FIELD:
                header = decode(message).header
                writer.write(f'/robot1{message.topic}', MAGNETIC_FIELD, sample_dict(
                    MagSample(stamp_ns(header.stamp), 'mag_1', [0.0, 0.0, 0.0]), 'mag_1'),
                    message.log_time_ns)
    code, output = run_command('run', '--network', str(NETWORK_FILE), '--recording', str(path))
    assert code == 1 and '--ros-args -r __ns:=/robot1' in output, output


@pytest.mark.parametrize('arguments, error', [
    (['-r', '__ns:=/rob ot'], '__ns'), (['-r', '__node:=1 2'], 'name'),
    (['-p', 'align.max_wait_s'], 'align.max_wait_s'), (['-p', 'align.nonsense:=1.0'], 'nonsense')])
def test_invalid_ros_arguments_are_named(arguments, error):
    code, output = run_command('run', '--network', str(NETWORK_FILE), '--ros-args', *arguments)
    assert code == 1 and error in output and 'Traceback' not in output, output


def test_two_nodes_of_the_same_name_are_reported(ros):
    node, spin_until = ros
    statuses = []
    node.create_subscription(DiagnosticArray, '/diagnostics', lambda m: statuses.extend(
        s.message for s in m.status if s.name == 'tracker_node: start'), RESULT_QOS)
    duplicates = [start('tracker_node', '-p', f'network:={NETWORK_FILE}') for _ in range(2)]
    try:
        assert spin_until(lambda: any('named /tracker_node' in s for s in statuses))
    finally:
        exit_codes, outputs = stop(duplicates)
    assert exit_codes == [0, 0], outputs
    assert any('named /tracker_node' in text for text in outputs), outputs
