"""tracker_node: frames of the network in, poses and tracks out."""

import sys

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from mag_tracking_msgs.msg import (
    CalibrationState,
    HypothesisArray,
    NetworkFrame,
    SmoothedTrack,
    TrackArray,
)
from nav_msgs.msg import Odometry, Path
from visualization_msgs.msg import MarkerArray

from mag_tracking.errors import RecordingError
from mag_tracking.io.calibration_state import with_orientations
from mag_tracking.io.schema import (
    frame_of,
    header_dict,
    hypotheses_dict,
    odometry_dict,
    pose_dict,
    pose_with_covariance_dict,
    smoothed_pose_dict,
    smoothed_track_dict,
    track_dict,
)
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.markers import delete_markers, track_markers
from mag_tracking.nodes.ros_params import follow_changes
from mag_tracking.nodes.stage_node import LATCHED, RESULTS, STREAM, StageNode
from mag_tracking.records import SmoothedPose
from mag_tracking.stages.track import TrackStage

LONGEST_PATH = 2000
"""Poses kept in `~/path`."""


class TrackerNode(StageNode):
    """The bank of filters behind a topic."""

    def __init__(self, **node_arguments):
        super().__init__('tracker_node', 'track', **node_arguments)
        self._stage = TrackStage(self.network, self.settings.track)
        follow_changes(self, self.settings, lambda s: self._stage.configure(s.track))
        self._pose = self.publisher(PoseWithCovarianceStamped, '~/pose', STREAM)
        self._odometry = self.publisher(Odometry, '~/odometry', RESULTS)
        self._tracks = self.publisher(TrackArray, '~/tracks', STREAM)
        self._hypotheses = self.publisher(HypothesisArray, '~/hypotheses', STREAM)
        self._path_publisher = self.publisher(Path, '~/path', RESULTS)
        self._smoothed_pose = self.publisher(
            PoseWithCovarianceStamped, '~/pose_smoothed', STREAM)
        self._smoothed = self.publisher(SmoothedTrack, '~/smoothed', RESULTS)
        self._smoothed_path = self.publisher(Path, '~/path_smoothed', RESULTS)
        self._markers = self.publisher(MarkerArray, '~/markers', RESULTS)
        self._path = Path()
        self.subscription(NetworkFrame, '/detection_node/frame', self._take, STREAM)
        self.subscription(CalibrationState, '/calibration_node/calibration', self._calibrated,
                          LATCHED)

    def stages(self):
        return {'track': self._stage}

    def _calibrated(self, message):
        """The sensors' orientations, which a survey may have changed."""
        try:
            network = with_orientations(self.network, message)
        except RecordingError as error:
            self._stage.counts['rejected: bad calibration'] += 1
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        if _same_orientations(network, self.network):
            return
        self.network = network
        self._stage.use_network(network)
        self.get_logger().info('the next track is of sensors as they were surveyed')

    def _take(self, message):
        """One frame."""
        try:
            frame = frame_of(message, self.network)
        except RecordingError as error:
            self._stage.counts['rejected: bad frame'] += 1
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        whole = []
        for record in self._stage.feed(frame):
            if not isinstance(record, SmoothedPose):
                self._publish(record)
            elif record.complete:
                whole.append(record)
            else:
                self._smoothed_pose.publish(to_message(
                    PoseWithCovarianceStamped, smoothed_pose_dict(record, self.network.frame)))
        if whole:
            self._smoothed.publish(to_message(
                SmoothedTrack, smoothed_track_dict(whole, self.network.frame)))
            self._smoothed_path.publish(self._path_of(whole))

    def _path_of(self, poses):
        """nav_msgs/Path of `SmoothedPose`s, with the header of the latest."""
        steps = [to_message(PoseStamped, pose_dict(p.stamp_ns, self.network.frame, p.position,
                                                   p.orientation)) for p in poses]
        return Path(header=steps[-1].header, poses=steps)

    def _publish(self, track):
        """Everything about one track at one time."""
        frame = self.network.frame
        content = track_dict(track, frame)
        # Hypotheses first: who waits for the track then has them already.
        if not track.ended:
            self._hypotheses.publish(to_message(HypothesisArray, hypotheses_dict(track, frame)))
        self._tracks.publish(to_message(
            TrackArray, {'header': content['header'], 'tracks': [content]}))
        if track.ended:
            self._path = Path()
            self._markers.publish(to_message(MarkerArray, delete_markers(track, frame)))
            return
        self._pose.publish(to_message(PoseWithCovarianceStamped, {
            'header': header_dict(track.stamp_ns, frame),
            'pose': pose_with_covariance_dict(track)}))
        self._odometry.publish(to_message(
            Odometry, odometry_dict(track, frame, f'track_{track.id}')))
        step = to_message(PoseStamped, pose_dict(track.stamp_ns, frame, track.position,
                                                 track.orientation))
        self._path.header = step.header
        self._path.poses = [*self._path.poses[1 - LONGEST_PATH:], step]
        self._path_publisher.publish(self._path)
        self._markers.publish(to_message(MarkerArray, track_markers(track, frame)))


def _same_orientations(one, other):
    """Whether two networks are turned alike, but for the rounding of quaternions."""
    known = [(a is None) == (b is None) and (a is None or np.allclose(a, b))
             for a, b in zip(one.orientation_std, other.orientation_std, strict=True)]
    return all(known) and bool(np.abs(one.R_ws - other.R_ws).max() < 1e-9)


def main(arguments=None):
    """Run the node."""
    sys.exit(stage_node.main(TrackerNode, arguments))


if __name__ == '__main__':
    main()
