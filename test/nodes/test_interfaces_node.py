"""Standard messages of the nodes over the middleware: transforms, detections, markers."""

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rclpy.node import Node
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import MarkerArray

from mag_tracking.messages.schema import stamp_ns
from mag_tracking.nodes.runner import run
from mag_tracking.nodes.stage_node import LATCHED_QOS, STREAM_QOS, TRANSFORM_QOS
from mag_tracking.pipeline import settings_for
from support.bundled import NETWORK_FILE, vehicle_path

pytestmark = pytest.mark.timeout(600)


class Consumer(Node):
    """Stores received messages."""

    def __init__(self):
        super().__init__('consumer')
        self.tf, self.static, self.odometry, self.detections, self.markers = [], [], [], [], []
        self.sensors = []
        for kind, topic, received, qos in (
                (TFMessage, '/tf', self.tf, TRANSFORM_QOS),
                (TFMessage, '/tf_static', self.static, LATCHED_QOS),
                (Odometry, 'tracker_node/odometry', self.odometry, STREAM_QOS),
                (Detection3DArray, 'tracker_node/detections_3d', self.detections, STREAM_QOS),
                (MarkerArray, 'tracker_node/markers', self.markers, STREAM_QOS),
                (MarkerArray, 'tracker_node/sensor_markers', self.sensors, LATCHED_QOS)):
            self.create_subscription(kind, topic, received.append, qos)


def test_transforms_detections_and_markers_describe_the_track():
    """The nodes run in a namespace, with the parameters that `robot_localization` requires."""
    consumers = []
    run(NETWORK_FILE, settings_for('vehicle', {'align.max_wait_s': 5.0}),
        vehicle_path('straight_car_fast_left'), 3.0,
        observers=[lambda: consumers.append(Consumer()) or consumers[-1]],
        ros_arguments=['--ros-args', '-r', '__ns:=/road', '-p', 'publish_tf:=true',
                       '-p', 'child_frame:=vehicle'])
    consumer, = consumers
    frames = [t.child_frame_id for m in consumer.static for t in m.transforms]
    assert set(frames) == {'mag_1', 'mag_2'}
    assert {t.header.frame_id for m in consumer.static for t in m.transforms} == {'map'}
    assert len(consumer.odometry) > 10
    assert {m.child_frame_id for m in consumer.odometry} == {'vehicle'}
    transforms = [t for m in consumer.tf for t in m.transforms]
    assert {t.child_frame_id for t in transforms} == {'vehicle'}
    by_time = {stamp_ns(m.header.stamp): m.pose.pose.position for m in consumer.odometry}
    for t in transforms:
        p = by_time[stamp_ns(t.header.stamp)]
        np.testing.assert_array_equal([t.transform.translation.x, t.transform.translation.y],
                                      [p.x, p.y])
    last = consumer.detections[-1]
    assert last.detections == [] and consumer.detections[-2].detections[0].id == '1'
    assert {m.ns for m in consumer.markers[-1].markers} == {'ellipsoid', 'moment', 'label'}
    assert {m.text for a in consumer.sensors for m in a.markers if m.text} == {'mag_1', 'mag_2'}
