"""Conversion of records to messages as nested dicts, and from messages, without ROS."""

from array import array
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking import records
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.event_records import Disturbance, PassEvent, TrafficSummary, VehiclePassage
from mag_tracking.geometry import rotation_from_quaternion
from mag_tracking.messages.types import MessageDict
from mag_tracking.units import LATEST_NS


class Time(Protocol):
    """Interface of builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(Protocol):
    """Interface of std_msgs/Header."""

    stamp: Time
    frame_id: str


class Vector3(Protocol):
    """Interface of geometry_msgs/Vector3 and Point."""

    x: float
    y: float
    z: float


class Quaternion(Vector3, Protocol):
    """Interface of geometry_msgs/Quaternion."""

    w: float


class MagneticField(Protocol):
    """Interface of sensor_msgs/MagneticField."""

    header: Header
    magnetic_field: Vector3
    magnetic_field_covariance: Sequence[float]


class Imu(Protocol):
    """Interface of sensor_msgs/Imu; only the acceleration is read."""

    header: Header
    linear_acceleration: Vector3
    linear_acceleration_covariance: Sequence[float]


class FieldReadings(Protocol):
    """Interface of mag_tracking_msgs/FieldReadings."""

    header: Header
    sensors: Sequence[str]
    sensor: Sequence[int]
    stamp: Sequence[int]
    field: Sequence[float]
    covariance: Sequence[float]


class NetworkFrame(Protocol):
    """Interface of mag_tracking_msgs/NetworkFrame."""

    header: Header
    sensors: Sequence[str]
    field: Sequence[float]
    covariance: Sequence[float]
    n_samples: Sequence[int]
    time_offset: Sequence[float]
    target_present: bool
    statistic: float
    degrees_of_freedom: int


class SensorCalibration(Protocol):
    """Interface of mag_tracking_msgs/SensorCalibration, limited to the fields that are read."""

    sensor: str
    doubtful: bool
    doubtful_since: Time
    doubtful_until: Time
    orientation: Quaternion
    orientation_std: Sequence[float]


class CalibrationState(Protocol):
    """Interface of mag_tracking_msgs/CalibrationState."""

    header: Header
    sensors: Sequence[SensorCalibration]


def stamp_ns(stamp: Time) -> int:
    """Convert builtin_interfaces/Time to nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def stamp_dict(ns: int) -> MessageDict:
    """Convert nanoseconds to builtin_interfaces/Time."""
    return {'sec': ns // 1_000_000_000, 'nanosec': ns % 1_000_000_000}


def reading_of(message: MagneticField, sensor: str) -> records.Readings:
    """Convert a MagneticField message to `Readings` with a single reading."""
    f = message.magnetic_field
    C = known_covariances(np.array(message.magnetic_field_covariance, dtype=float).reshape(1, 3, 3))
    return records.Readings.single(sensor, stamp_ns(message.header.stamp),
                                   np.array([f.x, f.y, f.z]), None if C is None else C[0])


def known_covariances(C: FloatArray) -> FloatArray | None:
    """Covariances (n, 3, 3) T² as in `Readings`: NaN where unknown, None if all are unknown.

    In messages, a covariance is unknown if it is all zero or its first element is -1. A NaN
    covariance of a message is invalid: it is replaced by zero, which the calibration stage rejects.
    """
    is_known = (C[:, 0, 0] != -1.0) & C.any(axis=(1, 2))
    if not is_known.any():
        return None
    C = np.where(np.isnan(C).all(axis=(1, 2), keepdims=True), 0.0, C)
    return np.where(is_known[:, None, None], C, np.nan)


def acceleration_of(message: Imu, sensor: str) -> records.AccelerationSample:
    """Convert an Imu message to an `AccelerationSample`; NaN if the first element of the
    covariance, -1, marks that it contains no acceleration."""
    a = message.linear_acceleration
    is_present = message.linear_acceleration_covariance[0] != -1.0
    acceleration = np.array([a.x, a.y, a.z]) if is_present else np.full(3, np.nan)
    return records.AccelerationSample(stamp_ns(message.header.stamp), sensor, acceleration)


def float64_array(values: ArrayLike) -> 'array[float]':
    """Convert numbers of any shape to the array type of a float64[] field, in row-major order,
    whose elements ROS does not check individually."""
    return array('d', np.ascontiguousarray(values, dtype=float).tobytes())


def xyz(v: Sequence[float] | FloatArray) -> dict[str, float]:
    """Convert the first three elements of a vector to a geometry_msgs/Vector3 or Point."""
    return {'x': float(v[0]), 'y': float(v[1]), 'z': float(v[2])}


def quaternion_dict(q: FloatArray) -> dict[str, float]:
    """Convert a quaternion xyzw to a geometry_msgs/Quaternion."""
    return dict(zip('xyzw', map(float, q), strict=True))


def header_dict(ns: int, frame: str) -> MessageDict:
    """Build a std_msgs/Header."""
    return {'stamp': stamp_dict(ns), 'frame_id': frame}


def magnetic_field_dicts(readings: records.Readings, frame: str = ''
                         ) -> list[tuple[str, MessageDict]]:
    """Convert `Readings` to one sensor_msgs/MagneticField per reading, with the name of its sensor,
    also the default frame; an unknown covariance is all zero."""
    C: FloatArray = np.zeros((len(readings), 9))
    if readings.covariance is not None:
        C = readings.covariance.reshape(-1, 9).copy()
        C[np.all(np.isnan(C), axis=1)] = 0.0
    return [(name, {'header': header_dict(stamp, frame or name), 'magnetic_field': xyz(field),
                    'magnetic_field_covariance': covariance})
            for name, stamp, field, covariance in zip(
                readings.sensor_names(), readings.stamp_ns.tolist(), readings.field, C.tolist(),
                strict=True)]


def readings_dict(readings: records.Readings) -> MessageDict:
    """Convert `Readings` to mag_tracking_msgs/FieldReadings; raises RecordingError if only some
    covariances are known, or `readings` is empty."""
    C = readings.covariance
    if not len(readings) or C is not None and np.isnan(C).all(axis=(1, 2)).any():
        raise RecordingError('FieldReadings requires at least one reading, and covariances for '
                             'all readings or for none')
    return {'header': header_dict(int(readings.stamp_ns.max()), ''),
            'sensors': list(readings.names),
            'sensor': array('H', readings.sensor.astype(np.uint16).tobytes()),
            'stamp': array('q', np.ascontiguousarray(readings.stamp_ns).tobytes()),
            'field': float64_array(readings.field),
            'covariance': float64_array(np.zeros(0) if C is None else C)}


def readings_of(message: FieldReadings) -> records.Readings:
    """Convert a FieldReadings message to `Readings`; raises RecordingError if array lengths, sensor
    names, indices or timestamps are invalid."""
    n, names = len(message.sensor), tuple(message.sensors)
    lengths = len(message.stamp), len(message.field), len(message.covariance)
    if lengths not in ((n, 3 * n, 0), (n, 3 * n, 9 * n)):
        raise RecordingError(f'FieldReadings of {n} readings: got {lengths[0]} timestamps, '
                             f'{lengths[1]} field values and {lengths[2]} covariance values; '
                             'expected one, 3 and 9 (or no covariances) per reading')
    if len(set(names)) < len(names):
        raise RecordingError(f'FieldReadings lists a sensor twice: {", ".join(names)}')
    sensor = np.array(message.sensor, dtype=np.int64)
    if n and not 0 <= sensor.min() <= sensor.max() < len(names):
        raise RecordingError(f'FieldReadings: sensor index {sensor.max()} is out of range; there '
                             f'are {len(names)} sensor names')
    stamps = np.array(message.stamp, dtype=np.int64)
    if n and not -LATEST_NS <= stamps.min() <= stamps.max() <= LATEST_NS:
        raise RecordingError(f'FieldReadings: timestamps {stamps.min()} to {stamps.max()} ns are '
                             'out of range')
    C: FloatArray | None = None
    if len(message.covariance):
        C = known_covariances(np.array(message.covariance, dtype=float).reshape(n, 3, 3))
    field = np.array(message.field, dtype=float).reshape(n, 3)
    return records.Readings(names, sensor, stamps, field, C)


def acceleration_dict(sample: records.AccelerationSample, frame: str) -> MessageDict:
    """Convert an `AccelerationSample` to sensor_msgs/Imu.

    Orientation and angular velocity are not provided; a zero covariance means unknown.
    """
    not_provided = [-1.0] + 8 * [0.0]
    return {'header': header_dict(sample.stamp_ns, frame),
            'orientation_covariance': not_provided, 'angular_velocity_covariance': not_provided,
            'linear_acceleration': xyz(sample.acceleration)}


def pose_dict(ns: int, frame: str, position: FloatArray, quaternion: FloatArray) -> MessageDict:
    """Build a geometry_msgs/PoseStamped; `quaternion` xyzw rotates from the body to `frame`."""
    return {'header': header_dict(ns, frame), 'pose': _pose(position, quaternion)}


def _pose(position: FloatArray, quaternion: FloatArray) -> MessageDict:
    return {'position': xyz(position), 'orientation': quaternion_dict(quaternion)}


def pose_covariance(uncertainty: records.Pose | records.PoseUncertainty) -> FloatArray:
    """Covariance (6, 6) of a pose as in ROS: position [m²], small rotations [rad²], world frame."""
    C = np.empty((6, 6))
    C[:3, :3] = uncertainty.covariance[:3, :3]
    C[:3, 3:] = uncertainty.position_orientation_covariance
    C[3:, :3] = uncertainty.position_orientation_covariance.T
    C[3:, 3:] = uncertainty.orientation_covariance
    return C


def pose_with_covariance_dict(track: records.Pose,
                              uncertainty: records.PoseUncertainty | None = None) -> MessageDict:
    """Convert a pose to geometry_msgs/PoseWithCovariance; `uncertainty` replaces its covariance."""
    return {'pose': _pose(track.position, track.orientation),
            'covariance': pose_covariance(uncertainty or track).ravel().tolist()}


def pose_message_dict(track: records.Track, frame: str) -> MessageDict | None:
    """Convert a `Track` to PoseWithCovarianceStamped; None if the pose is withheld as ambiguous."""
    if track.topic_uncertainty is None:
        return None
    return {'header': header_dict(track.stamp_ns, frame),
            'pose': pose_with_covariance_dict(track, track.topic_uncertainty)}


def track_dict(track: records.Track, frame: str) -> MessageDict:
    """Convert a `Track` to mag_tracking_msgs/Track."""
    return {'header': header_dict(track.stamp_ns, frame), 'id': track.id,
            'status': int(track.ended), 'pose': pose_with_covariance_dict(track),
            'velocity': xyz(track.velocity), 'covariance': track.covariance.ravel().tolist(),
            'moment': xyz(track.moment),
            'moment_covariance': track.moment_covariance.ravel().tolist(),
            'existence': track.existence, 'weight': track.weight,
            'normalised_innovation': track.nis, 'degrees_of_freedom': track.degrees_of_freedom,
            'innovation_by_sensor': float64_array(track.nis_by_sensor),
            'arrival': track.arrival, 'kind': track.kind, 'kind_weight': track.kind_weight,
            'length': track.length, 'length_std': track.length_std, 'ambiguous': track.ambiguous,
            'unobservable': list(track.unobservable),
            'predicted_field': float64_array(track.predicted),
            'mounting': float64_array(track.mounting),
            'mounting_covariance': float64_array(track.mounting_covariance),
            'doubts': list(track.doubts),
            'arrivals': [_hypothesis_dict(h) for h in records.best_of_arrivals(track.hypotheses)]}


def hypotheses_dict(track: records.Track, frame: str) -> MessageDict:
    """Convert the hypotheses of a `Track` to mag_tracking_msgs/HypothesisArray."""
    return {'header': header_dict(track.stamp_ns, frame), 'track_id': track.id,
            'hypotheses': [_hypothesis_dict(h) for h in track.hypotheses]}


def _hypothesis_dict(h: records.Hypothesis) -> MessageDict:
    return {'arrival': h.arrival, 'kind': h.kind, 'weight': h.weight,
            'position': xyz(h.position), 'velocity': xyz(h.velocity),
            'covariance': h.covariance.ravel().tolist(), 'moment': xyz(h.moment)}


def smoothed_pose_dict(pose: records.SmoothedPose, frame: str) -> MessageDict:
    """Convert a `SmoothedPose` to geometry_msgs/PoseWithCovarianceStamped."""
    return {'header': header_dict(pose.stamp_ns, frame), 'pose': pose_with_covariance_dict(pose)}


def smoothed_track_dict(poses: Sequence[records.SmoothedPose], frame: str) -> MessageDict:
    """Convert at least one pose of a track, chronological, to mag_tracking_msgs/SmoothedTrack."""
    last = poses[-1]
    return {'header': header_dict(last.stamp_ns, frame), 'track_id': last.id, 'kind': last.kind,
            'length': last.length, 'length_std': last.length_std,
            'ambiguous': any(p.ambiguous for p in poses),
            'pose_ambiguous': [p.ambiguous for p in poses],
            'poses': [smoothed_pose_dict(p, frame) for p in poses],
            'velocities': [xyz(p.velocity) for p in poses]}


def detection_dict(d: records.Detection, frame: str) -> MessageDict:
    """Convert a `Detection` to mag_tracking_msgs/Detection."""
    return {'header': header_dict(d.stamp_ns, frame), 'id': d.id, 'kind': int(not d.onset),
            'statistic': d.statistic, 'degrees_of_freedom': d.degrees_of_freedom,
            'threshold': d.threshold, 'false_alarm_probability': d.false_alarm_probability,
            'strongest_sensor': d.strongest_sensor}


def disturbance_dict(d: Disturbance, frame: str) -> MessageDict:
    """Convert a `Disturbance` to mag_tracking_msgs/Disturbance."""
    return {'header': header_dict(d.stamp_ns, frame), 'id': d.id, 'ended': d.ended,
            'begin': stamp_dict(d.begin_ns), 'largest': d.largest, 'sensors': list(d.sensors),
            'uniform': d.uniform, 'track_id': d.track_id}


def pass_event_dict(e: PassEvent) -> MessageDict:
    """Convert a `PassEvent` to mag_tracking_msgs/PassEvent."""
    return {'header': header_dict(e.release_ns, e.sensor), 'sensor': e.sensor, 'number': e.number,
            'ended': e.ended, 'onset': stamp_dict(e.onset_ns),
            'release': stamp_dict(e.release_ns), 'peak_time': stamp_dict(e.peak_ns),
            'peak': xyz(e.peak), 'energy': e.energy, 'axes': e.axes,
            'closest_time': stamp_dict(e.closest_ns), 'closest_std': e.closest_std,
            'time_scale': e.time_scale, 'left_to_right': e.left_to_right,
            'signature': float64_array(e.signature.ravel())}


def vehicle_passage_dict(p: VehiclePassage, class_names: Sequence[str],
                         frame: str) -> MessageDict:
    """Convert a `VehiclePassage` to mag_tracking_msgs/VehiclePassage, with its class names."""
    return {'header': header_dict(p.stamp_ns, frame), 'number': p.number, 'line': p.line,
            'track_id': p.track_id, 'forward': p.forward, 'direction_error': p.direction_error,
            'position': xyz(p.position), 'lateral': p.lateral, 'velocity': xyz(p.velocity),
            'speed': p.speed, 'speed_std': p.speed_std, 'heading_std': p.heading_std,
            'length': p.length, 'length_std': p.length_std, 'moment': xyz(p.moment),
            'moment_covariance': p.moment_covariance.ravel().tolist(),
            'vehicle_class': p.vehicle_class, 'class_names': list(class_names),
            'class_probabilities': float64_array(p.class_probabilities), 'headway': p.headway,
            'ambiguous': p.ambiguous, 'doubts': list(p.doubts)}


def traffic_summary_dict(s: TrafficSummary, frame: str) -> MessageDict:
    """Convert a `TrafficSummary` to mag_tracking_msgs/TrafficSummary."""
    return {'header': header_dict(s.end_ns, frame), 'begin': stamp_dict(s.begin_ns),
            'line': s.line, 'observed_s': s.observed_s, 'counts': [
                {'forward': c.forward, 'vehicle_class': c.vehicle_class, 'count': c.count,
                 'ambiguous': c.ambiguous, 'mean_speed': c.mean_speed,
                 'mean_headway': c.mean_headway} for c in s.counts]}


def odometry_dict(track: records.Track, frame: str, child_frame: str) -> MessageDict | None:
    """Convert a `Track` to nav_msgs/Odometry; None if the pose is withheld as ambiguous.

    The twist is in the child frame, as REP-105 requires. The angular velocity is not estimated: it
    is zero with variance π².
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
