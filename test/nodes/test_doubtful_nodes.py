"""Doubtful background in the nodes: the tracker flags its poses as ambiguous."""

import pytest
from mag_tracking_msgs.msg import CalibrationState, FieldReadings, TrackArray

from mag_tracking.messages.schema import readings_dict
from mag_tracking.messages.types import RAW_READINGS
from mag_tracking.nodes.convert import to_message, track_of
from mag_tracking.nodes.stage_node import LATCHED_QOS, PUBLISHER_QOS, STREAM_QOS
from mag_tracking.units import NS
from support.bundled import NETWORK_FILE
from support.dense_traffic import after_dense_traffic
from support.node_processes import start, stop

pytestmark = pytest.mark.timeout(600)
NODE_NAMES = ('calibration_node', 'detection_node', 'tracker_node')


def test_nodes_track_and_flag_poses_after_dense_traffic(ros):
    node, spin_until = ros
    readings = after_dense_traffic('junction_left_to_right', 7.0)
    t = (readings.stamp_ns - readings.stamp_ns.min()) / NS
    states, tracks = [], []
    node.create_subscription(CalibrationState, '/calibration_state', states.append,
                             LATCHED_QOS)
    node.create_subscription(TrackArray, '/tracker_node/tracks', tracks.append, STREAM_QOS)
    publisher = node.create_publisher(FieldReadings, RAW_READINGS, PUBLISHER_QOS)

    def publish(part):
        for i in range(0, len(part), 40):
            publisher.publish(to_message(FieldReadings, readings_dict(part.part(slice(i, i + 40)))))
            spin_until(lambda: True)

    processes = [start(name, '-p', f'network:={NETWORK_FILE}') for name in NODE_NAMES]
    try:
        assert spin_until(lambda: publisher.get_subscription_count() > 0
                          and node.count_subscribers('/field_readings_calibrated')
                          and node.count_subscribers('/network_frame')
                          and node.count_subscribers('/calibration_state') > 1
                          and node.count_publishers('/tracker_node/tracks'))
        publish(readings.part(t < 7.3))
        assert spin_until(lambda: states and any(s.doubtful for s in states[-1].sensors))
        publish(readings.part(t >= 7.3))
        assert spin_until(lambda: any(track.status == track.ENDED for m in tracks
                                      for track in m.tracks))
    finally:
        exit_codes, outputs = stop(processes)
    assert exit_codes == [0] * 3, outputs
    poses = [track_of(track) for m in tracks for track in m.tracks if track.status == track.ACTIVE]
    assert len(poses) > 10 and all(pose.ambiguous for pose in poses)
    doubtful = next(s for m in states for s in m.sensors if s.doubtful)
    assert doubtful.ready and doubtful.doubtful_since.sec and not doubtful.doubtful_until.sec
