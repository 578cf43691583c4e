"""Encodings of recorded messages, and their conversion to CDR.

JSON and protobuf messages are written by Foxglove's tools and by programs without ROS. Such a
message is treated as a magnetic field if it has `magnetic_field` with x, y and z [T], and a time in
`header.stamp`, `stamp` or `timestamp`: seconds and nanoseconds, or one number since 1970. ROS 1
messages are read with the library `rosbags`.
"""

import dataclasses
import functools
import json
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.records import Schema

from mag_tracking.messages.types import DEFINITIONS, MAGNETIC_FIELD, MessageDict, encoder
from mag_tracking.units import NS, TIME_UNITS, unit_since_1970

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

CDR = 'cdr'
ROS1 = 'ros1'
_ENCAPSULATIONS = {2: 'CDR with parameter lists', 3: 'CDR with parameter lists', 6: 'XCDR2',
                   7: 'XCDR2', 8: 'XCDR2 with delimiters', 9: 'XCDR2 with delimiters',
                   10: 'XCDR2 with parameter lists', 11: 'XCDR2 with parameter lists'}
"""Other encodings of DDS than CDR, by the second byte of a message (DDS-XTypes 1.3, table 60)."""
_FIELD_DOUBLES = 12
"""Number of float64 values in a MagneticField: x, y, z and the covariance."""
_STAMPS = ('stamp', 'timestamp')
_SECONDS = ('sec', 'secs', 'seconds')
_NANOSECONDS = ('nanosec', 'nsec', 'nsecs', 'nanos')
SELF_DESCRIBED = ('json', 'protobuf')
"""Encodings whose messages are converted by means of their schema or of their own names."""
UNDECODABLE = 'undecodable message'


def cdr_of_ros1(data: bytes, type_name: str) -> bytes:
    """Convert a ROS 1 message to CDR; empty if damaged or of an unsupported type (ROS 2 name)."""
    if type_name not in DEFINITIONS:
        return b''
    try:
        message = _ros1_types().deserialize_ros1(data, type_name)
    except _decode_errors():
        return b''
    return encoder(type_name)(_as_dicts(message))


@functools.cache
def _decode_errors() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError

    # Damaged bytes can also trigger assertions of the library, and too large or invalid strings.
    return (SerdeError, AssertionError, IndexError, KeyError, TypeError, ValueError, OverflowError,
            MemoryError, struct.error)


@functools.cache
def _ros1_types() -> 'Typestore':
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)


def _as_dicts(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: _as_dicts(getattr(value, f.name)) for f in dataclasses.fields(value)
                if not f.name.startswith('__')}
    return value.tolist() if isinstance(value, np.ndarray) else value


class MissingPartError(ValueError):
    """A message lacks its time or its field; the text names the part."""


def cdr_of_self_described(encoding: str, schema: Schema, data: bytes) -> tuple[bytes, str]:
    """Convert a message in an encoding of `SELF_DESCRIBED` to the CDR of sensor_msgs/MagneticField,
    or return the reason why not; of the two results, data and fault, one is empty."""
    try:
        return encoder(MAGNETIC_FIELD)(
            field_decoder(encoding, schema.name, schema.data)(data)), ''
    except MissingPartError as error:
        return b'', f'message without {error}'
    except decode_errors():
        return b'', UNDECODABLE


@functools.cache
def decode_errors() -> tuple[type[Exception], ...]:
    """Exceptions that the result of `field_decoder` raises for invalid message bytes."""
    # Imported here because most recordings are CDR and do not need protobuf.
    from google.protobuf.message import DecodeError

    return (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError,
            struct.error, DecodeError)


@functools.cache
def field_decoder(encoding: str, name: str, content: bytes) -> Callable[[bytes], MessageDict]:
    """Create a decoder of magnetic fields, to nested dicts, for one schema, whose `content` is the
    protobuf descriptor; both raise ValueError if they cannot read it."""
    if encoding == 'json':
        return lambda data: _field(json.loads(data, object_hook=lambda d: SimpleNamespace(**d)))
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for('protobuf', Schema(1, content, 'protobuf', name))
    if decode is None:
        raise ValueError('the protobuf schema cannot be read')
    return lambda data: _field(decode(data))


def _has(message: Any, name: str) -> bool:
    """Whether a message has a field, and it was set if its encoding can tell."""
    fields = getattr(getattr(message, 'DESCRIPTOR', None), 'fields_by_name', {})
    is_unset = name in fields and fields[name].has_presence and not message.HasField(name)
    return hasattr(message, name) and not is_unset


def _part(message: Any, name: str) -> Any:
    return getattr(message, name) if _has(message, name) else None


def _field(message: Any) -> MessageDict:
    field = _part(message, 'magnetic_field')
    if field is None:
        raise MissingPartError('magnetic_field')
    header = message if _part(message, 'header') is None else message.header
    stamp = next((s for name in _STAMPS for part in (header, message)
                  if (s := _part(part, name)) is not None), None)
    if stamp is None:
        raise MissingPartError('header.stamp or timestamp')
    covariance = [float(v) for v in getattr(message, 'magnetic_field_covariance', ())]
    if len(covariance) not in (0, 9):
        raise ValueError(f'magnetic_field_covariance has {len(covariance)} elements; expected 9')
    return {
        'header': {'stamp': _time(stamp),
                   'frame_id': str(getattr(header, 'frame_id', ''))},
        'magnetic_field': {axis: _axis_value(field, axis) for axis in 'xyz'},
        'magnetic_field_covariance': covariance or [0.0] * 9}


def _number(value: Any) -> Any:
    """Convert text of digits, as which the JSON of protobuf writes 64-bit integers."""
    return int(value) if isinstance(value, str) and value.isdecimal() else value


def _time(stamp: Any) -> dict[str, int]:
    stamp = _number(stamp)
    if isinstance(stamp, str):
        raise MissingPartError('sec in its time, which is text')
    if isinstance(stamp, int | float):
        unit = unit_since_1970(stamp)
        if unit is None:
            raise MissingPartError('sec in its time, which is a number not measured from 1970')
        sec, nanosec = divmod(round(stamp * TIME_UNITS[unit]), NS)
        return {'sec': sec, 'nanosec': nanosec}
    return {'sec': _time_part(stamp, _SECONDS, 2**31),
            'nanosec': _time_part(stamp, _NANOSECONDS, NS)}


def _time_part(stamp: Any, names: tuple[str, ...], limit: int) -> int:
    """First integer among the fields `names` of `stamp`; raises ValueError if not in [0, limit)."""
    for name in names:
        value = _number(getattr(stamp, name, None))
        if isinstance(value, int) and not isinstance(value, bool):
            if not 0 <= value < limit:
                raise ValueError(f'timestamp: {name} is out of range: {str(value)[:20]}')
            return int(value)
    raise MissingPartError(f'{names[0]} in its time')


def _axis_value(field: Any, axis: str) -> float:
    """Field of one axis [T]; NaN for null. Raises ValueError for a missing or non-numeric axis."""
    if not _has(field, axis):
        raise MissingPartError(f'magnetic_field.{axis}')
    value = getattr(field, axis)
    if value is None:
        return float('nan')
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise MissingPartError(f'a number in magnetic_field.{axis}')
    return float(value)


def type_of(encoding: str, schema: Schema) -> str:
    """Message type of a channel: the name in ROS 2 if messages can be converted to it, otherwise
    the name of the schema with the encoding, such as 'std_msgs/msg/String (json)'."""
    # Names in ROS 1 have two parts, those in IDL colons.
    parts = schema.name.replace('::', '/').split('/')
    name = '/'.join((parts[0], 'msg', parts[1]) if len(parts) == 2 else parts)
    if encoding == CDR:
        return name
    if encoding in SELF_DESCRIBED and (name == MAGNETIC_FIELD or b'magnetic_field' in schema.data):
        return MAGNETIC_FIELD
    if encoding == ROS1 and name in DEFINITIONS:
        return name
    return f'{schema.name or "no schema"} ({encoding or "no encoding"})'


def cdr_of(encoding: str, kind: str, schema: Schema, data: bytes) -> tuple[bytes, str]:
    """Convert a message of a `kind` from `type_of` to plain CDR, or return the reason why not; of
    the two results, data and fault, one is empty."""
    if encoding in SELF_DESCRIBED and kind == MAGNETIC_FIELD:
        return cdr_of_self_described(encoding, schema, data)
    if encoding == ROS1:
        data = cdr_of_ros1(data, kind)
    elif encoding != CDR:
        return b'', f'message in the encoding {encoding or "(none)"}'
    elif len(data) > 1 and data[1] in _ENCAPSULATIONS:
        if kind != MAGNETIC_FIELD or _ENCAPSULATIONS[data[1]] != 'XCDR2':
            return b'', f'message in the encoding {_ENCAPSULATIONS[data[1]]}'
        data = _cdr_of_xcdr2(data)
    return data, '' if data else UNDECODABLE


def _cdr_of_xcdr2(data: bytes) -> bytes:
    """Convert a MagneticField in XCDR2, which aligns float64 to 4 bytes; empty if it is damaged."""
    order = '<' if data[1] & 1 else '>'
    try:
        sec, nanosec, length = struct.unpack_from(f'{order}iII', data, 4)
        name = data[16:16 + length]
        values = struct.unpack_from(f'{order}{_FIELD_DOUBLES}d', data, 16 + (length + 3) // 4 * 4)
    except struct.error:
        return b''
    head = struct.pack('<iII', sec, nanosec, length) + name
    return b'\0\1\0\0' + head + bytes(-len(head) % 8) + struct.pack(
        f'<{_FIELD_DOUBLES}d', *values)
