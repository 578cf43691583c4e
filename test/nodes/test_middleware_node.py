"""How processes begin with ROS: whose profile of the middleware is in force, and what it is for."""

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
from mag_tracking.nodes.stage_node import STREAM_OUTPUT
from mag_tracking.pipeline import settings_for
from support.bundled import NETWORK_FILE, ROOT
from support.node_processes import environment

MAX_REQUESTS = 256
"""The sequence numbers that one ACKNACK of RTPS can name."""

LISTENER = """
import sys
import time
from pathlib import Path
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import MagneticField
from mag_tracking.nodes.middleware import begin
from mag_tracking.nodes.stage_node import STREAM
begin()
node, heard = Node('listener'), Future()
executor = EventsExecutor()
executor.add_node(node)
# What the machine takes to make a node is not the middleware's waiting.
began = time.monotonic()
node.create_subscription(MagneticField, '/field', heard.set_result, STREAM)
executor.spin_until_future_complete(heard, 60.0)
waited = time.monotonic() - began
partial = Path(sys.argv[1]).with_suffix('.partial')
partial.write_text(str(waited))
partial.rename(sys.argv[1])
time.sleep(600.0)
"""


@pytest.fixture
def begun(monkeypatch, tmp_path):
    """What `rclpy.init` is called with, in an empty folder with nothing said of profiles."""
    calls = []
    monkeypatch.setattr(rclpy, 'init', lambda **k: calls.append(k))
    # A copy: what `begin` writes is gone after the test.
    monkeypatch.setattr(os, 'environ', {n: v for n, v in os.environ.items()
                                        if n != middleware.PROFILE_VARIABLE})
    monkeypatch.chdir(tmp_path)
    return calls


def test_the_profile_is_in_force_unless_somebody_has_his_own(begun):
    middleware.begin(['--ros-args'])
    assert begun[0]['args'] == ['--ros-args']
    assert os.environ[middleware.PROFILE_VARIABLE] == str(middleware.PROFILE)
    assert middleware.PROFILE.exists()


@pytest.mark.parametrize('own, is_told', [
    ('/somewhere/else.xml', True), (str(middleware.PROFILE), False), ('', False)])
def test_a_profile_of_the_user_stays(begun, capfd, own, is_told):
    """Also that he wants none; that there is no such file is told."""
    os.environ[middleware.PROFILE_VARIABLE] = own
    middleware.begin()
    assert os.environ[middleware.PROFILE_VARIABLE] == own and len(begun) == 1
    told = capfd.readouterr().err
    assert ('/somewhere/else.xml does not exist' in told) == is_told == bool(told)


def test_a_profile_in_the_working_folder_stays(begun, tmp_path):
    (tmp_path / middleware.PROFILE_IN_FOLDER).write_text('<dds/>')
    middleware.begin()
    assert middleware.PROFILE_VARIABLE not in os.environ and len(begun) == 1


def test_a_node_that_is_killed_and_started_again_hears_at_once(ros, tmp_path):
    """By itself the middleware often keeps it waiting for 1 to 4 s."""
    node, spin_until = ros
    publisher = node.create_publisher(MagneticField, '/field', STREAM_OUTPUT)
    # So fast that what is kept for those who were killed is full when the next comes.
    node.create_timer(0.005, lambda: publisher.publish(MagneticField()))
    waits = []
    for i in range(4):
        heard = tmp_path / f'heard_{i}'
        with subprocess.Popen([sys.executable, '-c', LISTENER, str(heard)],
                              env=environment()) as listener:
            try:
                assert spin_until(heard.exists)
            finally:
                listener.kill()
        waits.append(float(heard.read_text()))
    print(f'heard after {", ".join(f"{w:.2f}" for w in waits)} s')
    assert max(waits) < 0.8


def test_no_node_keeps_more_than_can_be_asked_for_at_once(ros):
    """Else the one after a node that was killed has to ask twice, the second time seconds later."""
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
        # The middleware's own topics of parameters are not the project's.
        assert {t: n for t, n in sent.items()
                if n > MAX_REQUESTS and t not in ('/parameter_events', '/rosout')} == {}
    finally:
        for node in nodes:
            node.destroy_node()
