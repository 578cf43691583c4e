"""Message schemas, and encoding and decoding of CDR bytes, without ROS.

The schemas are built from the message definitions of `definitions`.
"""

import functools
import re
import struct
from ast import literal_eval
from collections.abc import Callable
from types import SimpleNamespace
from typing import Protocol

from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from mag_tracking.errors import RecordingError
from mag_tracking.messages import core
from mag_tracking.messages.definitions import DEFINITIONS

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
"""Topic of calibrated readings of many sensors."""
CALIBRATION_STATE = 'calibration_state'
"""Topic of the calibration of all sensors."""
NETWORK_FRAME = 'network_frame'
"""Topic of network frames."""

_BUILT_IN = {'bool', 'byte', 'char', 'string', 'wstring', 'float32', 'float64',
             *(f'{u}int{n}' for u in ('', 'u') for n in (8, 16, 32, 64))}
_FIELD = re.compile(r'\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[(?P<array>(?:<=)?\d*)\])?'
                    r'\s+(?P<name>[A-Za-z]\w*)\s*(?P<is_constant>=?)(?P<default>[^#]*)')


def _full_name(kind: str, package: str) -> str:
    """Full name of the type that is called `kind` in a definition of `package`."""
    owner, _, leaf = kind.rpartition('/')
    return f'{(owner or package).partition("/")[0]}/msg/{leaf}'


def referenced_types(message_definition: str, package: str) -> list[str]:
    """Full names of the types that a definition references directly, in order of appearance."""
    out: list[str] = []
    for line in message_definition.splitlines():
        field = _FIELD.match(line.partition('#')[0])
        if field and not field['is_constant'] and field['type'] not in _BUILT_IN:
            name = _full_name(field['type'], package)
            if name not in out:
                out.append(name)
    return out


def _dependencies(type_name: str) -> list[str]:
    """Types contained in `type_name` at any depth, without duplicates, in breadth-first order."""
    visited: list[str] = []
    queue = [type_name]
    while queue:
        name = queue.pop(0)
        if name not in visited:
            visited.append(name)
            queue += referenced_types(DEFINITIONS[name], name.partition('/')[0])
    return visited[1:]


def definition(type_name: str) -> str:
    """Definition of a type and of all types it contains, in the format of a `ros2msg` schema.

    Raises RecordingError if `definitions` does not contain the type.
    """
    if type_name not in DEFINITIONS:
        raise RecordingError(f'cannot encode {type_name}: no definition of this type is available')
    message_definition = DEFINITIONS[type_name]
    for name in _dependencies(type_name):
        package, _, leaf = name.split('/')
        message_definition += f'{"=" * 80}\nMSG: {package}/{leaf}\n{DEFINITIONS[name]}'
    return message_definition


@functools.cache
def schema_of(type_name: str) -> Schema:
    """MCAP schema of a message type; empty if `definitions` does not contain it."""
    is_defined = type_name in DEFINITIONS
    return Schema(1, definition(type_name).encode() if is_defined else b'',
                  ROS_SCHEMA if is_defined else '', type_name)


@functools.cache
def encoder(type_name: str) -> core.Encoder:
    """Encoder from nested dicts to CDR; raises RecordingError if `definitions` lacks the type."""
    if type_name not in DEFINITIONS:
        raise RecordingError(f'cannot encode {type_name}: no definition of this type is available')
    package, fields = type_name.partition('/')[0], []
    for line in DEFINITIONS[type_name].splitlines():
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


class _RawMessage(Protocol):
    """Interface of `RawMessage`."""

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


def decode(message: _RawMessage) -> SimpleNamespace:
    """Decode the CDR bytes of a message to the fields of its type.

    Raises RecordingError if the bytes do not match the type, or the schema is not supported.
    """
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
