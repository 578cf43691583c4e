"""tracker_node: frames of the network in, poses and tracks out."""

if __name__ == '__main__':
    # Does not return: a signal during the imports below would end in a traceback.
    from mag_tracking.nodes.start import tracker_node

    tracker_node()

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from mag_tracking_msgs.msg import (
    CalibrationState,
    HypothesisArray,
    NetworkFrame,
    SmoothedTrack,
    TrackArray,
)
from mag_tracking_msgs.msg import Disturbance as DisturbanceMessage
from nav_msgs.msg import Odometry, Path
from rclpy.publisher import Publisher
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import MarkerArray

from mag_tracking.calibration.doubtful_times import DoubtfulTimes, merged
from mag_tracking.errors import RecordingError
from mag_tracking.event_records import Disturbance
from mag_tracking.messages.calibration_state import doubtful_times, with_orientations
from mag_tracking.messages.frame import frame_of
from mag_tracking.messages.markers import delete_markers, sensor_markers, track_markers
from mag_tracking.messages.schema import (
    disturbance_dict,
    hypotheses_dict,
    odometry_dict,
    pose_dict,
    pose_message_dict,
    smoothed_pose_dict,
    smoothed_track_dict,
    track_dict,
)
from mag_tracking.messages.shapes import MessageDict
from mag_tracking.messages.standard import detections_3d_dict, track_transform_dict
from mag_tracking.messages.types import CALIBRATION_STATE, NETWORK_FRAME
from mag_tracking.network import SensorNetwork
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.ros_params import fixed_parameter, follow_changes
from mag_tracking.nodes.stage_node import (
    LATCHED,
    RESULTS,
    SENT,
    STREAM,
    TRANSFORMS,
    StageNode,
    has_subscribers,
)
from mag_tracking.nodes.steady_timer import steady_timer
from mag_tracking.nodes.traffic_topics import TrafficTopics
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.stages.stage import Stage
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.stages.track.running_track import TrackRecord
from mag_tracking.stages.track.settings import BEST
from mag_tracking.stages.traffic.stage import TrackedFrame

SLACK_S = 1.0
"""[s] What the way of a frame may take on top of the longest gap."""
MAX_PATH = 2000
"""Poses kept in `~/path`."""


class TrackerNode(StageNode):
    """The bank of filters behind a topic."""

    def __init__(self, is_fed: bool = False, **node_arguments: Any) -> None:
        """`is_fed`: frames come by `take_frame`, in the process of the other nodes."""
        super().__init__('tracker_node', 'track', **node_arguments)
        self._is_fed = is_fed
        self.behind_pose: Callable[[], None] | None = None
        """Called when a pose is out, before all else: a track follows the frame it is of."""
        self._stage = TrackManager(self.network, self.settings.track)
        self._traffic = TrafficTopics(self)
        follow_changes(self, self.settings, lambda s: self._stage.configure(s.track))
        self._child_frame = fixed_parameter(
            self, 'child_frame', '', 'Frame of the target in odometry and transforms, as '
            'robot_localization wants it; left out: track_<id>.')
        self._tf = self.publisher(TFMessage, '/tf', TRANSFORMS) if fixed_parameter(
            self, 'publish_tf', False, 'Publish the transform from the frame of the network to '
            'that of the target.') else None
        self._pose = self.publisher(PoseWithCovarianceStamped, '~/pose', SENT)
        self._odometry = self.publisher(Odometry, '~/odometry', RESULTS)
        self._tracks = self.publisher(TrackArray, '~/tracks', SENT)
        self._hypotheses = self.publisher(HypothesisArray, '~/hypotheses', SENT)
        self._path_publisher = self.publisher(Path, '~/path', RESULTS)
        self._smoothed_pose = self.publisher(
            PoseWithCovarianceStamped, '~/pose_smoothed', SENT)
        self._smoothed = self.publisher(SmoothedTrack, '~/smoothed', RESULTS)
        self._smoothed_path = self.publisher(Path, '~/path_smoothed', RESULTS)
        self._disturbances = self.publisher(DisturbanceMessage, '~/disturbances', SENT)
        self._markers = self.publisher(MarkerArray, '~/markers', RESULTS)
        self._detections_3d = self.publisher(Detection3DArray, '~/detections_3d', RESULTS)
        self._sensor_markers = self.publisher(MarkerArray, '~/sensor_markers', LATCHED)
        self._sensor_markers.publish(to_message(MarkerArray, sensor_markers(self.network)))
        # The poses of each running track.
        self._paths: dict[int, deque[PoseStamped]] = {}
        self._is_silent, self._latest_id = False, -1
        self._doubtful: dict[str, DoubtfulTimes] = {}
        if is_fed:
            self.take_frame = self.direct('detection', [NETWORK_FRAME], self._feed,
                                          lambda frame: frame.stamp_ns)
        else:
            self.subscription(NetworkFrame, NETWORK_FRAME, self._take, STREAM, source='detection')
        steady_timer(self, 0.25, self.end_without_frames)
        self.subscription(CalibrationState, CALIBRATION_STATE, self._calibrated, LATCHED)
        self.report_state()

    def stages(self) -> dict[str, Stage[Any, Any]]:
        """{name: stage} whose counts are published."""
        return {'track': self._stage, 'traffic': self._traffic.stage}

    def end_without_frames(self) -> None:
        """Tell of a track that is lost because no frame comes any more.

        By when they came: a clock may be behind. A recording may be played as slowly as
        one likes, or pause.
        """
        if self._stage.bank is None or self.is_replayed:
            return
        heard = self.flows['detection'].heard
        assert heard is not None, 'a track without a frame'
        silent_s = time.monotonic() - heard
        # Twice in a row: while the node was busy, frames may have come that wait.
        was_silent, self._is_silent = self._is_silent, \
            silent_s > self.settings.track.end_gap_s + SLACK_S
        if was_silent and self._is_silent:
            self._publish_all(self._stage.give_up('no frames came'), None)

    def _calibrated(self, message: CalibrationState) -> None:
        """The sensors' orientations, which a survey may have changed, and doubtful backgrounds."""
        try:
            network = with_orientations(self.network, message)
        except RecordingError as error:
            self._stage.counts['rejected: bad calibration'] += 1
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        if not self._is_fed:
            # The message has the latest stretch of each sensor; frames of others may be on their
            # way.
            self._doubtful = merged(self._doubtful, doubtful_times(message))
            self._stage.doubt(self._doubtful)
        if _same_orientations(network, self.network):
            return
        self.network = network
        self._stage.use_network(network)
        self._sensor_markers.publish(to_message(MarkerArray, sensor_markers(network)))
        self.get_logger().info('the next track is of sensors as they were surveyed')

    def _take(self, message: NetworkFrame) -> None:
        """One frame."""
        try:
            frame = frame_of(message, self.network)
        except RecordingError as error:
            self._stage.counts['rejected: bad frame'] += 1
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        self._feed(frame)
        self._stage.idle()

    def doubt(self, times: Mapping[str, DoubtfulTimes]) -> None:
        """Doubt tracks of frames in which the background of a sensor is doubtful.

        `times` {sensor: ((begin, end) [ns], ...)} of all, as `calibration.doubtful_times` has them.
        """
        self._stage.doubt(times)

    def idle(self) -> None:
        """Do what may wait until the step before has published its results."""
        self._stage.idle()

    def _feed(self, frame: FieldFrame) -> None:
        """What follows from a frame, published."""
        self._publish_all(self._stage.feed(frame), frame)
        if self._stage.clocks_apart:
            self.get_logger().warning(self._stage.clocks_apart, throttle_duration_sec=60.0)

    def _publish_all(self, records: list[TrackRecord], frame: FieldFrame | None) -> None:
        """`Track`s, `SmoothedPose`s and `Disturbance`s of a frame, each where it belongs."""
        whole = []
        for record in records:
            if isinstance(record, Disturbance):
                self._disturbances.publish(to_message(
                    DisturbanceMessage, disturbance_dict(record, self.network.frame)))
            elif not isinstance(record, SmoothedPose):
                self._publish(record)
            elif record.complete:
                whole.append(record)
            # It has no flag, and what else is possible is not smoothed.
            elif not record.ambiguous or self.settings.track.ambiguous_poses == BEST:
                self._smoothed_pose.publish(to_message(
                    PoseWithCovarianceStamped, smoothed_pose_dict(record, self.network.frame)))
        for id in dict.fromkeys(pose.id for pose in whole):
            mine = [pose for pose in whole if pose.id == id]
            self._smoothed.publish(to_message(
                SmoothedTrack, smoothed_track_dict(mine, self.network.frame)))
            self._smoothed_path.publish(self._path_of(mine))
        self._traffic.take(TrackedFrame(frame, records))

    def _path_of(self, poses: list[SmoothedPose]) -> Path:
        """nav_msgs/Path of `SmoothedPose`s, with the header of the latest."""
        steps = [to_message(PoseStamped, pose_dict(p.stamp_ns, self.network.frame, p.position,
                                                   p.orientation)) for p in poses]
        return Path(header=steps[-1].header, poses=steps)

    def _publish(self, track: Track) -> None:
        """Everything about one track at one time."""
        frame = self.network.frame
        if not track.ended:
            # The pose first: it may be steered by.
            publish_if_any(self._pose, PoseWithCovarianceStamped, pose_message_dict(track, frame))
        if self.behind_pose is not None:
            self.behind_pose()
        if not track.ended:
            # Then the hypotheses: a subscriber of the track has them already.
            if has_subscribers(self._hypotheses):
                self._hypotheses.publish(
                    to_message(HypothesisArray, hypotheses_dict(track, frame)))
        content = track_dict(track, frame)
        self._tracks.publish(to_message(
            TrackArray, {'header': content['header'], 'tracks': [content]}))
        if has_subscribers(self._detections_3d):
            self._detections_3d.publish(to_message(
                Detection3DArray, detections_3d_dict(track, frame)))
        if track.ended:
            self._paths.pop(track.id, None)
            self._markers.publish(to_message(MarkerArray, delete_markers(track, frame)))
        else:
            self._publish_views(track, frame)
        self._log_life(track)

    def _log_life(self, track: Track) -> None:
        """Log that a track begins, and that it has ended."""
        if track.id > self._latest_id:
            self._latest_id = track.id
            self.get_logger().info(f'track {track.id} begins' + (
                f', arrival {track.arrival}' if track.arrival else ''))
        if track.ended:
            self.get_logger().info(f'track {track.id} has ended')

    def _publish_views(self, track: Track, frame: str) -> None:
        """Odometry, transform, path and markers of a running track."""
        child_frame = self._child_frame or f'track_{track.id}'
        publish_if_any(self._odometry, Odometry, odometry_dict(track, frame, child_frame))
        if self._tf is not None:
            publish_if_any(self._tf, TFMessage, track_transform_dict(track, frame, child_frame))
        path = self._paths.setdefault(track.id, deque(maxlen=MAX_PATH))
        if track.topic_uncertainty is not None:
            path.append(to_message(PoseStamped, pose_dict(
                track.stamp_ns, frame, track.position, track.orientation)))
        # One path fits the topic: that of the track that began first.
        if path and track.id == min(self._paths) and has_subscribers(self._path_publisher):
            self._path_publisher.publish(Path(header=path[-1].header, poses=list(path)))
        if has_subscribers(self._markers):
            self._markers.publish(to_message(MarkerArray, track_markers(track, frame)))


def publish_if_any(publisher: Publisher, cls: Any, content: MessageDict | None) -> None:
    """Publish a message of class `cls`, unless it is held back."""
    if content is not None:
        publisher.publish(to_message(cls, content))


def _same_orientations(one: SensorNetwork, other: SensorNetwork) -> bool:
    """Whether two networks are turned alike, but for the rounding of quaternions."""
    known = [a is b if a is None or b is None else np.allclose(a, b)
             for a, b in zip(one.orientation_std, other.orientation_std, strict=True)]
    return all(known) and bool(np.abs(one.R_ws - other.R_ws).max() < 1e-9)


def main(arguments: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return stage_node.main(TrackerNode, arguments)
