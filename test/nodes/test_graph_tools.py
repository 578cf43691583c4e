"""The small substitutes for `ros2` as commands on a live system: topics, echo, param, lifecycle."""

import os
import subprocess
import sys

import pytest
import yaml

from mag_tracking.messages.types import CALIBRATION_STATE
from support.bundled import NETWORK_FILE
from support.node_processes import LONGEST_S, environment, start, stop

pytestmark = pytest.mark.timeout(600)


def command(*words):
    """(status, output) of `mag-tracking`."""
    done = subprocess.run([sys.executable, '-m', 'mag_tracking.cli', *words], text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=LONGEST_S,
                          env=environment(ROS_HOME=os.environ['ROS_HOME']), check=False)
    return done.returncode, done.stdout


def test_a_tracker_and_a_driver_as_seen_by_somebody_without_ros2(ros, tmp_path):
    node, spin_until = ros
    udp = tmp_path / 'udp.yaml'
    udp.write_text('board: {transport: udp, udp: {port: 47124, address: 127.0.0.1}, framing: text,'
                   ' text: {fields: [x, y, z]}, unit: nT, sensor: mag_1}\n')
    namespace = ['-r', '__ns:=/lab']
    processes = [start('calibration_node', *namespace, '-p', f'network:={NETWORK_FILE}'),
                 start('driver_node', *namespace, '-p', f'drivers:={udp}')]
    try:
        assert spin_until(lambda: {'calibration_node', 'driver_node'} <= set(
            node.get_node_names()))
        code, text = command('topics')
        assert code == 0
        assert '/lab/mag_1/imu/mag  sensor_msgs/msg/MagneticField  1 publishers, 1 sub' in text
        within = ['--ros-args', '-r', '__ns:=/lab']
        code, text = command('echo', CALIBRATION_STATE, '--count', '1', *within)
        assert code == 0 and text.endswith('---\n'), text
        message = yaml.safe_load(text.removesuffix('---\n'))
        assert [s['sensor'] for s in message['sensors']] == ['mag_1', 'mag_2']
        code, text = command('param', '/lab/calibration_node', 'network')
        assert code == 0 and text.startswith(f'network: {NETWORK_FILE}  (read-only)  # Path'), text
        assert command('param', '/lab/calibration_node', 'network', '/tmp/x')[0] == 1
        code, text = command('param', '/lab/calibration_node', 'nonsense')
        assert code == 1 and 'has no parameter nonsense' in text, text
        code, text = command('lifecycle', 'driver_node', *within)
        assert code == 0 and text.startswith('active; possible: deactivate'), text
        code, text = command('lifecycle', 'driver_node', 'deactivate', *within)
        assert code == 0 and text.startswith('inactive; possible: '), text
        code, text = command('lifecycle', 'driver_node', 'deactivate', *within)
        assert code == 1 and 'deactivate is not possible now, but ' in text, text
        code, text = command('echo', '/nowhere')
        assert code == 1 and 'nobody publishes /nowhere' in text and 'Traceback' not in text
    finally:
        codes, outputs = stop(processes)
    assert not any(codes), outputs


SLOW = """
import time
import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
class Slow(LifecycleNode):
    def on_configure(self, state):
        time.sleep(4.0)
        return TransitionCallbackReturn.SUCCESS
rclpy.init()
rclpy.spin(Slow('slow'))
"""


def test_a_transition_that_takes_long_is_made_once(ros):
    node, spin_until = ros
    process = subprocess.Popen([sys.executable, '-c', SLOW], stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True)
    try:
        assert spin_until(lambda: 'slow' in node.get_node_names())
        code, text = command('lifecycle', '/slow', 'configure')
        assert code == 0 and text.startswith('inactive; possible: '), text
    finally:
        process.kill()
        output, _ = process.communicate()
    assert 'No transition matching' not in output


@pytest.mark.parametrize('words, told', [
    (('echo', 'a b'), 'topic name'), (('param', '/live/bad name'), 'service name'),
    (('lifecycle', '/1abc', 'activate'), 'service name'), (('echo', '/a', '--count', '0'), '0 is'),
    (('echo', ''), 'topic name')])
def test_names_that_are_none_are_one_line(words, told):
    code, text = command(*words)
    assert code == 1 and told in text and 'Traceback' not in text, text


def test_arguments_of_ros_are_refused_where_no_ros_runs():
    code, text = command('info', 'a.mcap', '--ros-args', '-r', '__ns:=/x')
    assert code == 2 and '--ros-args: info runs without ROS' in text
    code, text = command('--version')
    assert code == 0 and text.startswith('mag_tracking ')
