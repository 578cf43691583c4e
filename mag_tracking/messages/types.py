"""Message types as text, and their CDR bytes, without ROS.

The definitions of this package's own messages stand in `msg_defs/`; the copy
here is what a recording carries, and a test compares the two.
"""

import functools
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Protocol

from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_ros2 import _dynamic
from mcap_ros2.decoder import DecoderFactory

from mag_tracking.errors import RecordingError
from mag_tracking.messages.shapes import MessageDict

MAGNETIC_FIELD = 'sensor_msgs/msg/MagneticField'
IMU = 'sensor_msgs/msg/Imu'
POSE = 'geometry_msgs/msg/PoseStamped'
POSE_WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'
TRACK_ARRAY = 'mag_tracking_msgs/msg/TrackArray'
FIELD_READINGS = 'mag_tracking_msgs/msg/FieldReadings'
DISTURBANCE = 'mag_tracking_msgs/msg/Disturbance'

RAW_READINGS = 'field_readings'
"""The topic of raw readings of many sensors. It and the next ones are relative to the namespace of
the nodes, whatever these are called."""
CALIBRATED_READINGS = 'field_readings_calibrated'
"""The same, calibrated."""
CALIBRATION_STATE = 'calibration_state'
"""The topic of the sensors' calibration."""
NETWORK_FRAME = 'network_frame'
"""The topic of frames of the network."""

DEFINITIONS: dict[str, tuple[tuple[str, ...], str]] = {
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
    FIELD_READINGS: (
        ('std_msgs/msg/Header',),
        'std_msgs/Header header\nstring[] sensors\nuint16[] sensor\nint64[] stamp\n'
        'float64[] field\nfloat64[] covariance\n'),
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
        'float64[] predicted_field\nfloat64[] mounting\nfloat64[] mounting_covariance\n'
        'string[] doubts\n'),
    DISTURBANCE: (
        ('std_msgs/msg/Header', 'builtin_interfaces/msg/Time'),
        'std_msgs/Header header\nuint32 id\nbool ended\nbuiltin_interfaces/Time begin\n'
        'float64 largest\nstring[] sensors\nfloat64 uniform\nuint32 track_id\n'),
    TRACK_ARRAY: (('std_msgs/msg/Header', 'mag_tracking_msgs/msg/Track'),
                  'std_msgs/Header header\nmag_tracking_msgs/Track[] tracks\n'),
}
"""{type: (types that it names, text)}; Jazzy's definitions without comments."""


def _closure(type_name: str) -> list[str]:
    """The types below `type_name`, each once, in the order met."""
    seen: list[str] = []
    queue = list(DEFINITIONS[type_name][0])
    while queue:
        name = queue.pop(0)
        if name not in seen:
            seen.append(name)
            queue += DEFINITIONS[name][0]
    return seen


def definition(type_name: str) -> str:
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
def schema_of(type_name: str) -> Schema:
    """The schema of a message type; empty where this package does not use the type."""
    known = type_name in DEFINITIONS
    return Schema(1, definition(type_name).encode() if known else b'',
                  'ros2msg' if known else '', type_name)


@functools.cache
def encoder(type_name: str) -> Callable[[MessageDict], bytes]:
    """Function from nested dicts to CDR bytes."""
    # The library offers this function only through its own writer, which cannot
    # write channel metadata; the version is pinned, so this private name is safe.
    return _dynamic.serialize_dynamic(type_name, definition(type_name))[type_name]


class _Raw(Protocol):
    """A `RawMessage`."""

    @property
    def topic(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def data(self) -> bytes: ...
    @property
    def schema(self) -> Schema: ...


_decoders: dict[tuple[str, bytes], Callable[[bytes], SimpleNamespace] | None] = {}
_DECODE_ERRORS = (ValueError, TypeError, IndexError, KeyError, OverflowError, struct.error,
                  McapError)


def decode(message: _Raw) -> SimpleNamespace:
    """A `RawMessage` as an object with the fields of its type.

    Raises RecordingError where the bytes do not fit the type.
    """
    key = message.schema.name, message.schema.data
    try:
        if key not in _decoders:
            _decoders[key] = DecoderFactory().decoder_for('cdr', message.schema)
        decoder = _decoders[key]
        if decoder is None:
            raise ValueError(f'it has no ros2msg schema (encoding '
                             f'{message.schema.encoding!r})')
        return decoder(message.data)
    except _DECODE_ERRORS as error:
        raise RecordingError(f'a message on {message.topic} is not a {message.type}: '
                             f'{error}') from error
