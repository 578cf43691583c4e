"""tracker_node: tracks targets from network frames and publishes their poses."""

if __name__ == '__main__':
    from mag_tracking.nodes.start import tracker_node

    tracker_node()

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from mag_tracking_msgs import msg
from mag_tracking_msgs.msg import CalibrationState, NetworkFrame
from nav_msgs.msg import Odometry, Path
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import MarkerArray

from mag_tracking.calibration.doubtful_times import DOUBTFUL_BACKGROUND, DoubtfulTimes, merged
from mag_tracking.event_records import Disturbance, VehiclePassage
from mag_tracking.messages import schema, standard
from mag_tracking.messages.network import doubtful_times, frame_of, with_orientations
from mag_tracking.messages.types import CALIBRATION_STATE, NETWORK_FRAME, MessageDict
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes import middleware, stage_node
from mag_tracking.nodes.convert import has_subscribers, send, to_message
from mag_tracking.nodes.ros_params import declare_settings, fixed_parameter, follow_changes
from mag_tracking.nodes.scheduling import steady_timer
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.stages.stage import Stage
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.stages.track.plausibility import lane_note
from mag_tracking.stages.track.running_track import TrackRecord
from mag_tracking.stages.track.settings import BEST
from mag_tracking.stages.traffic.stage import TrackedFrame, Traffic

TRANSPORT_MARGIN_S = 1.0
"""[s] Margin for the transport of a frame, in addition to `track.end_gap_s`."""
MAX_PATH_POSES = 2000
"""Maximum number of poses in `~/path`."""
OUTPUTS = {
    '/tf': (TFMessage, stage_node.TRANSFORM_QOS),
    '~/pose': (PoseWithCovarianceStamped, stage_node.PUBLISHER_QOS),
    '~/odometry': (Odometry, stage_node.RESULT_QOS),
    '~/tracks': (msg.TrackArray, stage_node.PUBLISHER_QOS),
    '~/hypotheses': (msg.HypothesisArray, stage_node.PUBLISHER_QOS),
    '~/path': (Path, stage_node.RESULT_QOS),
    '~/pose_smoothed': (PoseWithCovarianceStamped, stage_node.PUBLISHER_QOS),
    '~/smoothed': (msg.SmoothedTrack, stage_node.RESULT_QOS),
    '~/path_smoothed': (Path, stage_node.RESULT_QOS),
    '~/disturbances': (msg.Disturbance, stage_node.PUBLISHER_QOS),
    '~/markers': (MarkerArray, stage_node.RESULT_QOS),
    '~/detections_3d': (Detection3DArray, stage_node.RESULT_QOS),
    '~/sensor_markers': (MarkerArray, stage_node.LATCHED_QOS),
    '~/passages': (msg.VehiclePassage, stage_node.PUBLISHER_QOS),
    '~/traffic': (msg.TrafficSummary, stage_node.RESULT_QOS)}
"""Message type and QoS of each published topic."""


class TrackerNode(stage_node.StageNode):
    """Tracks targets with a bank of filters; with `has_direct_input`, frames are passed to
    `receive_frame`, and `after_pose`, called before the track is published, publishes the frame."""

    def __init__(self, has_direct_input: bool = False, **node_arguments: Any) -> None:
        super().__init__('tracker_node', 'track', **node_arguments)
        self._has_direct_input = has_direct_input
        self.after_pose: Callable[[], None] | None = None
        self._stage = TrackManager(self.network, self.settings.track)
        # Called by a calibration node in the same process.
        self.set_input_doubts, self.idle = self._stage.set_input_doubts, self._stage.idle
        self.settings = declare_settings(self, self.settings, 'traffic')
        self._traffic = Traffic(self.network, self.settings.traffic,
                                self.settings.track.target == 'vehicle')
        follow_changes(self, self.settings, lambda s: self._stage.configure(s.track))
        self._child_frame = fixed_parameter(
            self, 'child_frame', '', 'Frame of the target in odometry and transforms, for example '
            'for robot_localization. If empty, the frame is track_<id>.')
        self._publishes_tf = fixed_parameter(
            self, 'publish_tf', False, 'Publish the transform from the world frame to the frame '
            'of the target.')
        self._outputs = {topic: self.publisher(message_type, topic, qos)
                         for topic, (message_type, qos) in OUTPUTS.items()
                         if topic != '/tf' or self._publishes_tf}
        self._send('~/sensor_markers', standard.sensor_markers(self.network))
        self._poses_by_track: dict[int, deque[PoseStamped]] = {}
        self._is_silent, self._latest_id = False, -1
        self._doubtful_times: dict[str, DoubtfulTimes] = {}
        if has_direct_input:
            self.receive_frame = self.direct_input('detection', [NETWORK_FRAME], self._feed,
                                                   lambda frame: frame.stamp_ns)
        else:
            self.subscription(NetworkFrame, NETWORK_FRAME, self._receive, stage_node.STREAM_QOS,
                              'detection')
        steady_timer(self, 0.25, self.end_tracks_on_timeout)
        self.subscription(CalibrationState, CALIBRATION_STATE, self._receive_calibration,
                          stage_node.LATCHED_QOS)
        self.report_state()
        note = lane_note(self.settings.track.vehicle, self.network)
        if note and self.settings.track.target == 'vehicle':
            self.get_logger().info(note)

    def stages(self) -> dict[str, Stage[Any, Any]]:
        """Stages whose counts are published in diagnostics, by name."""
        return {'track': self._stage, 'traffic': self._traffic}

    def end_tracks_on_timeout(self) -> None:
        """End the tracks if frames no longer arrive, except during a replay, which may pause.

        The time of arrival is used, because timestamps may be wrong.
        """
        if self._stage.bank is None or self.is_replayed:
            return
        last_received = self.flows['detection'].last_received
        assert last_received is not None, 'a track without a frame'
        silent_s = time.monotonic() - last_received
        # Two consecutive checks are required, because frames may be queued while the node is busy.
        was_silent, self._is_silent = self._is_silent, \
            silent_s > self.settings.track.end_gap_s + TRANSPORT_MARGIN_S
        if was_silent and self._is_silent:
            self._publish_all(self._stage.end_tracks('no frames received'), None)

    def _receive_calibration(self, message: CalibrationState) -> None:
        """Apply the orientations of a survey and the doubtful intervals of the backgrounds."""
        network = self.converted(lambda: with_orientations(self.network, message), self._stage,
                                 'calibration')
        if network is None:
            return
        if not self._has_direct_input:
            # The message has only the latest interval of each sensor; frames of earlier intervals
            # may still arrive.
            self._doubtful_times = merged(self._doubtful_times, doubtful_times(message))
            # The message does not state the reason; the diagnostics do.
            self._stage.set_input_doubts({DOUBTFUL_BACKGROUND: self._doubtful_times})
        if _same_orientations(network, self.network):
            return
        self.network = network
        self._stage.use_network(network)
        self._send('~/sensor_markers', standard.sensor_markers(network))
        self.get_logger().info('surveyed sensor orientations received; used from the next track on')

    def _receive(self, message: NetworkFrame) -> None:
        """Process a network frame."""
        frame = self.converted(lambda: frame_of(message, self.network), self._stage, 'frame')
        if frame is not None:
            self._feed(frame)
            self._stage.idle()

    def _feed(self, frame: FieldFrame) -> None:
        """Process a frame and publish the results."""
        self._publish_all(self._stage.feed(frame), frame)
        if self._stage.clock_warning:
            self.get_logger().warning(self._stage.clock_warning, throttle_duration_sec=60.0)

    def _send(self, topic: str, content: MessageDict | None) -> None:
        """Publish a message with the given fields unless they are None."""
        send(self._outputs[topic], content)

    def _publish_all(self, records: list[TrackRecord], frame: FieldFrame | None) -> None:
        """Publish the records that result from `frame`, which is None if frames do not arrive."""
        world, complete_poses = self.network.frame, []
        for record in records:
            if isinstance(record, Disturbance):
                self._send('~/disturbances', schema.disturbance_dict(record, world))
            elif not isinstance(record, SmoothedPose):
                self._publish(record)
            elif record.complete:
                complete_poses.append(record)
            # The message has no flag for ambiguity, and other hypotheses are not smoothed.
            elif not record.ambiguous or self.settings.track.ambiguous_poses == BEST:
                self._send('~/pose_smoothed', schema.smoothed_pose_dict(record, world))
        for id in dict.fromkeys(pose.id for pose in complete_poses):
            poses = [pose for pose in complete_poses if pose.id == id]
            self._send('~/smoothed', schema.smoothed_track_dict(poses, world))
            messages = [to_message(PoseStamped, schema.pose_dict(
                p.stamp_ns, world, p.position, p.orientation)) for p in poses]
            self._outputs['~/path_smoothed'].publish(
                Path(header=messages[-1].header, poses=messages))
        classes = [c.name for c in self.settings.traffic.classes]
        for result in self._traffic.feed(TrackedFrame(frame, records)):
            if isinstance(result, VehiclePassage):
                self._send('~/passages', schema.vehicle_passage_dict(result, classes, world))
            else:
                self._send('~/traffic', schema.traffic_summary_dict(result, world))

    def _publish(self, track: Track) -> None:
        """Publish one record of a track, or the end of the track, on all topics."""
        frame = self.network.frame
        if not track.ended:
            # The pose comes first, because it may be used for control.
            self._send('~/pose', schema.pose_message_dict(track, frame))
        if self.after_pose is not None:
            self.after_pose()
        # The hypotheses come before the track, so that its subscribers already have them.
        if not track.ended and has_subscribers(self._outputs['~/hypotheses']):
            self._send('~/hypotheses', schema.hypotheses_dict(track, frame))
        content = schema.track_dict(track, frame)
        self._send('~/tracks', {'header': content['header'], 'tracks': [content]})
        if has_subscribers(self._outputs['~/detections_3d']):
            self._send('~/detections_3d', standard.detections_3d_dict(track, frame))
        if track.ended:
            self._poses_by_track.pop(track.id, None)
            self._send('~/markers', standard.delete_markers(track, frame))
        else:
            self._publish_views(track, frame)
        if track.id > self._latest_id:
            self._latest_id = track.id
            self.get_logger().info(f'track {track.id} begins' + (
                f', arrival {track.arrival}' if track.arrival else ''))
        if track.ended:
            self.get_logger().info(f'track {track.id} has ended')

    def _publish_views(self, track: Track, frame: str) -> None:
        """Publish odometry, transform, path and markers of a running track."""
        child_frame = self._child_frame or f'track_{track.id}'
        self._send('~/odometry', schema.odometry_dict(track, frame, child_frame))
        if self._publishes_tf:
            self._send('/tf', standard.track_transform_dict(track, frame, child_frame))
        path = self._poses_by_track.setdefault(track.id, deque(maxlen=MAX_PATH_POSES))
        if track.topic_uncertainty is not None:
            path.append(to_message(PoseStamped, schema.pose_dict(
                track.stamp_ns, frame, track.position, track.orientation)))
        # The topic carries the path of the oldest running track only.
        if path and track.id == min(self._poses_by_track) \
                and has_subscribers(self._outputs['~/path']):
            self._outputs['~/path'].publish(Path(header=path[-1].header, poses=list(path)))
        if has_subscribers(self._outputs['~/markers']):
            self._send('~/markers', standard.track_markers(track, frame))


def _same_orientations(one: SensorNetwork, other: SensorNetwork) -> bool:
    """Whether two networks have the same orientations and uncertainties, except for rounding."""
    is_same_std = [a is b if a is None or b is None else np.allclose(a, b)
                   for a, b in zip(one.orientation_std, other.orientation_std, strict=True)]
    return all(is_same_std) and bool(np.abs(one.R_ws - other.R_ws).max() < 1e-9)


main = partial(middleware.main, TrackerNode)
