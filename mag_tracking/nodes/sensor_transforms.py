"""Static transforms of the sensors."""

from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from mag_tracking.messages.standard import sensor_transform_dicts
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.stage_node import LATCHED_QOS


class SensorTransforms:
    """Publishes a static transform for each sensor; the child frame has the name of the sensor.

    The `frame_id` of the sensor messages is not used: it may name a robot link that another node
    publishes, and a frame with two parents would break the transform tree.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(TFMessage, '/tf_static', LATCHED_QOS)

    def publish(self, network: SensorNetwork) -> None:
        """Publish the transforms of a network."""
        self._publisher.publish(to_message(TFMessage, {'transforms': sensor_transform_dicts(
            network, self._node.get_clock().now().nanoseconds)}))
