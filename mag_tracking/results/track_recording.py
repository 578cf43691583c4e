"""Recording `tracks.mcap` of the messages that the nodes would publish, for ROS viewers.

It contains fields, tracks, poses, odometry, paths, smoothed tracks, markers, transforms and
disturbances.
"""

from os import PathLike

from mag_tracking.event_records import Disturbance
from mag_tracking.messages.markers import delete_markers, sensor_markers, track_markers
from mag_tracking.messages.schema import (
    disturbance_dict,
    header_dict,
    magnetic_field_dicts,
    odometry_dict,
    pose_dict,
    pose_message_dict,
    smoothed_track_dict,
    track_dict,
)
from mag_tracking.messages.shapes import MessageDict
from mag_tracking.messages.standard import sensor_transform_dicts, track_transform_dict
from mag_tracking.messages.types import (
    DISTURBANCE,
    MAGNETIC_FIELD,
    MARKERS,
    ODOMETRY,
    PATH,
    POSE_WITH_COVARIANCE,
    SMOOTHED_TRACK,
    TRACK_ARRAY,
    TRANSFORMS,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import FieldFrame, Readings, SmoothedPose, Track

LATCHED = ('/tf_static', '/tracker_node/sensor_markers')
"""Latched topics, with one message each."""


class TrackRecording:
    """Writer of a recording of tracks, calibrated fields and sensor poses."""

    def __init__(self, path: str | PathLike[str], network: SensorNetwork) -> None:
        self._writer = RecordingWriter(path, LATCHED)
        self._network, self._frame = network, network.frame
        self._topics = {name: f'{topic}_calibrated' for name, topic in zip(
            network.names, network.absolute_topics, strict=True)}
        self._path: list[MessageDict] = []
        self._smoothed: list[SmoothedPose] = []
        self._has_sensors = False

    def close(self) -> None:
        """Write the buffered poses of a smoothed track, and complete the file."""
        self._write_smoothed()
        self._writer.close()

    def _write_sensors(self, stamp_ns: int) -> None:
        """Write the poses and markers of the sensors once, before the first message."""
        if self._has_sensors:
            return
        self._has_sensors = True
        self._writer.write('/tf_static', TRANSFORMS, {'transforms': sensor_transform_dicts(
            self._network, stamp_ns)}, stamp_ns)
        self._writer.write('/tracker_node/sensor_markers', MARKERS,
                           sensor_markers(self._network), stamp_ns)

    def add_frame(self, frame: FieldFrame) -> None:
        """Write the calibrated field of each sensor in a frame."""
        self._write_smoothed()
        self._write_sensors(frame.stamp_ns)
        for j, name in enumerate(self._network.names):
            if frame.n_samples[j]:
                stamp_ns = frame.stamp_ns + round(1e9 * frame.time_offset[j])
                readings = Readings.single(name, stamp_ns, frame.field[j], frame.covariance[j])
                ((_, content),) = magnetic_field_dicts(readings)
                self._writer.write(self._topics[name], MAGNETIC_FIELD, content, frame.stamp_ns)

    def add_track(self, track: Track) -> None:
        """Write a record of a track to its topics; at the end of the track, write its path."""
        self._write_smoothed()
        self._write_sensors(track.stamp_ns)
        stamp_ns, frame = track.stamp_ns, self._frame
        content = track_dict(track, frame)
        self._write('tracks', TRACK_ARRAY, {'header': content['header'], 'tracks': [content]},
                    stamp_ns)
        if track.ended:
            self._write('markers', MARKERS, delete_markers(track, frame), stamp_ns)
            if self._path:
                self._write('path', PATH, {'header': header_dict(stamp_ns, frame),
                                           'poses': self._path}, stamp_ns)
            self._path = []
            return
        child_frame = f'track_{track.id}'
        for topic, kind, message in (
                ('/tracker_node/pose', POSE_WITH_COVARIANCE, pose_message_dict(track, frame)),
                ('/tracker_node/odometry', ODOMETRY, odometry_dict(track, frame, child_frame)),
                ('/tf', TRANSFORMS, track_transform_dict(track, frame, child_frame))):
            if message is not None:
                self._writer.write(topic, kind, message, stamp_ns)
        self._write('markers', MARKERS, track_markers(track, frame), stamp_ns)
        if track.topic_uncertainty is not None:
            self._path.append(pose_dict(stamp_ns, frame, track.position, track.orientation))

    def add_smoothed(self, pose: SmoothedPose) -> None:
        """Buffer a smoothed pose; all smoothed poses of a track are written as a single message."""
        if self._smoothed and pose.id != self._smoothed[0].id:
            self._write_smoothed()
        self._smoothed.append(pose)

    def _write_smoothed(self) -> None:
        """Write the buffered poses of a smoothed track."""
        poses = self._smoothed
        if not poses:
            return
        self._smoothed, last_ns = [], poses[-1].stamp_ns
        self._write('smoothed', SMOOTHED_TRACK, smoothed_track_dict(poses, self._frame), last_ns)
        self._write('path_smoothed', PATH, {
            'header': header_dict(last_ns, self._frame),
            'poses': [pose_dict(p.stamp_ns, self._frame, p.position, p.orientation)
                      for p in poses]}, last_ns)

    def add_disturbance(self, disturbance: Disturbance) -> None:
        """Write a record of a disturbance: its detection or its end."""
        self._write('disturbances', DISTURBANCE, disturbance_dict(disturbance, self._frame),
                    disturbance.stamp_ns)

    def _write(self, name: str, kind: str, content: MessageDict, stamp_ns: int) -> None:
        """Write a message on the topic `/tracker_node/<name>`."""
        self._writer.write(f'/tracker_node/{name}', kind, content, stamp_ns)
