"""How processes begin with ROS: whose profile of the middleware is in force, and what it is for."""

import os
import subprocess
import sys

import pytest
import rclpy
from sensor_msgs.msg import MagneticField

from mag_tracking.nodes import middleware
from mag_tracking.nodes.stage_node import SENT

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
node, heard, began = Node('listener'), Future(), time.monotonic()
node.create_subscription(MagneticField, '/field', heard.set_result, STREAM)
executor = EventsExecutor()
executor.add_node(node)
executor.spin_until_future_complete(heard, 10.0)
waited = time.monotonic() - began
partial = Path(sys.argv[1]).with_suffix('.partial')
partial.write_text(str(waited))
partial.rename(sys.argv[1])
time.sleep(60.0)
"""


@pytest.fixture
def begun(monkeypatch, tmp_path):
    """What `rclpy.init` is called with, in an empty folder with nothing said of profiles."""
    calls = []
    monkeypatch.setattr(rclpy, 'init', lambda **k: calls.append(k))
    # A copy: what `begin` writes is gone after the test.
    monkeypatch.setattr(os, 'environ', {n: v for n, v in os.environ.items()
                                        if n != middleware.NAME})
    monkeypatch.chdir(tmp_path)
    return calls


def test_the_profile_is_in_force_unless_somebody_has_his_own(begun):
    middleware.begin(['--ros-args'])
    assert begun[0]['args'] == ['--ros-args']
    assert os.environ[middleware.NAME] == str(middleware.PROFILE) and middleware.PROFILE.exists()


@pytest.mark.parametrize('own', ['/somewhere/else.xml', ''])
def test_a_profile_of_the_user_stays(begun, own):
    """Also that he wants none."""
    os.environ[middleware.NAME] = own
    middleware.begin()
    assert os.environ[middleware.NAME] == own and len(begun) == 1


def test_a_profile_in_the_working_folder_stays(begun, tmp_path):
    (tmp_path / middleware.USUAL).write_text('<dds/>')
    middleware.begin()
    assert middleware.NAME not in os.environ and len(begun) == 1


def test_a_node_that_is_killed_and_started_again_hears_at_once(ros, tmp_path):
    """By itself the middleware keeps it waiting for 1.7 to 2.8 s, each time but the first."""
    node, spin_until = ros
    publisher = node.create_publisher(MagneticField, '/field', SENT)
    # So fast that what is kept for those who were killed is full when the next comes.
    node.create_timer(0.005, lambda: publisher.publish(MagneticField()))
    waits = []
    for i in range(4):
        heard = tmp_path / f'heard_{i}'
        with subprocess.Popen([sys.executable, '-c', LISTENER, str(heard)]) as listener:
            try:
                assert spin_until(heard.exists, 20.0)
            finally:
                listener.kill()
        waits.append(float(heard.read_text()))
    print(f'heard after {", ".join(f"{w:.2f}" for w in waits)} s')
    assert max(waits) < 1.0
