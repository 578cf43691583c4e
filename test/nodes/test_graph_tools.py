"""Commands that substitute for `ros2`, on a live system: topics, echo, param, lifecycle."""

import subprocess
import sys
import time

import pytest
import yaml

from mag_tracking.cli import main
from mag_tracking.messages.types import CALIBRATION_STATE
from support.bundled import NETWORK_FILE
from support.node_processes import MAX_S, start, stop

pytestmark = pytest.mark.timeout(600)
NAMESPACE = ('--ros-args', '-r', '__ns:=/lab')
SLOW_NODE = """
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


@pytest.fixture
def command(capfd):
    """Function that runs `mag-tracking` in this process; returns (exit status, output)."""
    def run(*words):
        capfd.readouterr()
        try:
            status = main(words)
        except SystemExit as error:
            status = error.code
        out, err = capfd.readouterr()
        return status, out + err
    return run


def wait_for(condition):
    """Wait for a condition; poll it without pauses, because each evaluation runs a command."""
    end = time.monotonic() + MAX_S
    while not condition():
        assert time.monotonic() < end


def test_commands_show_a_calibration_and_a_driver(command, tmp_path):
    udp = tmp_path / 'udp.yaml'
    udp.write_text('board: {transport: udp, udp: {port: 47124, address: 127.0.0.1}, framing: text,'
                   ' text: {fields: [x, y, z]}, unit: nT, sensor: mag_1}\n')
    processes = [start('calibration_node', *NAMESPACE[1:], '-p', f'network:={NETWORK_FILE}'),
                 start('driver_node', *NAMESPACE[1:], '-p', f'drivers:={udp}')]
    try:
        wait_for(lambda: '/lab/mag_1/imu/mag  sensor_msgs/msg/MagneticField  1 publisher, 1 sub'
                 in command('ros', 'topics')[1])
        status, output = command('ros', 'echo', CALIBRATION_STATE, '--count', '1', *NAMESPACE)
        assert status == 0 and output.endswith('---\n'), output
        message = yaml.safe_load(output.removesuffix('---\n'))
        assert [s['sensor'] for s in message['sensors']] == ['mag_1', 'mag_2']
        status, output = command('ros', 'echo', '/diagnostics', '--count', '1')
        assert status == 0 and isinstance(
            yaml.safe_load(output.removesuffix('---\n'))['status'][0]['level'], int)
        check_parameters(command)
        check_lifecycle(command)
    finally:
        exit_codes, outputs = stop(processes)
    assert not any(exit_codes), outputs


def check_parameters(command):
    """Assert that parameters of the calibration node are shown and invalid changes rejected."""
    status, output = command('ros', 'param', '/lab/calibration_node', 'network')
    assert status == 0 and output.startswith(
        f'network: {NETWORK_FILE}  (read-only)  # Path'), output
    status, output = command('ros', 'param', '/lab/calibration_node', 'network', 'other.yaml')
    assert status == 1 and 'parameter network' in output, output
    status, output = command('ros', 'param', '/lab/calibration_node', 'nonsense')
    assert status == 1 and 'parameter nonsense' in output, output


def check_lifecycle(command):
    """Assert that the state of the driver node is shown and changed."""
    status, output = command('ros', 'lifecycle', 'driver_node', *NAMESPACE)
    assert status == 0 and output.startswith('active; available transitions: deactivate'), output
    status, output = command('ros', 'lifecycle', 'driver_node', 'deactivate', *NAMESPACE)
    assert status == 0 and output.startswith('inactive; available transitions: '), output
    status, output = command('ros', 'lifecycle', 'driver_node', 'deactivate', *NAMESPACE)
    assert status == 1 and 'deactivate is' in output, output


def test_integers_are_accepted_for_floating_point_parameters(command):
    process = start('tracker_node', '-p', f'network:={NETWORK_FILE}')
    try:
        wait_for(lambda: '/tracker_node/pose' in command('ros', 'topics')[1])
        status, output = command('ros', 'param', 'tracker_node', 'track.field_error', '1')
        assert status == 0 and output.startswith('track.field_error: 1.0'), output
    finally:
        exit_codes, outputs = stop([process])
    assert exit_codes == [0], outputs


def test_a_slow_transition_is_requested_once(command):
    process = subprocess.Popen([sys.executable, '-c', SLOW_NODE], stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True)
    try:
        wait_for(lambda: '/slow/transition_event' in command('ros', 'topics')[1])
        status, output = command('ros', 'lifecycle', '/slow', 'configure')
        assert status == 0 and output.startswith('inactive; available transitions: '), output
    finally:
        process.kill()
        output, _ = process.communicate()
    assert 'No transition' not in output


@pytest.mark.parametrize('words, error', [
    (('ros', 'echo', 'a b'), 'topic name'), (('ros', 'param', '/live/bad name'), 'service name'),
    (('ros', 'lifecycle', '/1abc', 'activate'), 'service name'),
    (('ros', 'echo', '/a', '--count', '0'), '--count: expected 1 or more, got 0'),
    (('ros', 'echo', ''), 'topic name'), (('ros', 'echo', '/nowhere'), '/nowhere has'),
    (('ros', 'param', '/nowhere'), '/nowhere/list_parameters')])
def test_invalid_or_missing_names_are_reported(command, words, error):
    status, output = command(*words)
    assert status == 1 and error in output and 'Traceback' not in output, output


def test_ros_arguments_are_refused_by_commands_without_ros(command):
    status, output = command('info', 'a.mcap', '--ros-args', '-r', '__ns:=/x')
    assert status == 2 and '--ros-args: info' in output
    status, output = command('--version')
    assert status == 0 and output.startswith('mag_tracking ')
