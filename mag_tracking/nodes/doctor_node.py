"""The doctor on a live system: listens to the sensors' topics for a while."""

import time
from functools import partial

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import MagneticField

from mag_tracking.doctoring import Doctor
from mag_tracking.io.schema import sample_of
from mag_tracking.nodes.stage_node import SENSORS, make_executor, spin
from mag_tracking.stages.health import Finding


class DoctorNode(Node):
    """Hands the readings of a network to a `Doctor`, with the time at which they came."""

    def __init__(self, network, settings):
        super().__init__('doctor')
        self.doctor = Doctor(network, settings)
        for sensor, topic in zip(network.names, network.topics, strict=True):
            self.create_subscription(MagneticField, topic, partial(self._take, sensor), SENSORS)

    def _take(self, sensor, message):
        """One reading."""
        self.doctor.feed(sample_of(message, sensor), time.time_ns())

    def findings(self):
        """What only the graph tells: list of `Finding`."""
        found = []
        network = self.doctor.network
        for sensor, topic in zip(network.names, network.topics, strict=True):
            publishers = self.get_publishers_info_by_topic(topic)
            if not publishers:
                found.append(Finding(True, sensor, f'nobody publishes {topic}', 'start its driver, '
                                     'and compare its topic with the network file'))
            elif len(publishers) > 1:
                names = ', '.join(sorted(p.node_name for p in publishers))
                found.append(Finding(True, sensor, f'{len(publishers)} nodes publish {topic}: '
                                     f'{names}', 'stop all but one'))
            for p in publishers:
                if p.topic_type != 'sensor_msgs/msg/MagneticField':
                    found.append(Finding(True, sensor, f'{p.node_name} publishes {p.topic_type} on '
                                         f'{topic}', 'it has to be sensor_msgs/msg/MagneticField'))
        return found


def listen(network, settings, seconds, stopped):
    """Listen for `seconds` or until `stopped()`: (Doctor, list of Finding of the graph)."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor = make_executor()
    node = DoctorNode(network, settings)
    try:
        executor.add_node(node)
        end = time.monotonic() + seconds
        spin(executor, lambda: stopped() or time.monotonic() > end)
        return node.doctor, node.findings()
    finally:
        executor.remove_node(node)
        node.destroy_node()
        executor.shutdown()
        rclpy.try_shutdown()
