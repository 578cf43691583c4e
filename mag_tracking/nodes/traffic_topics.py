"""Traffic statistics topics of the tracker node."""

from mag_tracking_msgs.msg import TrafficSummary as TrafficSummaryMessage
from mag_tracking_msgs.msg import VehiclePassage as VehiclePassageMessage

from mag_tracking.event_records import VehiclePassage
from mag_tracking.messages.schema import traffic_summary_dict, vehicle_passage_dict
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.ros_params import declare_settings
from mag_tracking.nodes.stage_node import PUBLISHER_QOS, RESULT_QOS, StageNode
from mag_tracking.stages.traffic.stage import TrackedFrame, Traffic


class TrafficTopics:
    """Counts the vehicles of a tracker node, and publishes passages and summaries."""

    def __init__(self, node: StageNode) -> None:
        node.settings = declare_settings(node, node.settings, 'traffic')
        self.stage = Traffic(node.network, node.settings.traffic,
                             node.settings.track.target == 'vehicle')
        self._classes = [c.name for c in node.settings.traffic.classes]
        self._frame = node.network.frame
        self._passage_publisher = node.publisher(VehiclePassageMessage, '~/passages', PUBLISHER_QOS)
        self._summary_publisher = node.publisher(TrafficSummaryMessage, '~/traffic', RESULT_QOS)

    def add(self, item: TrackedFrame) -> None:
        """Process the records of a frame; publish completed passages and summaries."""
        for record in self.stage.feed(item):
            if isinstance(record, VehiclePassage):
                self._passage_publisher.publish(to_message(
                    VehiclePassageMessage,
                    vehicle_passage_dict(record, self._classes, self._frame)))
            else:
                self._summary_publisher.publish(to_message(
                    TrafficSummaryMessage, traffic_summary_dict(record, self._frame)))
