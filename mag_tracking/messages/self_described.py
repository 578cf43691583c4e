"""Decoding of magnetic fields from JSON or protobuf messages by means of the message schema.

Such messages are written by Foxglove's tools and by programs without ROS. A message is treated as
a magnetic field if it has `magnetic_field` with x, y and z [T], and a time in `header.stamp`,
`stamp` or `timestamp`.
"""

import functools
import json
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from mcap.records import Schema

from mag_tracking.messages.shapes import MessageDict
from mag_tracking.messages.types import MAGNETIC_FIELD, encoder

_STAMPS = ('stamp', 'timestamp')
_SECONDS = ('sec', 'secs', 'seconds')
_NANOSECONDS = ('nanosec', 'nsec', 'nsecs', 'nanos')

SUPPORTED_ENCODINGS = ('jsonschema', 'protobuf')
"""Supported schema encodings."""


def type_of(schema: Schema) -> str:
    """Message type of a schema.

    Parameters
    ----------
    schema : Schema

    Returns
    -------
    str
        The type sensor_msgs/msg/MagneticField if a schema in a supported encoding contains
        `magnetic_field`; otherwise the name of the schema.
    """
    is_field = schema.encoding in SUPPORTED_ENCODINGS and b'magnetic_field' in schema.data
    return MAGNETIC_FIELD if is_field else schema.name


def cdr_of(schema: Schema, data: bytes) -> bytes:
    """Convert a message to the CDR bytes of sensor_msgs/MagneticField.

    Parameters
    ----------
    schema : Schema
    data : bytes
        Message in the encoding of the schema.

    Returns
    -------
    bytes
        Empty if the message cannot be decoded as a magnetic field.
    """
    try:
        return encoder(MAGNETIC_FIELD)(
            field_decoder(schema.encoding, schema.name, schema.data)(data))
    except decode_errors():
        return b''


@functools.cache
def decode_errors() -> tuple[type[Exception], ...]:
    """Exceptions that the result of `field_decoder` raises for invalid message bytes.

    Returns
    -------
    tuple of exception types
    """
    # Imported here because most recordings are CDR and do not need protobuf.
    from google.protobuf.message import DecodeError

    return (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError,
            struct.error, DecodeError)


@functools.cache
def field_decoder(encoding: str, name: str, content: bytes) -> Callable[[bytes], MessageDict]:
    """Create a decoder of magnetic fields for one schema.

    Parameters
    ----------
    encoding, name : str
        Encoding and name of the schema.
    content : bytes
        JSON schema or protobuf descriptor.

    Returns
    -------
    function
        Converts the bytes of a message to sensor_msgs/MagneticField as nested dicts. It raises
        ValueError if the message is not a magnetic field.

    Raises
    ------
    ValueError
        If a protobuf schema cannot be read.
    """
    if encoding == 'jsonschema':
        return lambda data: _field(json.loads(data, object_hook=lambda d: SimpleNamespace(**d)))
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for('protobuf', Schema(1, content, encoding, name))
    if decode is None:
        raise ValueError('the protobuf schema cannot be read')
    return lambda data: _field(decode(data))


def _field(message: Any) -> MessageDict:
    """Convert a message to sensor_msgs/MagneticField; raises ValueError for an invalid message."""
    field = getattr(message, 'magnetic_field', None)
    header = getattr(message, 'header', message)
    stamp = next((s for name in _STAMPS for s in (getattr(header, name, None),
                                                  getattr(message, name, None))
                  if s is not None), None)
    if field is None or stamp is None:
        raise ValueError('magnetic_field or timestamp is missing')
    covariance = [float(v) for v in getattr(message, 'magnetic_field_covariance', ())]
    if len(covariance) not in (0, 9):
        raise ValueError(f'magnetic_field_covariance has {len(covariance)} elements; expected 9')
    return {
        'header': {'stamp': {'sec': _time_part(stamp, _SECONDS, 2**31),
                             'nanosec': _time_part(stamp, _NANOSECONDS, 10**9)},
                   'frame_id': str(getattr(header, 'frame_id', ''))},
        'magnetic_field': {axis: _axis_value(field, axis) for axis in 'xyz'},
        'magnetic_field_covariance': covariance or [0.0] * 9}


def _time_part(stamp: Any, names: tuple[str, ...], limit: int) -> int:
    """Value of the first of the fields `names` of `stamp` that is an integer.

    Raises ValueError if there is no such field, or its value is not in [0, limit).
    """
    for name in names:
        value = getattr(stamp, name, None)
        if isinstance(value, int) and not isinstance(value, bool):
            if not 0 <= value < limit:
                raise ValueError(f'timestamp: {name} is out of range: {str(value)[:20]}')
            return int(value)
    raise ValueError(f'timestamp: {names[0]} is missing')


def _axis_value(field: Any, axis: str) -> float:
    """Field of one axis [T]; NaN for null. Raises ValueError for a missing or non-numeric axis."""
    if not hasattr(field, axis):
        raise ValueError(f'magnetic_field.{axis} is missing')
    value = getattr(field, axis)
    if value is None:
        return float('nan')
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f'magnetic_field.{axis} is not a number: {value!r}')
    return float(value)
