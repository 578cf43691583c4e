"""Message types: definitions, schemas, and encoding and decoding of CDR bytes, without ROS.

The definitions have no comments. The standard types are from ROS 2 Jazzy, the types of this package
from `msg_defs/`. A test checks that the definitions agree with these sources.
"""

import functools
import re
import struct
from ast import literal_eval
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from mag_tracking.errors import RecordingError
from mag_tracking.messages import core

MessageDict: TypeAlias = dict[str, Any]
"""Message to be written, as nested dicts of its fields."""

DEFINITIONS: dict[str, str] = {
    'builtin_interfaces/msg/Duration': 'int32 sec\nuint32 nanosec\n',
    'builtin_interfaces/msg/Time': 'int32 sec\nuint32 nanosec\n',
    'std_msgs/msg/ColorRGBA': 'float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n',
    'std_msgs/msg/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
    'geometry_msgs/msg/Point': 'float64 x\nfloat64 y\nfloat64 z\n',
    'geometry_msgs/msg/Pose': (
        'geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n'),
    'geometry_msgs/msg/PoseStamped': 'std_msgs/Header header\ngeometry_msgs/Pose pose\n',
    'geometry_msgs/msg/PoseWithCovariance': 'geometry_msgs/Pose pose\nfloat64[36] covariance\n',
    'geometry_msgs/msg/PoseWithCovarianceStamped': (
        'std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n'),
    'geometry_msgs/msg/Quaternion': 'float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n',
    'geometry_msgs/msg/Transform': (
        'geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n'),
    'geometry_msgs/msg/TransformStamped': (
        'std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n'),
    'geometry_msgs/msg/Twist': 'geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n',
    'geometry_msgs/msg/TwistWithCovariance': 'geometry_msgs/Twist twist\nfloat64[36] covariance\n',
    'geometry_msgs/msg/Vector3': 'float64 x\nfloat64 y\nfloat64 z\n',
    'sensor_msgs/msg/CompressedImage': 'std_msgs/Header header\nstring format\nuint8[] data\n',
    'sensor_msgs/msg/MagneticField': (
        'std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\n'
        'float64[9] magnetic_field_covariance\n'),
    'nav_msgs/msg/Odometry': (
        'std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n'
        'geometry_msgs/TwistWithCovariance twist\n'),
    'nav_msgs/msg/Path': 'std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n',
    'tf2_msgs/msg/TFMessage': 'geometry_msgs/TransformStamped[] transforms\n',
    'visualization_msgs/msg/Marker': (
        'int32 ARROW=0\nint32 CUBE=1\nint32 SPHERE=2\nint32 CYLINDER=3\nint32 LINE_STRIP=4\n'
        'int32 LINE_LIST=5\nint32 CUBE_LIST=6\nint32 SPHERE_LIST=7\nint32 POINTS=8\n'
        'int32 TEXT_VIEW_FACING=9\nint32 MESH_RESOURCE=10\nint32 TRIANGLE_LIST=11\n'
        'int32 ARROW_STRIP=12\nint32 ADD=0\nint32 MODIFY=0\nint32 DELETE=2\nint32 DELETEALL=3\n'
        'std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n'
        'geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n'
        'builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n'
        'std_msgs/ColorRGBA[] colors\nstring texture_resource\n'
        'sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\n'
        'string text\nstring mesh_resource\nvisualization_msgs/MeshFile mesh_file\n'
        'bool mesh_use_embedded_materials\n'),
    'visualization_msgs/msg/MarkerArray': 'visualization_msgs/Marker[] markers\n',
    'visualization_msgs/msg/MeshFile': 'string filename\nuint8[] data\n',
    'visualization_msgs/msg/UVCoordinate': 'float32 u\nfloat32 v\n',
    'mag_tracking_msgs/msg/Disturbance': (
        'std_msgs/Header header\nuint32 id\nbool ended\nbuiltin_interfaces/Time begin\n'
        'float64 largest\nstring[] sensors\nfloat64 uniform\nuint32 track_id\n'),
    'mag_tracking_msgs/msg/FieldReadings': (
        'std_msgs/Header header\nstring[] sensors\nuint16[] sensor\nint64[] stamp\n'
        'float64[] field\nfloat64[] covariance\n'),
    'mag_tracking_msgs/msg/Hypothesis': (
        'string arrival\nstring kind\nfloat64 weight\ngeometry_msgs/Point position\n'
        'geometry_msgs/Vector3 velocity\nfloat64[36] covariance\ngeometry_msgs/Vector3 moment\n'),
    'mag_tracking_msgs/msg/SmoothedTrack': (
        'std_msgs/Header header\nuint32 track_id\nstring kind\nfloat64 length\n'
        'float64 length_std\nbool ambiguous\nbool[] pose_ambiguous\n'
        'geometry_msgs/PoseWithCovarianceStamped[] poses\ngeometry_msgs/Vector3[] velocities\n'),
    'mag_tracking_msgs/msg/Track': (
        'uint8 ACTIVE=0\nuint8 ENDED=1\nstd_msgs/Header header\nuint32 id\nuint8 status\n'
        'geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/Vector3 velocity\n'
        'float64[36] covariance\ngeometry_msgs/Vector3 moment\nfloat64[9] moment_covariance\n'
        'float64 existence\nfloat64 weight\nfloat64 normalised_innovation\n'
        'float64[] innovation_by_sensor\nuint32 degrees_of_freedom\nstring arrival\nstring kind\n'
        'float64 kind_weight\nfloat64 length\nfloat64 length_std\nbool ambiguous\n'
        'bool[6] unobservable\nfloat64[] predicted_field\nfloat64[] mounting\n'
        'float64[] mounting_covariance\nstring[] doubts\n'
        'mag_tracking_msgs/Hypothesis[] arrivals\n'),
    'mag_tracking_msgs/msg/TrackArray': (
        'std_msgs/Header header\nmag_tracking_msgs/Track[] tracks\n'),
}


MAGNETIC_FIELD = 'sensor_msgs/msg/MagneticField'
IMU = 'sensor_msgs/msg/Imu'
POSE = 'geometry_msgs/msg/PoseStamped'
POSE_WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
ODOMETRY = 'nav_msgs/msg/Odometry'
TRACK_ARRAY = 'mag_tracking_msgs/msg/TrackArray'
FIELD_READINGS = 'mag_tracking_msgs/msg/FieldReadings'
DISTURBANCE = 'mag_tracking_msgs/msg/Disturbance'
SMOOTHED_TRACK = 'mag_tracking_msgs/msg/SmoothedTrack'
PATH = 'nav_msgs/msg/Path'
MARKERS = 'visualization_msgs/msg/MarkerArray'
TRANSFORMS = 'tf2_msgs/msg/TFMessage'

ROS_SCHEMA = 'ros2msg'
"""Encoding of the schemas of ROS 2 messages that can be decoded."""
RAW_READINGS = 'field_readings'
"""Topic of raw readings of many sensors. Like the topics below, it is relative to the namespace of
the nodes and independent of the node names."""
CALIBRATED_READINGS = 'field_readings_calibrated'
CALIBRATION_STATE = 'calibration_state'
NETWORK_FRAME = 'network_frame'

_BUILT_IN = {'bool', 'byte', 'char', 'string', 'wstring', 'float32', 'float64',
             *(f'{u}int{n}' for u in ('', 'u') for n in (8, 16, 32, 64))}
_FIELD = re.compile(r'\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[(?P<array>(?:<=)?\d*)\])?'
                    r'\s+(?P<name>[A-Za-z]\w*)\s*(?P<is_constant>=?)(?P<default>[^#]*)')


class RawMessage(NamedTuple):
    """Message of a recording, converted to CDR if it is stored in another encoding."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes
    """Serialised message, CDR. Empty if the stored message cannot be converted."""
    schema: Schema
    fault: str = ''
    """Why the stored message cannot be converted. Empty if it can."""


def _full_name(kind: str, package: str) -> str:
    owner, _, leaf = kind.rpartition('/')
    return f'{(owner or package).partition("/")[0]}/msg/{leaf}'


def referenced_types(message_definition: str, package: str) -> list[str]:
    """Full names of the types that a definition references directly, in order of appearance."""
    fields = (_FIELD.match(line.partition('#')[0]) for line in message_definition.splitlines())
    return list(dict.fromkeys(
        _full_name(field['type'], package) for field in fields
        if field and not field['is_constant'] and field['type'] not in _BUILT_IN))


def _own_definition(type_name: str) -> str:
    if type_name not in DEFINITIONS:
        raise RecordingError(f'cannot encode {type_name}: no definition of this type is available')
    return DEFINITIONS[type_name]


def definition(type_name: str) -> str:
    """Definition of a type and of all types it contains, in the format of a `ros2msg` schema."""
    message_definition, found = _own_definition(type_name), [type_name]
    for name in found:
        found += [n for n in referenced_types(DEFINITIONS[name], name.partition('/')[0])
                  if n not in found]
    for name in found[1:]:
        package, _, leaf = name.split('/')
        message_definition += f'{"=" * 80}\nMSG: {package}/{leaf}\n{DEFINITIONS[name]}'
    return message_definition


@functools.cache
def schema_of(type_name: str) -> Schema:
    """MCAP schema of a message type; empty if its definition is unknown."""
    is_defined = type_name in DEFINITIONS
    return Schema(1, definition(type_name).encode() if is_defined else b'',
                  ROS_SCHEMA if is_defined else '', type_name)


@functools.cache
def encoder(type_name: str) -> core.Encoder:
    """Encoder from nested dicts to CDR; raises RecordingError if the type is unknown."""
    package, fields = type_name.partition('/')[0], []
    for line in _own_definition(type_name).splitlines():
        field = _FIELD.match(line)
        if field is None or field['is_constant']:
            continue
        kind, array = field['type'], field['array']
        length = core.ONE if array is None else int(array) if array.isdecimal() \
            else core.SEQUENCE
        fields.append((field['name'], length,
                       kind if kind in _BUILT_IN else encoder(_full_name(kind, package)),
                       literal_eval(field['default']) if field['default'] else None))
    return core.Encoder(fields)


_decoders: dict[tuple[str, bytes], Callable[[bytes], SimpleNamespace] | None] = {}
_DECODE_ERRORS = (ValueError, TypeError, IndexError, KeyError, OverflowError, struct.error,
                  McapError)


def decode(message: RawMessage) -> SimpleNamespace:
    """Decode the CDR bytes of a message to the fields of its type; raises RecordingError if they do
    not match the type, or the schema is not supported."""
    key = message.schema.name, message.schema.data
    try:
        if key not in _decoders:
            _decoders[key] = DecoderFactory().decoder_for('cdr', message.schema)
        decoder = _decoders[key]
        if decoder is None:
            raise RecordingError(
                f'{message.topic}: cannot decode a message as {message.type}: schema encoding '
                f'{message.schema.encoding!r} is not supported; expected ros2msg')
        return decoder(message.data)
    except _DECODE_ERRORS as error:
        raise RecordingError(f'{message.topic}: cannot decode a message as {message.type}: '
                             f'{error}') from error
