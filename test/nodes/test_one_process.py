"""`mag-tracking run`: stages call each other directly and publish their topics."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from mag_tracking_msgs.msg import NetworkFrame, TrackArray
from rclpy.node import Node
from sensor_msgs.msg import MagneticField

from mag_tracking.messages.schema import stamp_ns
from mag_tracking.messages.types import NETWORK_FRAME
from mag_tracking.nodes.runner import make_nodes, run
from mag_tracking.nodes.stage_node import RESULT_QOS, STREAM_QOS
from mag_tracking.pipeline import settings_for
from support.bundled import NETWORK_FILE, QUICK, vehicle_path

pytestmark = pytest.mark.timeout(600)


class Listener(Node):
    """Stores the messages between the stages in the order of arrival."""

    def __init__(self):
        super().__init__('listener')
        self.frames, self.poses, self.fields, self.statuses = [], [], [], {}
        self.create_subscription(NetworkFrame, NETWORK_FRAME, self.frames.append, STREAM_QOS)
        self.create_subscription(MagneticField, '/mag_1/imu/mag_calibrated', self.fields.append,
                                 STREAM_QOS)
        self.create_subscription(PoseWithCovarianceStamped, '/tracker_node/pose',
                                 self.poses.append, STREAM_QOS)
        self.n_early = 0
        self.create_subscription(TrackArray, '/tracker_node/tracks', self._receive_tracks,
                                 STREAM_QOS)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._receive_diagnostics,
                                 RESULT_QOS)

    def _receive_tracks(self, message):
        """Count tracks that arrive before their frame; viewers draw the track with its frame."""
        stamps = {stamp_ns(f.header.stamp) for f in self.frames}
        self.n_early += any(stamp_ns(t.header.stamp) not in stamps for t in message.tracks)

    def _receive_diagnostics(self, message):
        self.statuses |= {s.name: s for s in message.status}


def test_topics_between_the_stages_are_published():
    listeners = []
    run(NETWORK_FILE, settings_for('vehicle', {**QUICK, 'align.max_wait_s': 5.0}),
        vehicle_path('straight_car_right'), 4.0,
        observers=[lambda: listeners.append(Listener()) or listeners[-1]])
    (listener,) = listeners
    stamps = [stamp_ns(f.header.stamp) for f in listener.frames]
    assert len(stamps) > 100 and (np.diff(stamps) > 0).all()
    assert ({stamp_ns(p.header.stamp) for p in listener.poses} <= {*stamps}
            and len(listener.poses) > 10)
    assert len(listener.fields) > 900 and listener.n_early == 0
    # Diagnostics treat calls between stages as messages.
    for name in ('detection_node: from calibration', 'tracker_node: from detection'):
        statuses = [s for key, s in listener.statuses.items() if key == name]
        assert statuses and all(s.level == b'\x00' for s in statuses), (name, statuses)


def test_no_stage_subscribes_to_another_one(ros):
    stages, _ = make_nodes(NETWORK_FILE, settings_for('vehicle', QUICK))
    try:
        for node in stages:
            topics = {s.topic_name for s in node.subscriptions}
            assert not any('calibrated' in t or NETWORK_FRAME in t for t in topics), topics
    finally:
        for node in stages:
            node.destroy_node()
