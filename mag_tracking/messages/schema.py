"""Records to and from messages, as nested dicts, without ROS."""

from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.event_records import (
    Disturbance,
    PassEvent,
    TrafficSummary,
    VehiclePassage,
)
from mag_tracking.geometry import rotation_from_quaternion
from mag_tracking.messages.shapes import FieldReadings, Imu, MagneticField, MessageDict, Time
from mag_tracking.records import (
    AccelerationSample,
    Detection,
    Hypothesis,
    PoseUncertainty,
    Readings,
    SmoothedPose,
    Track,
    best_of_arrivals,
)
from mag_tracking.units import LATEST_NS


def stamp_ns(stamp: Time) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def stamp_dict(ns: int) -> MessageDict:
    """A builtin_interfaces/Time of nanoseconds."""
    return {'sec': ns // 1_000_000_000, 'nanosec': ns % 1_000_000_000}


def reading_of(message: MagneticField, sensor: str) -> Readings:
    """`Readings` of a message-shaped sensor_msgs/MagneticField of `sensor`: a batch of one.

    A covariance that is all zero, or begins with -1, is unknown.
    """
    f = message.magnetic_field
    C = known_covariances(np.array(message.magnetic_field_covariance, dtype=float).reshape(1, 3, 3))
    return Readings.single(sensor, stamp_ns(message.header.stamp), np.array([f.x, f.y, f.z]),
                           None if C is None else C[0])


def known_covariances(C: FloatArray) -> FloatArray | None:
    """(n, 3, 3) covariances of `Readings` from those of messages; None: all are unknown.

    NaN says "unknown" in `Readings` only. In a message it is a fault, and becomes a zero that the
    calibration rejects.
    """
    known = (C[:, 0, 0] != -1.0) & C.any(axis=(1, 2))
    if not known.any():
        return None
    C = np.where(np.isnan(C).all(axis=(1, 2), keepdims=True), 0.0, C)
    return np.where(known[:, None, None], C, np.nan)


def acceleration_of(message: Imu, sensor: str) -> AccelerationSample:
    """`AccelerationSample` of a message-shaped sensor_msgs/Imu of `sensor`.

    NaN where the message says that it has none (its covariance begins with -1).
    """
    a = message.linear_acceleration
    there = message.linear_acceleration_covariance[0] != -1.0
    return AccelerationSample(stamp_ns(message.header.stamp), sensor,
                              np.array([a.x, a.y, a.z]) if there else np.full(3, np.nan))


def doubles(values: ArrayLike) -> 'array[float]':
    """Numbers for a float64[] of a message, which takes an array.array as it is.

    A list it would look at number by number.
    """
    return array('d', np.ascontiguousarray(values, dtype=float).tobytes())


def xyz(v: Sequence[float] | FloatArray) -> dict[str, float]:
    """Vector as a dict."""
    return {'x': float(v[0]), 'y': float(v[1]), 'z': float(v[2])}


def header_dict(ns: int, frame: str) -> MessageDict:
    """A std_msgs/Header."""
    return {'stamp': stamp_dict(ns), 'frame_id': frame}


def magnetic_field_dicts(readings: Readings, frame: str = '') -> list[tuple[str, MessageDict]]:
    """[(sensor, sensor_msgs/MagneticField)] of `Readings`, in `frame`, or the sensor's name.

    An unknown covariance is all zero.
    """
    C: FloatArray = np.zeros((len(readings), 9))
    if readings.covariance is not None:
        C = readings.covariance.reshape(-1, 9).copy()
        C[np.all(np.isnan(C), axis=1)] = 0.0
    return [(name, {'header': header_dict(stamp, frame or name), 'magnetic_field': xyz(field),
                    'magnetic_field_covariance': covariance})
            for name, stamp, field, covariance in zip(
                readings.sensor_names(), readings.stamp_ns.tolist(), readings.field, C.tolist(),
                strict=True)]


def readings_dict(readings: Readings) -> MessageDict:
    """mag_tracking_msgs/FieldReadings of `Readings`, whose covariances are all known or none.

    Raises RecordingError where some are known, or there is no reading at all.
    """
    C = readings.covariance
    if not len(readings) or C is not None and np.isnan(C).all(axis=(1, 2)).any():
        raise RecordingError('readings in one message: expected some, and the covariance of all '
                             'or of none')
    return {'header': header_dict(int(readings.stamp_ns.max()), ''),
            'sensors': list(readings.names),
            'sensor': array('H', readings.sensor.astype(np.uint16).tobytes()),
            'stamp': array('q', np.ascontiguousarray(readings.stamp_ns).tobytes()),
            'field': doubles(readings.field),
            'covariance': doubles(np.zeros(0) if C is None else C)}


def readings_of(message: FieldReadings) -> Readings:
    """`Readings` of a message-shaped FieldReadings; raises RecordingError where it is none."""
    n, names = len(message.sensor), tuple(message.sensors)
    sizes = len(message.stamp), len(message.field), len(message.covariance)
    if sizes not in ((n, 3 * n, 0), (n, 3 * n, 9 * n)):
        raise RecordingError(f'{n} readings with {sizes[0]} stamps, {sizes[1]} numbers of their '
                             f'fields and {sizes[2]} of their covariances')
    if len(set(names)) < len(names):
        raise RecordingError(f'readings of sensors of which one is there twice: {", ".join(names)}')
    sensor = np.array(message.sensor, dtype=np.int64)
    if n and not 0 <= sensor.min() <= sensor.max() < len(names):
        raise RecordingError(f'a reading of sensor {sensor.max()} of {len(names)}')
    stamps = np.array(message.stamp, dtype=np.int64)
    if n and not -LATEST_NS <= stamps.min() <= stamps.max() <= LATEST_NS:
        raise RecordingError(f'readings of {stamps.min()} to {stamps.max()} ns')
    C: FloatArray | None = None
    if len(message.covariance):
        C = known_covariances(np.array(message.covariance, dtype=float).reshape(n, 3, 3))
    return Readings(names, sensor, stamps, np.array(message.field, dtype=float).reshape(n, 3), C)


def acceleration_dict(sample: AccelerationSample, frame: str) -> MessageDict:
    """sensor_msgs/Imu of an `AccelerationSample`; `frame` is the sensor's.

    Its deviations are unknown, and of orientation and angular velocity there is nothing.
    """
    nothing = [-1.0] + 8 * [0.0]
    return {'header': header_dict(sample.stamp_ns, frame),
            'orientation_covariance': nothing, 'angular_velocity_covariance': nothing,
            'linear_acceleration': xyz(sample.acceleration)}


def pose_dict(ns: int, frame: str, position: FloatArray, quaternion: FloatArray) -> MessageDict:
    """geometry_msgs/PoseStamped."""
    return {'header': header_dict(ns, frame), 'pose': _pose(position, quaternion)}


def _pose(position: FloatArray, quaternion: FloatArray) -> MessageDict:
    """geometry_msgs/Pose."""
    return {'position': xyz(position),
            'orientation': {**xyz(quaternion), 'w': float(quaternion[3])}}


def pose_covariance(about: Track | SmoothedPose | PoseUncertainty) -> FloatArray:
    """(6, 6) of position and small rotations about fixed axes, as ROS orders them."""
    C = np.empty((6, 6))
    C[:3, :3] = about.covariance[:3, :3]
    C[:3, 3:] = about.position_orientation_covariance
    C[3:, :3] = about.position_orientation_covariance.T
    C[3:, 3:] = about.orientation_covariance
    return C


def pose_with_covariance_dict(track: Track | SmoothedPose,
                              uncertainty: PoseUncertainty | None = None) -> MessageDict:
    """geometry_msgs/PoseWithCovariance of a `Track` or `SmoothedPose`, with its own or another
    uncertainty."""
    return {'pose': _pose(track.position, track.orientation),
            'covariance': pose_covariance(uncertainty or track).ravel().tolist()}


def pose_message_dict(track: Track, frame: str) -> MessageDict | None:
    """geometry_msgs/PoseWithCovarianceStamped of a `Track`; None where it is held back."""
    if track.topic_uncertainty is None:
        return None
    return {'header': header_dict(track.stamp_ns, frame),
            'pose': pose_with_covariance_dict(track, track.topic_uncertainty)}


def track_dict(track: Track, frame: str) -> MessageDict:
    """mag_tracking_msgs/Track of a `Track`."""
    return {'header': header_dict(track.stamp_ns, frame), 'id': track.id,
            'status': int(track.ended), 'pose': pose_with_covariance_dict(track),
            'velocity': xyz(track.velocity), 'covariance': track.covariance.ravel().tolist(),
            'moment': xyz(track.moment),
            'moment_covariance': track.moment_covariance.ravel().tolist(),
            'existence': track.existence, 'weight': track.weight,
            'normalised_innovation': track.nis, 'degrees_of_freedom': track.degrees_of_freedom,
            'innovation_by_sensor': doubles(track.nis_by_sensor),
            'arrival': track.arrival, 'kind': track.kind, 'kind_weight': track.kind_weight,
            'length': track.length, 'length_std': track.length_std, 'ambiguous': track.ambiguous,
            'unobservable': list(track.unobservable),
            'predicted_field': doubles(track.predicted),
            'mounting': doubles(track.mounting),
            'mounting_covariance': doubles(track.mounting_covariance),
            'doubts': list(track.doubts),
            'arrivals': [_hypothesis_dict(h) for h in best_of_arrivals(track.hypotheses)]}


def hypotheses_dict(track: Track, frame: str) -> MessageDict:
    """mag_tracking_msgs/HypothesisArray of a `Track`."""
    return {'header': header_dict(track.stamp_ns, frame), 'track_id': track.id,
            'hypotheses': [_hypothesis_dict(h) for h in track.hypotheses]}


def _hypothesis_dict(h: Hypothesis) -> MessageDict:
    """mag_tracking_msgs/Hypothesis of a `Hypothesis`."""
    return {'arrival': h.arrival, 'kind': h.kind, 'weight': h.weight,
            'position': xyz(h.position), 'velocity': xyz(h.velocity),
            'covariance': h.covariance.ravel().tolist(), 'moment': xyz(h.moment)}


def smoothed_pose_dict(pose: SmoothedPose, frame: str) -> MessageDict:
    """geometry_msgs/PoseWithCovarianceStamped of a `SmoothedPose`."""
    return {'header': header_dict(pose.stamp_ns, frame), 'pose': pose_with_covariance_dict(pose)}


def smoothed_track_dict(poses: Sequence[SmoothedPose], frame: str) -> MessageDict:
    """mag_tracking_msgs/SmoothedTrack of the `SmoothedPose`s of one track."""
    last = poses[-1]
    return {'header': header_dict(last.stamp_ns, frame), 'track_id': last.id, 'kind': last.kind,
            'length': last.length, 'length_std': last.length_std,
            'ambiguous': any(p.ambiguous for p in poses),
            'pose_ambiguous': [p.ambiguous for p in poses],
            'poses': [smoothed_pose_dict(p, frame) for p in poses],
            'velocities': [xyz(p.velocity) for p in poses]}


def detection_dict(d: Detection, frame: str) -> MessageDict:
    """mag_tracking_msgs/Detection of a `Detection`."""
    return {'header': header_dict(d.stamp_ns, frame), 'id': d.id, 'kind': int(not d.onset),
            'statistic': d.statistic, 'degrees_of_freedom': d.degrees_of_freedom,
            'threshold': d.threshold, 'false_alarm_probability': d.false_alarm_probability,
            'strongest_sensor': d.strongest_sensor}


def disturbance_dict(d: Disturbance, frame: str) -> MessageDict:
    """mag_tracking_msgs/Disturbance of a `Disturbance`."""
    return {'header': header_dict(d.stamp_ns, frame), 'id': d.id, 'ended': d.ended,
            'begin': stamp_dict(d.begin_ns), 'largest': d.largest, 'sensors': list(d.sensors),
            'uniform': d.uniform, 'track_id': d.track_id}


def pass_event_dict(e: PassEvent) -> MessageDict:
    """mag_tracking_msgs/PassEvent of a `PassEvent`."""
    return {'header': header_dict(e.release_ns, e.sensor), 'sensor': e.sensor, 'number': e.number,
            'ended': e.ended, 'onset': stamp_dict(e.onset_ns),
            'release': stamp_dict(e.release_ns), 'peak_time': stamp_dict(e.peak_ns),
            'peak': xyz(e.peak), 'energy': e.energy, 'axes': e.axes,
            'closest_time': stamp_dict(e.closest_ns), 'closest_std': e.closest_std,
            'time_scale': e.time_scale, 'left_to_right': e.left_to_right,
            'signature': doubles(e.signature.ravel())}


def vehicle_passage_dict(p: VehiclePassage, class_names: Sequence[str],
                         frame: str) -> MessageDict:
    """mag_tracking_msgs/VehiclePassage of a `VehiclePassage`."""
    return {'header': header_dict(p.stamp_ns, frame), 'number': p.number, 'line': p.line,
            'track_id': p.track_id, 'forward': p.forward, 'direction_error': p.direction_error,
            'position': xyz(p.position), 'lateral': p.lateral, 'velocity': xyz(p.velocity),
            'speed': p.speed, 'speed_std': p.speed_std, 'heading_std': p.heading_std,
            'length': p.length, 'length_std': p.length_std, 'moment': xyz(p.moment),
            'moment_covariance': p.moment_covariance.ravel().tolist(),
            'vehicle_class': p.vehicle_class, 'class_names': list(class_names),
            'class_probabilities': doubles(p.class_probabilities), 'headway': p.headway,
            'ambiguous': p.ambiguous, 'doubts': list(p.doubts)}


def traffic_summary_dict(s: TrafficSummary, frame: str) -> MessageDict:
    """mag_tracking_msgs/TrafficSummary of a `TrafficSummary`."""
    return {'header': header_dict(s.end_ns, frame), 'begin': stamp_dict(s.begin_ns),
            'line': s.line, 'observed_s': s.observed_s, 'counts': [
                {'forward': c.forward, 'vehicle_class': c.vehicle_class, 'count': c.count,
                 'ambiguous': c.ambiguous, 'mean_speed': c.mean_speed,
                 'mean_headway': c.mean_headway} for c in s.counts]}


def odometry_dict(track: Track, frame: str, child_frame: str) -> MessageDict | None:
    """nav_msgs/Odometry: the twist is in the child frame, as REP-105 has it.

    The angular velocity is not estimated here: zero, with variance pi^2. None where the pose is
    held back.
    """
    uncertainty = track.topic_uncertainty
    if uncertainty is None:
        return None
    R = rotation_from_quaternion(track.orientation)
    twist = np.zeros((6, 6))
    twist[:3, :3] = R.T @ uncertainty.covariance[3:, 3:] @ R
    twist[3:, 3:] = np.pi**2 * np.eye(3)
    return {'header': header_dict(track.stamp_ns, frame), 'child_frame_id': child_frame,
            'pose': pose_with_covariance_dict(track, uncertainty),
            'twist': {'twist': {'linear': xyz(R.T @ track.velocity), 'angular': xyz(np.zeros(3))},
                      'covariance': twist.ravel().tolist()}}
