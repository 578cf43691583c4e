"""The doctor on a live system: listens to the sensors' topics for a while."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
from mag_tracking_msgs.msg import FieldReadings
from rclpy.node import Node
from sensor_msgs.msg import MagneticField

from mag_tracking.apps.doctor import Doctor
from mag_tracking.errors import RecordingError
from mag_tracking.messages.schema import reading_of, readings_of
from mag_tracking.messages.types import RAW_READINGS
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes.middleware import begin
from mag_tracking.nodes.sensor_graph import missing_publisher, topic_findings
from mag_tracking.nodes.shutdown import shut_down
from mag_tracking.nodes.stage_node import SENSORS, STREAM, make_executor, spin
from mag_tracking.pipeline import Settings
from mag_tracking.stages.health.sensor_health import Finding


class DoctorNode(Node):
    """Hands the readings of a network to a `Doctor`, with the time at which they came."""

    def __init__(self, network: SensorNetwork, settings: Settings) -> None:
        super().__init__('doctor', namespace=network.namespace)
        self.doctor = Doctor(network, settings)
        self._topics = dict(zip(network.names, map(self.resolve_topic_name, network.topics),
                                strict=True))
        for sensor, topic in self._topics.items():
            self.create_subscription(MagneticField, topic, partial(self._take, sensor), SENSORS)
        self._in_batches: set[str] = set()
        self._bad: Counter[str] = Counter()
        self.create_subscription(FieldReadings, RAW_READINGS, self._take_many, STREAM)

    def _take(self, sensor: str, message: MagneticField) -> None:
        """One reading."""
        self.doctor.feed(reading_of(message, sensor), time.time_ns())

    def _take_many(self, message: FieldReadings) -> None:
        """Readings of many sensors; of those in the network."""
        try:
            readings = readings_of(message)
        except RecordingError as error:
            self._bad[str(error)] += 1
            return
        known = [name in self.doctor.network.names for name in readings.names]
        readings = readings.part(np.array(known, dtype=bool)[readings.sensor])
        self._in_batches.update(readings.sensor_names())
        self.doctor.feed(readings, time.time_ns())

    def findings(self) -> list[Finding]:
        """What only the graph tells: list of `Finding`."""
        topic = self.resolve_topic_name(RAW_READINGS)
        found = [Finding(True, topic, f'{n} messages that are none: {error}', 'look at the driver '
                         'that publishes it') for error, n in self._bad.items()]
        for sensor, topic in self._topics.items():
            found += topic_findings(self, sensor, topic)
            if sensor not in self._in_batches and not self.count_publishers(topic):
                found.append(missing_publisher(self, sensor, topic, self._topics))
        return found


@dataclass
class DoctorResult:
    """Result of listening."""

    doctor: Doctor
    findings: list[Finding]
    """Findings that only the graph shows."""
    status: int = 1
    """Exit status if the middleware does not shut down; set it when the report is written."""


@contextmanager
def listening(network: SensorNetwork, settings: Settings, seconds: float,
              stopped: Callable[[], bool], ros_arguments: Sequence[str] = ()
              ) -> Iterator[DoctorResult]:
    """Listen for `seconds` or until `stopped()`; leave the graph after the context.

    If the middleware hangs, the process ends there: see `leave`.
    """
    begin(list(ros_arguments))
    executor = make_executor()
    node = DoctorNode(network, settings)
    heard = DoctorResult(node.doctor, [])
    try:
        executor.add_node(node)
        end = time.monotonic() + seconds
        spin(executor, lambda: stopped() or time.monotonic() > end)
        heard.findings = node.findings()
        yield heard
    finally:
        shut_down([node], executor, heard.status)
