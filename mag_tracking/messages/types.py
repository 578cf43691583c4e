"""Message types as text, and their CDR bytes, without ROS.

The texts are those of `definitions`; a recording carries them.
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

RAW_READINGS = 'field_readings'
"""The topic of raw readings of many sensors. It and the next ones are relative to the namespace of
the nodes, whatever these are called."""
CALIBRATED_READINGS = 'field_readings_calibrated'
"""The same, calibrated."""
CALIBRATION_STATE = 'calibration_state'
"""The topic of the sensors' calibration."""
NETWORK_FRAME = 'network_frame'
"""The topic of frames of the network."""

_BUILT_IN = {'bool', 'byte', 'char', 'string', 'wstring', 'float32', 'float64',
             *(f'{u}int{n}' for u in ('', 'u') for n in (8, 16, 32, 64))}
_FIELD = re.compile(r'\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[(?P<array>(?:<=)?\d*)\])?'
                    r'\s+(?P<name>[A-Za-z]\w*)\s*(?P<is_constant>=?)(?P<default>[^#]*)')


def _full_name(kind: str, package: str) -> str:
    """The name of a type that a definition of a `package` names."""
    owner, _, leaf = kind.rpartition('/')
    return f'{(owner or package).partition("/")[0]}/msg/{leaf}'


def named_in(text: str, package: str) -> list[str]:
    """The types that a definition of a `package` names, each once."""
    out: list[str] = []
    for line in text.splitlines():
        field = _FIELD.match(line.partition('#')[0])
        if field and not field['is_constant'] and field['type'] not in _BUILT_IN:
            name = _full_name(field['type'], package)
            if name not in out:
                out.append(name)
    return out


def _closure(type_name: str) -> list[str]:
    """The types below `type_name`, each once, in the order met."""
    seen: list[str] = []
    queue = [type_name]
    while queue:
        name = queue.pop(0)
        if name not in seen:
            seen.append(name)
            queue += named_in(DEFINITIONS[name], name.partition('/')[0])
    return seen[1:]


def definition(type_name: str) -> str:
    """The text of a type with all that it needs, as a `ros2msg` schema has it.

    Raises RecordingError for a type that is not defined here.
    """
    if type_name not in DEFINITIONS:
        raise RecordingError(f'no definition of {type_name} to write it with')
    text = DEFINITIONS[type_name]
    for name in _closure(type_name):
        package, _, leaf = name.split('/')
        text += f'{"=" * 80}\nMSG: {package}/{leaf}\n{DEFINITIONS[name]}'
    return text


@functools.cache
def schema_of(type_name: str) -> Schema:
    """The schema of a message type; empty where this package does not use the type."""
    known = type_name in DEFINITIONS
    return Schema(1, definition(type_name).encode() if known else b'',
                  'ros2msg' if known else '', type_name)


@functools.cache
def encoder(type_name: str) -> core.Encoder:
    """Function from nested dicts to CDR bytes.

    Raises RecordingError for a type that is not defined here.
    """
    if type_name not in DEFINITIONS:
        raise RecordingError(f'no definition of {type_name} to write it with')
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
