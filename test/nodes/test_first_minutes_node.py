"""Mistakes of a new target are reported in the log and in the diagnostics, within seconds."""

import subprocess
import sys
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from sensor_msgs.msg import MagneticField

from mag_tracking.messages.schema import stamp_dict
from mag_tracking.nodes.calibration_node import CalibrationNode
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.stage_node import RESULTS, STREAM
from support.bundled import NETWORK_FILE

pytestmark = pytest.mark.alone

WITHIN_S = 5.0
EARTH = np.array([2e-6, 1.55e-5, -4.9e-5])
YEAR_NS = 365 * 86400 * 1_000_000_000
BOTH = ('mag_1', 'mag_2')


class Newcomer:
    """Publishes fields at 50 Hz, as somebody does who skipped the manual.

    Parameters
    ----------
    topic : str
        With the sensor's name in place of {}.
    unit : float
        Published in place of one tesla.
    behind_ns : int
        Of the stamps.
    sensors : sequence of str
    use_sim_time : bool
        Of the node.
    """

    def __init__(self, topic='{}/imu/mag', unit=1.0, behind_ns=0, sensors=BOTH,
                 use_sim_time=False):
        self.topic, self.unit, self.behind_ns = topic, unit, behind_ns
        self.sensors, self.use_sim_time = sensors, use_sim_time

    def connect(self, node, namespace):
        """Advertise its topics in a namespace of its own."""
        self._publishers = [node.create_publisher(
            MagneticField, f'{namespace}/{self.topic.format(s)}', STREAM) for s in self.sensors]
        self._rng = np.random.default_rng(0)
        node.create_timer(0.02, self._publish)

    def _publish(self):
        for publisher in self._publishers:
            x, y, z = self.unit * (EARTH + 1.2e-8 * self._rng.standard_normal(3))
            publisher.publish(to_message(MagneticField, {
                'header': {'stamp': stamp_dict(time.time_ns() - self.behind_ns)},
                'magnetic_field': {'x': x, 'y': y, 'z': z}}))


CASES = {
    'no sensor': (Newcomer(sensors=()), 'has no publisher'),
    'one of two missing': (Newcomer(sensors=('mag_1',)), '/mag_2/imu/mag has no publisher'),
    'another topic': (Newcomer('{}/magnetic_field'), 'are published on /case_2/mag_1/magnetic_f'),
    'another type': (Newcomer(sensors=()), 'publishes sensor_msgs/msg/Imu on /case_3/mag_1'),
    'gauss': (Newcomer(unit=1e4), 'gauss or microtesla published as tesla'),
    'microtesla': (Newcomer(unit=1e6), 'gauss or microtesla published as tesla'),
    'time since the device was switched on': (
        Newcomer(behind_ns=time.time_ns() - 100 * 1_000_000_000), 'years behind the clock'),
    'a bag without use_sim_time': (Newcomer(behind_ns=3 * YEAR_NS), 'use_sim_time'),
    'use_sim_time without a clock': (
        Newcomer(use_sim_time=True), 'no message was received on /clock'),
    'another time zone': (Newcomer(behind_ns=7200 * 1_000_000_000), 'stamps are 7200.')}


OF_ANOTHER_TYPE = """
import time
import rclpy
from sensor_msgs.msg import Imu
rclpy.init()
node = rclpy.create_node('stranger')
publisher = node.create_publisher(Imu, '/case_3/mag_1/imu/mag', 10)
time.sleep(600.0)
"""
"""In a process of its own: in one process a topic has one type."""


def node_in(namespace, new_target):
    """A calibration node of its own for each case."""
    return CalibrationNode(namespace=namespace, parameter_overrides=[
        Parameter('network', value=str(NETWORK_FILE)),
        Parameter('use_sim_time', value=new_target.use_sim_time)])


def test_a_users_first_minutes(ros, capfd):
    node, spin_until = ros
    told, lags = {}, []

    def take(message):
        for status in message.status:
            if status.level != DiagnosticStatus.OK:
                case = list(CASES)[int(status.name.split('/')[0].removeprefix('case_'))]
                if CASES[case][1] in status.message:
                    told.setdefault(case, time.monotonic())
    node.create_subscription(DiagnosticArray, '/diagnostics', take, RESULTS)
    node.create_timer(0.05, lambda: lags.append(time.monotonic()))
    began, nodes = {}, []
    stranger = subprocess.Popen([sys.executable, '-c', OF_ANOTHER_TYPE])
    try:
        assert spin_until(lambda: node.count_publishers('/case_3/mag_1/imu/mag'))
        for k, (case, (new_target, _)) in enumerate(CASES.items()):
            new_target.connect(node, f'/case_{k}')
            nodes.append(node_in(f'/case_{k}', new_target))
            began[case] = time.monotonic()
            node.executor.add_node(nodes[-1])
        spin_until(lambda: len(told) == len(CASES), 60.0)
    finally:
        stranger.kill()
        stranger.wait()
        for one in nodes:
            node.executor.remove_node(one)
            one.destroy_node()
    logged = capfd.readouterr().err
    missing = [case for case, (_, words) in CASES.items()
               if case not in told or words not in logged]
    assert not missing, logged
    for k, case in enumerate(CASES):
        line = next(line for line in logged.splitlines()
                    if f'case_{k}.' in line and CASES[case][1] in line)
        assert line.startswith(('[WARN]', '[ERROR]'))
    took = {case: told[case] - began[case] for case in CASES}
    print({case: round(seconds, 1) for case, seconds in took.items()})
    # What the machine itself was late by.
    late = float(np.diff(lags).max())
    assert max(took.values()) <= WITHIN_S + 2.0 * late
