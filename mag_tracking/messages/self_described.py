"""Magnetic fields in JSON or protobuf messages, which their schema describes.

Such messages come from Foxglove's tools and from programs without ROS. A message is a magnetic
field where it has `magnetic_field` with x, y and z [T], and a time in `header.stamp`, `stamp` or
`timestamp`.
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

SCHEMAS = ('jsonschema', 'protobuf')
"""Encodings of schemas that are read here."""


def type_of(schema: Schema) -> str:
    """The type of the messages of a schema: MagneticField where it has the fields of one."""
    is_field = schema.encoding in SCHEMAS and b'magnetic_field' in schema.data
    return MAGNETIC_FIELD if is_field else schema.name


def cdr_of(schema: Schema, data: bytes) -> bytes:
    """CDR bytes of sensor_msgs/MagneticField; b'' of a message that is no magnetic field."""
    try:
        return encoder(MAGNETIC_FIELD)(reader_of(schema.encoding, schema.name, schema.data)(data))
    except bad_bytes():
        return b''


@functools.cache
def bad_bytes() -> tuple[type[Exception], ...]:
    """Exceptions that invalid message bytes cause."""
    # Most recordings are CDR, and should not wait for another library.
    from google.protobuf.message import DecodeError

    return (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError,
            struct.error, DecodeError)


@functools.cache
def reader_of(encoding: str, name: str, content: bytes) -> Callable[[bytes], MessageDict]:
    """Function from the bytes of a message to sensor_msgs/MagneticField as nested dicts.

    Parameters
    ----------
    encoding, name, content : str, str, bytes
        Of the schema.

    Returns
    -------
    function
        It raises ValueError where the message is no magnetic field.
    """
    if encoding == 'jsonschema':
        return lambda data: _field(json.loads(data, object_hook=lambda d: SimpleNamespace(**d)))
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for('protobuf', Schema(1, content, encoding, name))
    if decode is None:
        raise ValueError('its protobuf schema cannot be read')
    return lambda data: _field(decode(data))


def _field(message: Any) -> MessageDict:
    """The message as sensor_msgs/MagneticField; raises ValueError."""
    field = getattr(message, 'magnetic_field', None)
    header = getattr(message, 'header', message)
    stamp = next((s for name in _STAMPS for s in (getattr(header, name, None),
                                                  getattr(message, name, None))
                  if s is not None), None)
    if field is None or stamp is None:
        raise ValueError('it has no magnetic_field, or no time')
    covariance = [float(v) for v in getattr(message, 'magnetic_field_covariance', ())]
    if len(covariance) not in (0, 9):
        raise ValueError(f'its covariance has {len(covariance)} elements, not 9')
    return {
        'header': {'stamp': {'sec': _whole(stamp, _SECONDS, 2**31),
                             'nanosec': _whole(stamp, _NANOSECONDS, 10**9)},
                   'frame_id': str(getattr(header, 'frame_id', ''))},
        'magnetic_field': {axis: _number(field, axis) for axis in 'xyz'},
        'magnetic_field_covariance': covariance or [0.0] * 9}


def _whole(stamp: Any, names: tuple[str, ...], limit: int) -> int:
    """The first of the fields `names` of a time, below `limit`. Raises ValueError."""
    for name in names:
        value = getattr(stamp, name, None)
        if isinstance(value, int) and not isinstance(value, bool):
            if not 0 <= value < limit:
                raise ValueError(f'its time has {name} = {str(value)[:20]}')
            return int(value)
    raise ValueError(f'its time has no {names[0]}')


def _number(field: Any, axis: str) -> float:
    """[T] of one axis; null = NaN, not measured. Raises ValueError where it is missing."""
    if not hasattr(field, axis):
        raise ValueError(f'its magnetic_field has no {axis}')
    value = getattr(field, axis)
    if value is None:
        return float('nan')
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f'its magnetic_field.{axis} is {value!r}')
    return float(value)
