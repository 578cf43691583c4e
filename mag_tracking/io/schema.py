"""Records to and from messages, as nested dicts and CDR bytes, without ROS.

The definitions of this package's own messages stand in `msg_defs/`; the copy
here is what a recording carries, and a test compares the two.
"""

import functools
import struct

import numpy as np
from mcap.exceptions import McapError
from mcap_ros2 import _dynamic
from mcap_ros2.decoder import DecoderFactory

from mag_tracking.errors import RecordingError
from mag_tracking.geometry import rotation_from_quaternion
from mag_tracking.records import AccelerationSample, FieldFrame, MagSample

MAGNETIC_FIELD = 'sensor_msgs/msg/MagneticField'
IMU = 'sensor_msgs/msg/Imu'
POSE = 'geometry_msgs/msg/PoseStamped'
POSE_WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
TRACK_ARRAY = 'mag_tracking_msgs/msg/TrackArray'

LONGEST_OFFSET_S = 60.0
"""[s] The longest frame there can be (`align.period_s`)."""

DEFINITIONS = {
    'builtin_interfaces/msg/Time': ((), 'int32 sec\nuint32 nanosec\n'),
    'std_msgs/msg/Header': (('builtin_interfaces/msg/Time',),
                            'builtin_interfaces/Time stamp\nstring frame_id\n'),
    'geometry_msgs/msg/Vector3': ((), 'float64 x\nfloat64 y\nfloat64 z\n'),
    'geometry_msgs/msg/Point': ((), 'float64 x\nfloat64 y\nfloat64 z\n'),
    'geometry_msgs/msg/Quaternion': (
        (), 'float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n'),
    'geometry_msgs/msg/Pose': (
        ('geometry_msgs/msg/Point', 'geometry_msgs/msg/Quaternion'),
        'geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n'),
    'geometry_msgs/msg/PoseWithCovariance': (
        ('geometry_msgs/msg/Pose',), 'geometry_msgs/Pose pose\nfloat64[36] covariance\n'),
    POSE: (('std_msgs/msg/Header', 'geometry_msgs/msg/Pose'),
           'std_msgs/Header header\ngeometry_msgs/Pose pose\n'),
    POSE_WITH_COVARIANCE: (
        ('std_msgs/msg/Header', 'geometry_msgs/msg/PoseWithCovariance'),
        'std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n'),
    MAGNETIC_FIELD: (
        ('std_msgs/msg/Header', 'geometry_msgs/msg/Vector3'),
        'std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\n'
        'float64[9] magnetic_field_covariance\n'),
    'mag_tracking_msgs/msg/Track': (
        ('std_msgs/msg/Header', 'geometry_msgs/msg/PoseWithCovariance',
         'geometry_msgs/msg/Vector3'),
        'uint8 ACTIVE=0\nuint8 ENDED=1\nstd_msgs/Header header\nuint32 id\nuint8 status\n'
        'geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/Vector3 velocity\n'
        'float64[36] covariance\ngeometry_msgs/Vector3 moment\nfloat64[9] moment_covariance\n'
        'float64 existence\nfloat64 weight\nfloat64 normalised_innovation\n'
        'float64[] innovation_by_sensor\nuint32 degrees_of_freedom\nstring arrival\nstring kind\n'
        'float64 kind_weight\nfloat64 length\nfloat64 length_std\nbool ambiguous\n'
        'bool[6] unobservable\n'
        'float64[] predicted_field\nfloat64[] mounting\nfloat64[] mounting_covariance\n'),
    TRACK_ARRAY: (('std_msgs/msg/Header', 'mag_tracking_msgs/msg/Track'),
                  'std_msgs/Header header\nmag_tracking_msgs/Track[] tracks\n'),
}
"""{type: (types that it names, text)}; Jazzy's definitions without comments."""


def _closure(type_name):
    """The types below `type_name`, each once, in the order met."""
    seen = []
    queue = list(DEFINITIONS[type_name][0])
    while queue:
        name = queue.pop(0)
        if name not in seen:
            seen.append(name)
            queue += DEFINITIONS[name][0]
    return seen


def definition(type_name):
    """The text of a type with all that it needs, as a `ros2msg` schema has it.

    Raises RecordingError for a type that is not defined here.
    """
    if type_name not in DEFINITIONS:
        raise RecordingError(f'no definition of {type_name} to write it with')
    text = DEFINITIONS[type_name][1]
    for name in _closure(type_name):
        package, _, leaf = name.split('/')
        text += f'{"=" * 80}\nMSG: {package}/{leaf}\n{DEFINITIONS[name][1]}'
    return text


@functools.cache
def encoder(type_name):
    """Function from nested dicts to CDR bytes."""
    # The library offers this function only through its own writer, which cannot
    # write channel metadata; the version is pinned, so this private name is safe.
    return _dynamic.serialize_dynamic(type_name, definition(type_name))[type_name]


_decoders = {}
_DECODE_ERRORS = (ValueError, IndexError, KeyError, OverflowError, struct.error, McapError)


def decode(message):
    """A `RawMessage` as an object with the fields of its type.

    Raises RecordingError where the bytes do not fit the type.
    """
    key = message.schema.name, message.schema.data
    try:
        if key not in _decoders:
            _decoders[key] = DecoderFactory().decoder_for('cdr', message.schema)
        if _decoders[key] is None:
            raise ValueError(f'its schema is in {message.schema.encoding}, not in ros2msg')
        return _decoders[key](message.data)
    except _DECODE_ERRORS as error:
        raise RecordingError(f'a message on {message.topic} is not a {message.type}: '
                             f'{error}') from error


def stamp_ns(stamp):
    """Nanoseconds of a builtin_interfaces/Time."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def stamp_dict(ns):
    """A builtin_interfaces/Time of nanoseconds."""
    return {'sec': ns // 1_000_000_000, 'nanosec': ns % 1_000_000_000}


def sample_of(message, sensor):
    """`MagSample` of a message-shaped sensor_msgs/MagneticField of `sensor`.

    A covariance that is all zero, or begins with -1, is unknown.
    """
    f = message.magnetic_field
    C = np.array(message.magnetic_field_covariance, dtype=float)
    unknown = C[0] == -1.0 or not C.any()
    return MagSample(stamp_ns(message.header.stamp), sensor, np.array([f.x, f.y, f.z]),
                     None if unknown else C.reshape(3, 3))


def acceleration_of(message, sensor):
    """`AccelerationSample` of a message-shaped sensor_msgs/Imu of `sensor`.

    NaN where the message says that it has none (its covariance begins with -1).
    """
    a = message.linear_acceleration
    there = message.linear_acceleration_covariance[0] != -1.0
    return AccelerationSample(stamp_ns(message.header.stamp), sensor,
                              np.array([a.x, a.y, a.z]) if there else np.full(3, np.nan))


def xyz(v):
    """Vector as a dict."""
    return {'x': float(v[0]), 'y': float(v[1]), 'z': float(v[2])}


def header_dict(ns, frame):
    """A std_msgs/Header."""
    return {'stamp': stamp_dict(ns), 'frame_id': frame}


def sample_dict(sample, frame):
    """sensor_msgs/MagneticField of a `MagSample`; `frame` is the sensor's."""
    C = np.zeros(9) if sample.covariance is None else sample.covariance.ravel()
    return {'header': header_dict(sample.stamp_ns, frame), 'magnetic_field': xyz(sample.field),
            'magnetic_field_covariance': C.tolist()}


def pose_dict(ns, frame, position, quaternion):
    """geometry_msgs/PoseStamped."""
    return {'header': header_dict(ns, frame), 'pose': _pose(position, quaternion)}


def _pose(position, quaternion):
    """geometry_msgs/Pose."""
    return {'position': xyz(position),
            'orientation': {**xyz(quaternion), 'w': float(quaternion[3])}}


def pose_covariance(track):
    """(6, 6) of position and small rotations about fixed axes, as ROS orders them."""
    C = np.empty((6, 6))
    C[:3, :3] = track.covariance[:3, :3]
    C[:3, 3:] = track.position_orientation_covariance
    C[3:, :3] = track.position_orientation_covariance.T
    C[3:, 3:] = track.orientation_covariance
    return C


def pose_with_covariance_dict(track):
    """geometry_msgs/PoseWithCovariance of a `Track`."""
    return {'pose': _pose(track.position, track.orientation),
            'covariance': pose_covariance(track).ravel().tolist()}


def track_dict(track, frame):
    """mag_tracking_msgs/Track of a `Track`."""
    return {'header': header_dict(track.stamp_ns, frame), 'id': track.id,
            'status': int(track.ended), 'pose': pose_with_covariance_dict(track),
            'velocity': xyz(track.velocity), 'covariance': track.covariance.ravel().tolist(),
            'moment': xyz(track.moment),
            'moment_covariance': track.moment_covariance.ravel().tolist(),
            'existence': track.existence, 'weight': track.weight,
            'normalised_innovation': track.nis, 'degrees_of_freedom': track.degrees_of_freedom,
            'innovation_by_sensor': track.nis_by_sensor.tolist(),
            'arrival': track.arrival, 'kind': track.kind, 'kind_weight': track.kind_weight,
            'length': track.length, 'length_std': track.length_std, 'ambiguous': track.ambiguous,
            'unobservable': list(track.unobservable),
            'predicted_field': track.predicted.ravel().tolist(),
            'mounting': track.mounting.ravel().tolist(),
            'mounting_covariance': track.mounting_covariance.ravel().tolist()}


def hypotheses_dict(track, frame):
    """mag_tracking_msgs/HypothesisArray of a `Track`."""
    return {'header': header_dict(track.stamp_ns, frame), 'track_id': track.id,
            'hypotheses': [
                {'arrival': h.arrival, 'kind': h.kind, 'weight': h.weight,
                 'position': xyz(h.position), 'velocity': xyz(h.velocity),
                 'covariance': h.covariance.ravel().tolist(), 'moment': xyz(h.moment)}
                for h in track.hypotheses]}


def smoothed_pose_dict(pose, frame):
    """geometry_msgs/PoseWithCovarianceStamped of a `SmoothedPose`."""
    return {'header': header_dict(pose.stamp_ns, frame), 'pose': pose_with_covariance_dict(pose)}


def smoothed_track_dict(poses, frame):
    """mag_tracking_msgs/SmoothedTrack of the `SmoothedPose`s of one track."""
    last = poses[-1]
    return {'header': header_dict(last.stamp_ns, frame), 'track_id': last.id, 'kind': last.kind,
            'length': last.length, 'length_std': last.length_std, 'ambiguous': last.ambiguous,
            'poses': [smoothed_pose_dict(p, frame) for p in poses],
            'velocities': [xyz(p.velocity) for p in poses]}


def frame_dict(frame, network):
    """mag_tracking_msgs/NetworkFrame of a `FieldFrame`."""
    return {'header': header_dict(frame.stamp_ns, network.frame), 'sensors': list(network.names),
            'field': frame.field.ravel().tolist(),
            'covariance': frame.covariance.ravel().tolist(),
            'n_samples': frame.n_samples.tolist(), 'time_offset': frame.time_offset.tolist(),
            'target_present': frame.target_present,
            'statistic': frame.statistic, 'degrees_of_freedom': frame.degrees_of_freedom}


def frame_of(message, network):
    """`FieldFrame` of a message-shaped NetworkFrame.

    Raises RecordingError where sensors or lengths are not those of the network.
    """
    n = len(network)
    if tuple(message.sensors) != network.names:
        raise RecordingError(f'a frame of {", ".join(message.sensors)} does not fit the network '
                             f'of {", ".join(network.names)}')
    lengths = {name: len(getattr(message, name)) for name in (
        'field', 'covariance', 'n_samples', 'time_offset')}
    expected = dict(zip(lengths, (3 * n, 9 * n, n, n), strict=True))
    if lengths != expected:
        raise RecordingError(f'a frame of {n} sensors needs arrays of lengths {expected}, '
                             f'got {lengths}')
    frame = FieldFrame(
        stamp_ns(message.header.stamp), np.array(message.field).reshape(n, 3),
        np.array(message.covariance).reshape(n, 3, 3), np.array(message.n_samples, dtype=int),
        np.array(message.time_offset, dtype=float), bool(message.target_present),
        float(message.statistic), int(message.degrees_of_freedom))
    _check_numbers(frame)
    return frame


def _check_numbers(frame):
    """Raise RecordingError where a frame holds what no alignment gives."""
    if np.isinf(frame.field).any():
        raise RecordingError('a frame with an infinite field')
    if not (np.abs(frame.time_offset) <= LONGEST_OFFSET_S).all():
        raise RecordingError(f'a frame with time offsets of {frame.time_offset.tolist()} s')
    there = ~np.isnan(frame.field)
    C = np.where(there[:, :, None] & there[:, None, :], frame.covariance, np.eye(3))
    variance = np.einsum('jii->ji', C)
    # Scaled to one: in tesla squared every eigenvalue looks like zero.
    std = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    scaled = C / (std[:, :, None] * std[:, None, :])
    if not np.isfinite(scaled).all() or np.linalg.eigvalsh(scaled).min() <= 1e-12:
        raise RecordingError('a frame with a covariance that is not positive definite')


def detection_dict(d, frame):
    """mag_tracking_msgs/Detection of a `Detection`."""
    return {'header': header_dict(d.stamp_ns, frame), 'id': d.id, 'kind': int(not d.onset),
            'statistic': d.statistic, 'degrees_of_freedom': d.degrees_of_freedom,
            'threshold': d.threshold, 'false_alarm_probability': d.false_alarm_probability,
            'strongest_sensor': d.strongest_sensor}


def odometry_dict(track, frame, child_frame):
    """nav_msgs/Odometry: the twist is in the child frame, as REP-105 has it.

    The angular velocity is not estimated here: zero, with variance pi^2.
    """
    R = rotation_from_quaternion(track.orientation)
    twist = np.zeros((6, 6))
    twist[:3, :3] = R.T @ track.covariance[3:, 3:] @ R
    twist[3:, 3:] = np.pi**2 * np.eye(3)
    return {'header': header_dict(track.stamp_ns, frame), 'child_frame_id': child_frame,
            'pose': pose_with_covariance_dict(track),
            'twist': {'twist': {'linear': xyz(R.T @ track.velocity), 'angular': xyz(np.zeros(3))},
                      'covariance': twist.ravel().tolist()}}
