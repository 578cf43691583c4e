"""Middleware profile of processes with ROS: selection and effects."""

import os
import subprocess
import sys

import pytest
import rclpy
from rclpy.parameter import Parameter
from sensor_msgs.msg import MagneticField

from mag_tracking.nodes import middleware
from mag_tracking.nodes.driver_node import DriverNode
from mag_tracking.nodes.runner import make_nodes
from mag_tracking.nodes.stage_node import PUBLISHER_QOS
from mag_tracking.pipeline import settings_for
from support.bundled import NETWORK_FILE, ROOT
from support.node_processes import environment

MAX_REQUESTS = 256
"""Maximum number of sequence numbers in one ACKNACK of RTPS."""

LISTENER = """
import sys
import time
from pathlib import Path
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import MagneticField
from mag_tracking.nodes.middleware import init_ros
from mag_tracking.nodes.stage_node import STREAM_QOS
init_ros()
node, received = Node('listener'), Future()
executor = EventsExecutor()
executor.add_node(node)
# The creation of the node is not part of the measured delay.
start = time.monotonic()
node.create_subscription(MagneticField, '/field', received.set_result, STREAM_QOS)
executor.spin_until_future_complete(received, 60.0)
waited = time.monotonic() - start
partial = Path(sys.argv[1]).with_suffix('.partial')
partial.write_text(str(waited))
partial.rename(sys.argv[1])
time.sleep(600.0)
"""


@pytest.fixture
def init_calls(monkeypatch, tmp_path):
    """Arguments of the calls of `rclpy.init`, which is replaced by a function that records them.

    The working folder is empty, and the environment names no profile.
    """
    calls = []
    monkeypatch.setattr(rclpy, 'init', lambda **k: calls.append(k))
    # A copy, so that changes by `begin` are lost after the test.
    monkeypatch.setattr(os, 'environ', {n: v for n, v in os.environ.items()
                                        if n != middleware.PROFILE_VARIABLE})
    monkeypatch.chdir(tmp_path)
    return calls


def test_the_profile_of_the_package_is_the_default(init_calls):
    middleware.init_ros(['--ros-args'])
    assert init_calls[0]['args'] == ['--ros-args']
    assert os.environ[middleware.PROFILE_VARIABLE] == str(middleware.PROFILE)
    assert middleware.PROFILE.exists()


@pytest.mark.parametrize('own, is_reported', [
    ('/somewhere/else.xml', True), (str(middleware.PROFILE), False), ('', False)])
def test_a_profile_of_the_user_is_kept(init_calls, capfd, own, is_reported):
    """An empty value means no profile; a missing file is reported."""
    os.environ[middleware.PROFILE_VARIABLE] = own
    middleware.init_ros()
    assert os.environ[middleware.PROFILE_VARIABLE] == own and len(init_calls) == 1
    errors = capfd.readouterr().err
    assert ('/somewhere/else.xml' in errors) == is_reported == bool(errors)


def test_a_profile_in_the_working_folder_is_kept(init_calls, tmp_path):
    (tmp_path / middleware.WORKING_FOLDER_PROFILE).write_text('<dds/>')
    middleware.init_ros()
    assert middleware.PROFILE_VARIABLE not in os.environ and len(init_calls) == 1


def test_a_restarted_node_receives_messages_at_once(ros, tmp_path):
    """Without the profile, the first message often arrives 1 to 4 s after the start."""
    node, spin_until = ros
    publisher = node.create_publisher(MagneticField, '/field', PUBLISHER_QOS)
    # Fast enough to fill the history for a killed node before the next node starts.
    node.create_timer(0.005, lambda: publisher.publish(MagneticField()))
    waits = []
    for i in range(4):
        received = tmp_path / f'received_{i}'
        with subprocess.Popen([sys.executable, '-c', LISTENER, str(received)],
                              env=environment()) as listener:
            try:
                assert spin_until(received.exists)
            finally:
                listener.kill()
        waits.append(float(received.read_text()))
    print(f'received after {", ".join(f"{w:.2f}" for w in waits)} s')
    assert max(waits) < 0.8


def test_the_history_of_each_publisher_fits_into_one_request(ros):
    """A longer history would need a second request, which a restarted node sends seconds later."""
    driver = DriverNode(parameter_overrides=[
        Parameter('drivers', value=str(ROOT / 'config' / 'drivers.yaml')),
        Parameter('network', value=str(NETWORK_FILE)), Parameter('batches', value=True),
        Parameter('autostart', value=False)])
    nodes = [driver, *make_nodes(NETWORK_FILE, settings_for('vehicle'))[0]]
    try:
        driver.trigger_configure()
        sent = {p.topic_name: p.qos_profile.depth for node in nodes for p in node.publishers}
        assert {'/mag_1/imu/mag', '/field_readings', '/field_readings_calibrated',
                '/network_frame', '/tracker_node/tracks'} <= sent.keys()
        # Topics of ROS itself are excluded.
        assert {t: n for t, n in sent.items()
                if n > MAX_REQUESTS and t not in ('/parameter_events', '/rosout')} == {}
    finally:
        for node in nodes:
            node.destroy_node()
