"""Where the sensors are, as static transforms."""

from collections.abc import Mapping

from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from mag_tracking.messages.standard import sensor_transform_dicts
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.stage_node import LATCHED


class SensorTransforms:
    """Publishes the frame of each sensor on /tf_static, anew where something has changed.

    The frame is that of the sensor's messages; until one comes, its name.
    """

    def __init__(self, node: Node, network: SensorNetwork) -> None:
        self._node, self._network_frame = node, network.frame
        self._publisher = node.create_publisher(TFMessage, '/tf_static', LATCHED)
        self._frames = {name: name for name in network.names}

    def is_news(self, sensor: str, frame: str) -> bool:
        """Whether a sensor's messages are of another frame than the one that was published.

        That of the network, or of another sensor, is not the frame of this one.
        """
        taken = {self._network_frame, *(f for name, f in self._frames.items() if name != sensor)}
        return bool(frame) and frame not in taken and self._frames[sensor] != frame

    def publish(self, network: SensorNetwork, frames: Mapping[str, str]) -> None:
        """Publish the transforms of a `network`, with new `frames` {sensor: frame}."""
        self._frames.update(frames)
        now_ns = self._node.get_clock().now().nanoseconds
        self._publisher.publish(to_message(TFMessage, {
            'transforms': sensor_transform_dicts(network, self._frames, now_ns)}))
