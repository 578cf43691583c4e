"""The small substitutes for `ros2` on a live system: topics, echo, param, lifecycle."""

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
WITHIN = ('--ros-args', '-r', '__ns:=/lab')
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


@pytest.fixture
def command(capfd):
    """f(words): (status, output) of `mag-tracking` in this process."""
    def run(*words):
        capfd.readouterr()
        try:
            status = main(words)
        except SystemExit as ended:
            status = ended.code
        out, err = capfd.readouterr()
        return status, out + err
    return run


def wait_for(condition):
    """Ask until it is so; a command takes a while each time."""
    end = time.monotonic() + MAX_S
    while not condition():
        assert time.monotonic() < end


def test_a_calibration_and_a_driver_as_seen_without_ros2(command, tmp_path):
    udp = tmp_path / 'udp.yaml'
    udp.write_text('board: {transport: udp, udp: {port: 47124, address: 127.0.0.1}, framing: text,'
                   ' text: {fields: [x, y, z]}, unit: nT, sensor: mag_1}\n')
    processes = [start('calibration_node', *WITHIN[1:], '-p', f'network:={NETWORK_FILE}'),
                 start('driver_node', *WITHIN[1:], '-p', f'drivers:={udp}')]
    try:
        wait_for(lambda: '/lab/mag_1/imu/mag  sensor_msgs/msg/MagneticField  1 publishers, 1 sub'
                 in command('topics')[1])
        code, text = command('echo', CALIBRATION_STATE, '--count', '1', *WITHIN)
        assert code == 0 and text.endswith('---\n'), text
        message = yaml.safe_load(text.removesuffix('---\n'))
        assert [s['sensor'] for s in message['sensors']] == ['mag_1', 'mag_2']
        code, text = command('echo', '/diagnostics', '--count', '1')
        assert code == 0 and isinstance(
            yaml.safe_load(text.removesuffix('---\n'))['status'][0]['level'], int)
        check_parameters(command)
        check_lifecycle(command)
    finally:
        codes, outputs = stop(processes)
    assert not any(codes), outputs


def check_parameters(command):
    """Show and refuse parameters of the calibration node."""
    code, text = command('param', '/lab/calibration_node', 'network')
    assert code == 0 and text.startswith(f'network: {NETWORK_FILE}  (read-only)  # Path'), text
    code, text = command('param', '/lab/calibration_node', 'network', 'other.yaml')
    assert code == 1 and 'rejects parameter network' in text, text
    code, text = command('param', '/lab/calibration_node', 'nonsense')
    assert code == 1 and 'has no parameter nonsense' in text, text


def check_lifecycle(command):
    """Show and change the state of the driver node."""
    code, text = command('lifecycle', 'driver_node', *WITHIN)
    assert code == 0 and text.startswith('active; possible: deactivate'), text
    code, text = command('lifecycle', 'driver_node', 'deactivate', *WITHIN)
    assert code == 0 and text.startswith('inactive; possible: '), text
    code, text = command('lifecycle', 'driver_node', 'deactivate', *WITHIN)
    assert code == 1 and 'deactivate is not possible in the current state; possible: ' in text, text


def test_whole_numbers_are_taken_where_others_are_expected(command):
    process = start('tracker_node', '-p', f'network:={NETWORK_FILE}')
    try:
        wait_for(lambda: '/tracker_node/pose' in command('topics')[1])
        code, text = command('param', 'tracker_node', 'track.field_error', '1')
        assert code == 0 and text.startswith('track.field_error: 1.0'), text
    finally:
        codes, outputs = stop([process])
    assert codes == [0], outputs


def test_a_transition_that_takes_long_is_made_once(command):
    process = subprocess.Popen([sys.executable, '-c', SLOW], stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True)
    try:
        wait_for(lambda: '/slow/transition_event' in command('topics')[1])
        code, text = command('lifecycle', '/slow', 'configure')
        assert code == 0 and text.startswith('inactive; possible: '), text
    finally:
        process.kill()
        output, _ = process.communicate()
    assert 'No transition matching' not in output


@pytest.mark.parametrize('words, told', [
    (('echo', 'a b'), 'topic name'), (('param', '/live/bad name'), 'service name'),
    (('lifecycle', '/1abc', 'activate'), 'service name'), (('echo', '/a', '--count', '0'), '0 is'),
    (('echo', ''), 'topic name'), (('echo', '/nowhere'), '/nowhere has no publisher'),
    (('param', '/nowhere'), 'service /nowhere/list_parameters not found')])
def test_what_is_not_there_is_one_line(command, words, told):
    code, text = command(*words)
    assert code == 1 and told in text and 'Traceback' not in text, text


def test_arguments_of_ros_are_refused_where_no_ros_runs(command):
    code, text = command('info', 'a.mcap', '--ros-args', '-r', '__ns:=/x')
    assert code == 2 and '--ros-args: info runs without ROS' in text
    code, text = command('--version')
    assert code == 0 and text.startswith('mag_tracking ')
