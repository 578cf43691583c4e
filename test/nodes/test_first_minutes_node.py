"""Mistakes of a new user are reported in the log and the diagnostics within seconds."""

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
from mag_tracking.nodes.stage_node import RESULT_QOS, STREAM_QOS
from support.bundled import NETWORK_FILE

pytestmark = pytest.mark.alone

MAX_REPORT_S = 5.0
EARTH_FIELD = np.array([2e-6, 1.55e-5, -4.9e-5])
YEAR_NS = 365 * 86400 * 1_000_000_000
BOTH_SENSORS = ('mag_1', 'mag_2')


class NewUser:
    """Publishes fields at 50 Hz with a mistake that a new user may make.

    Parameters
    ----------
    topic : str
        Topic with {} in place of the sensor's name.
    unit : float
        Value published for one tesla.
    delay_ns : int
        Delay of the timestamps.
    sensors : sequence of str
        Sensors whose fields are published.
    use_sim_time : bool
        Parameter of the calibration node.
    """

    def __init__(self, topic='{}/imu/mag', unit=1.0, delay_ns=0, sensors=BOTH_SENSORS,
                 use_sim_time=False):
        self.topic, self.unit, self.delay_ns = topic, unit, delay_ns
        self.sensors, self.use_sim_time = sensors, use_sim_time

    def connect(self, node, namespace):
        """Advertise the topics in a namespace."""
        self._publishers = [node.create_publisher(
            MagneticField, f'{namespace}/{self.topic.format(s)}', STREAM_QOS) for s in self.sensors]
        self._rng = np.random.default_rng(0)
        node.create_timer(0.02, self._publish)

    def _publish(self):
        for publisher in self._publishers:
            x, y, z = self.unit * (EARTH_FIELD + 1.2e-8 * self._rng.standard_normal(3))
            publisher.publish(to_message(MagneticField, {
                'header': {'stamp': stamp_dict(time.time_ns() - self.delay_ns)},
                'magnetic_field': {'x': x, 'y': y, 'z': z}}))


CASES = {
    'no sensor': (NewUser(sensors=()), 'has no publisher'),
    'one of two missing': (NewUser(sensors=('mag_1',)), '/mag_2/imu/mag has no publisher'),
    'another topic': (NewUser('{}/magnetic_field'), 'are published on /case_2/mag_1/magnetic_f'),
    'another type': (NewUser(sensors=()), 'publishes sensor_msgs/msg/Imu on /case_3/mag_1'),
    'gauss': (NewUser(unit=1e4), 'gauss or microtesla published as tesla'),
    'microtesla': (NewUser(unit=1e6), 'gauss or microtesla published as tesla'),
    'time since the device was switched on': (
        NewUser(delay_ns=time.time_ns() - 100 * 1_000_000_000), 'years behind the clock'),
    'a bag without use_sim_time': (NewUser(delay_ns=3 * YEAR_NS), 'use_sim_time'),
    'use_sim_time without a clock': (
        NewUser(use_sim_time=True), 'no message was received on /clock'),
    'another time zone': (NewUser(delay_ns=7200 * 1_000_000_000),
                          'delay from timestamp to receipt is 7200.')}


OTHER_TYPE_PROGRAM = """
import time
import rclpy
from sensor_msgs.msg import Imu
rclpy.init()
node = rclpy.create_node('stranger')
publisher = node.create_publisher(Imu, '/case_3/mag_1/imu/mag', 10)
time.sleep(600.0)
"""
"""Program of a separate process, because a topic has only one type within a process."""


def node_in(namespace, user):
    """Create a calibration node in a namespace, with the `use_sim_time` of a new user."""
    return CalibrationNode(namespace=namespace, parameter_overrides=[
        Parameter('network', value=str(NETWORK_FILE)),
        Parameter('use_sim_time', value=user.use_sim_time)])


def test_mistakes_of_a_new_user_are_reported_within_seconds(ros, capfd):
    node, spin_until = ros
    reported, tick_times = {}, []

    def check(message):
        for status in message.status:
            if status.level != DiagnosticStatus.OK:
                case = list(CASES)[int(status.name.split('/')[0].removeprefix('case_'))]
                if CASES[case][1] in status.message:
                    reported.setdefault(case, time.monotonic())
    node.create_subscription(DiagnosticArray, '/diagnostics', check, RESULT_QOS)
    node.create_timer(0.05, lambda: tick_times.append(time.monotonic()))
    start_times, nodes = {}, []
    other_process = subprocess.Popen([sys.executable, '-c', OTHER_TYPE_PROGRAM])
    try:
        assert spin_until(lambda: node.count_publishers('/case_3/mag_1/imu/mag'))
        for k, (case, (user, _)) in enumerate(CASES.items()):
            user.connect(node, f'/case_{k}')
            nodes.append(node_in(f'/case_{k}', user))
            start_times[case] = time.monotonic()
            node.executor.add_node(nodes[-1])
        spin_until(lambda: len(reported) == len(CASES), 60.0)
    finally:
        other_process.kill()
        other_process.wait()
        for calibration_node in nodes:
            node.executor.remove_node(calibration_node)
            calibration_node.destroy_node()
    logged = capfd.readouterr().err
    missing = [case for case, (_, text) in CASES.items()
               if case not in reported or text not in logged]
    assert not missing, logged
    for k, case in enumerate(CASES):
        line = next(line for line in logged.splitlines()
                    if f'case_{k}.' in line and CASES[case][1] in line)
        assert line.startswith(('[WARN]', '[ERROR]'))
    delays_s = {case: reported[case] - start_times[case] for case in CASES}
    print({case: round(seconds, 1) for case, seconds in delays_s.items()})
    # Longest stall of this process.
    stall_s = float(np.diff(tick_times).max())
    assert max(delays_s.values()) <= MAX_REPORT_S + 2.0 * stall_s
