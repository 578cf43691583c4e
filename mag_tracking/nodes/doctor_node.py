"""Live input of `mag-tracking doctor`, received for a limited time."""

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
from mag_tracking_msgs.msg import FieldReadings
from rclpy.node import Node
from sensor_msgs.msg import MagneticField

from mag_tracking.apps.doctor import Doctor, load_findings
from mag_tracking.errors import RecordingError
from mag_tracking.messages.schema import reading_of, readings_of
from mag_tracking.messages.types import RAW_READINGS
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes.connections import no_message_finding, topic_findings
from mag_tracking.nodes.middleware import init_ros, make_executor, shut_down, spin
from mag_tracking.nodes.stage_node import SENSOR_QOS, STREAM_QOS
from mag_tracking.pipeline import Pipeline, Settings
from mag_tracking.quantities import quantity
from mag_tracking.stages.health.diagnosis import Cause, Finding


class DoctorNode(Node):
    """Passes readings to a `Doctor`; `status` is that of the process if the middleware hangs."""

    def __init__(self, network: SensorNetwork, settings: Settings) -> None:
        super().__init__('doctor', namespace=network.namespace)
        self.doctor, self.status = Doctor(Pipeline(network, settings, 'calibrate')), 1
        self._topics = dict(zip(network.names, map(self.resolve_topic_name, network.topics),
                                strict=True))
        for sensor, topic in self._topics.items():
            self.create_subscription(MagneticField, topic, partial(
                lambda sensor, message: self.doctor.feed(
                    reading_of(message, sensor), time.time_ns()), sensor), SENSOR_QOS)
        self._batched_sensors: set[str] = set()
        self._invalid_messages: Counter[str] = Counter()
        self.create_subscription(FieldReadings, RAW_READINGS, self._receive_batch, STREAM_QOS)

    def _receive_batch(self, message: FieldReadings) -> None:
        """Pass the readings of the network's sensors to the doctor; count invalid messages."""
        try:
            readings = readings_of(message)
        except RecordingError as error:
            self._invalid_messages[str(error)] += 1
            return
        is_known = [name in self.doctor.network.names for name in readings.names]
        readings = readings.part(np.array(is_known, dtype=bool)[readings.sensor])
        self._batched_sensors.update(readings.sensor_names())
        self.doctor.feed(readings, time.time_ns())

    def findings(self) -> list[Finding]:
        """Faults found in the ROS graph and in the contents of messages."""
        topic = self.resolve_topic_name(RAW_READINGS)
        found = [Finding(True, topic, f'{quantity(n, "invalid message")}: {error}',
                         'check the driver that publishes this topic', Cause.UNDECODABLE)
                 for error, n in self._invalid_messages.items()]
        for sensor, topic in self._topics.items():
            found += topic_findings(self, sensor, topic)
            if sensor not in self._batched_sensors and not self.count_publishers(topic):
                found.append(no_message_finding(self, sensor, topic, self._topics))
        return [*load_findings(self.doctor.findings(), list(self._topics), os.getloadavg()[0],
                               os.cpu_count() or 1), *found]


@contextmanager
def listening(network: SensorNetwork, settings: Settings, seconds: float,
              stopped: Callable[[], bool], ros_arguments: Sequence[str] = ()
              ) -> Iterator[DoctorNode]:
    """Receive readings for at most `seconds`, or until `stopped()`; yield the node."""
    init_ros(list(ros_arguments))
    executor, node = make_executor(), DoctorNode(network, settings)
    try:
        executor.add_node(node)
        end = time.monotonic() + seconds
        spin(executor, lambda: stopped() or time.monotonic() > end)
        yield node
    finally:
        shut_down([node], executor, node.status)
