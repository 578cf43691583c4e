"""Tracks in the formats of other programs: TUM RGB-D (evo), the Rerun viewer and ROS.

The recording `tracks.mcap` contains the messages that the nodes would publish: fields, tracks,
poses, odometry, paths, smoothed tracks, markers, transforms and disturbances.
"""

import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from os import PathLike
from typing import Any

import numpy as np
from scipy.special import chdtri

from mag_tracking.analysis.track_log import SmoothedLog, TrackLog
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import MissingDependencyError, OutputError
from mag_tracking.event_records import Disturbance
from mag_tracking.files import new_binary_file, replace_text
from mag_tracking.messages import schema, standard, types
from mag_tracking.network import SensorNetwork
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import FieldFrame, Readings, SmoothedPose, Track
from mag_tracking.units import NS

RERUN_FILE = 'tracks.rrd'
TIME = 'stamp'
MIN_MOMENT = 1e-12
"""Minimum magnitude by which a moment is divided to obtain its direction [A m²]."""
SCALE_3D = float(np.sqrt(chdtri(3, 0.1)))
"""Radius of a 90 % ellipsoid, in standard deviations."""
LATCHED = ('/tf_static', '/tracker_node/sensor_markers')
"""Latched topics, with one message each."""


def write_tum(path: str | PathLike[str], stamp_ns: Sequence[int], position: Sequence[FloatArray],
              orientation: Sequence[FloatArray]) -> None:
    """Write poses as lines of `time x y z qx qy qz qw`, in s and m; orientations are xyzw."""
    lines = []
    for stamp, p, q in zip(stamp_ns, position, orientation, strict=True):
        # Formatted from integers: a float has a resolution of only 0.2 us for times since 1970.
        seconds = f'{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}'
        lines.append(' '.join([seconds, *(f'{float(v):.9g}' for v in (*p, *q))]))
    replace_text(path, '\n'.join(lines) + '\n')


def check_rerun() -> None:
    """Raise MissingDependencyError if rerun-sdk is not installed."""
    if find_spec('rerun') is None:
        raise MissingDependencyError(
            'Rerun recordings require the package rerun-sdk; install it with: '
            f'{sys.executable} -m pip install rerun-sdk')


def write_rerun(path: str | PathLike[str], network: SensorNetwork, logs: Mapping[int, TrackLog],
                smoothed: Mapping[int, SmoothedLog]) -> None:
    """Write sensors and tracks (poses, 90 % regions, speeds, fields), by track id, to a Rerun
    recording; raises MissingDependencyError without rerun-sdk, and OutputError."""
    check_rerun()
    import rerun

    stream = rerun.RecordingStream('mag_tracking')
    try:
        # Create a new file first, so that a link of this name is not followed.
        new_binary_file(path).close()
        stream.save(path)
    except (OSError, RuntimeError) as error:
        raise OutputError(f'cannot write {path}: {error}') from error
    stream.log(f'{network.frame}/sensors', rerun.Points3D(
        network.positions, labels=list(network.names)), static=True)
    for log in logs.values():
        _write_track(rerun, stream, network, log)
    for track in smoothed.values():
        stream.log(f'{network.frame}/track_{track.id}/smoothed', rerun.LineStrips3D(
            [np.array(track.position)]), static=True)
    stream.flush()
    stream.disconnect()


def _write_track(rerun: Any, stream: Any, network: SensorNetwork, log: TrackLog) -> None:
    """Log the poses of a track, and clear the track one period after its last pose."""
    root = f'{network.frame}/track_{log.id}'
    for k, ns in enumerate(log.stamp_ns):
        stream.set_time(TIME, timestamp=np.datetime64(ns, 'ns'))
        std, orientation = standard.ellipsoid_axes(log.covariance[k][:3, :3])
        stream.log(f'{root}/region', rerun.Ellipsoids3D(
            centers=[log.position[k]], half_sizes=[SCALE_3D * std],
            quaternions=[rerun.Quaternion(xyzw=orientation)]))
        stream.log(f'{root}/pose', rerun.Points3D([log.position[k]], labels=[
            f'{log.id} {log.kind[k]}{"?" if log.ambiguous[k] else ""}']))
        magnitude = max(float(np.linalg.norm(log.moment[k])), MIN_MOMENT)
        stream.log(f'{root}/moment', rerun.Arrows3D(
            origins=[log.position[k]], vectors=[log.moment[k] / magnitude]))
        stream.log(f'speed/track_{log.id}', rerun.Scalars(float(np.hypot(*log.velocity[k][:2]))))
        for j, name in enumerate(network.names):
            for source, fields in (('measured', log.measured[k]), ('predicted', log.predicted[k])):
                stream.log(f'field/{name}/{source}', rerun.Scalars(1e9 * fields[j]))
    # The last pose stays visible for one period.
    period = log.stamp_ns[-1] - log.stamp_ns[-2] if len(log.stamp_ns) > 1 else NS
    stream.set_time(TIME, timestamp=np.datetime64(log.stamp_ns[-1] + period, 'ns'))
    stream.log(root, rerun.Clear(recursive=True))


class TrackRecording:
    """Writer of a recording of tracks, calibrated fields and sensor poses."""

    def __init__(self, path: str | PathLike[str], network: SensorNetwork) -> None:
        self._writer = RecordingWriter(path, LATCHED)
        self._network, self._frame = network, network.frame
        self._topics = {name: f'{topic}_calibrated' for name, topic in zip(
            network.names, network.absolute_topics, strict=True)}
        self._path: list[types.MessageDict] = []
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
        transforms = standard.sensor_transform_dicts(self._network, stamp_ns)
        self._writer.write('/tf_static', types.TRANSFORMS, {'transforms': transforms}, stamp_ns)
        self._writer.write('/tracker_node/sensor_markers', types.MARKERS,
                           standard.sensor_markers(self._network), stamp_ns)

    def add_frame(self, frame: FieldFrame) -> None:
        """Write the calibrated field of each sensor in a frame."""
        self._write_smoothed()
        self._write_sensors(frame.stamp_ns)
        for j, name in enumerate(self._network.names):
            if frame.n_samples[j]:
                stamp_ns = frame.stamp_ns + round(1e9 * frame.time_offset[j])
                readings = Readings.single(name, stamp_ns, frame.field[j], frame.covariance[j])
                ((_, content),) = schema.magnetic_field_dicts(readings)
                self._writer.write(self._topics[name], types.MAGNETIC_FIELD, content,
                                   frame.stamp_ns)

    def add_track(self, track: Track) -> None:
        """Write a record of a track to its topics; at the end of the track, write its path."""
        self._write_smoothed()
        self._write_sensors(track.stamp_ns)
        stamp_ns, frame = track.stamp_ns, self._frame
        content = schema.track_dict(track, frame)
        self._write('tracks', types.TRACK_ARRAY, {'header': content['header'], 'tracks': [content]},
                    stamp_ns)
        if track.ended:
            self._write('markers', types.MARKERS, standard.delete_markers(track, frame), stamp_ns)
            if self._path:
                self._write('path', types.PATH, {'header': schema.header_dict(stamp_ns, frame),
                                                 'poses': self._path}, stamp_ns)
            self._path = []
            return
        child_frame = f'track_{track.id}'
        pose = schema.pose_message_dict(track, frame)
        odometry = schema.odometry_dict(track, frame, child_frame)
        transform = standard.track_transform_dict(track, frame, child_frame)
        for topic, kind, message in (
                ('/tracker_node/pose', types.POSE_WITH_COVARIANCE, pose),
                ('/tracker_node/odometry', types.ODOMETRY, odometry),
                ('/tf', types.TRANSFORMS, transform)):
            if message is not None:
                self._writer.write(topic, kind, message, stamp_ns)
        self._write('markers', types.MARKERS, standard.track_markers(track, frame), stamp_ns)
        if track.topic_uncertainty is not None:
            self._path.append(schema.pose_dict(stamp_ns, frame, track.position, track.orientation))

    def add_smoothed(self, pose: SmoothedPose) -> None:
        """Buffer a smoothed pose; all smoothed poses of a track are written as a single message."""
        if self._smoothed and pose.id != self._smoothed[0].id:
            self._write_smoothed()
        self._smoothed.append(pose)

    def _write_smoothed(self) -> None:
        poses = self._smoothed
        if not poses:
            return
        self._smoothed, last_ns = [], poses[-1].stamp_ns
        content = schema.smoothed_track_dict(poses, self._frame)
        self._write('smoothed', types.SMOOTHED_TRACK, content, last_ns)
        self._write('path_smoothed', types.PATH, {
            'header': schema.header_dict(last_ns, self._frame),
            'poses': [schema.pose_dict(p.stamp_ns, self._frame, p.position, p.orientation)
                      for p in poses]}, last_ns)

    def add_disturbance(self, disturbance: Disturbance) -> None:
        """Write a record of a disturbance: its detection or its end."""
        content = schema.disturbance_dict(disturbance, self._frame)
        self._write('disturbances', types.DISTURBANCE, content, disturbance.stamp_ns)

    def _write(self, name: str, kind: str, content: types.MessageDict, stamp_ns: int) -> None:
        self._writer.write(f'/tracker_node/{name}', kind, content, stamp_ns)
