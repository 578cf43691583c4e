"""Magnetic fields in JSON or protobuf messages, whose schema says what is in them.

Such messages come from Foxglove's tools and from programs without ROS. A message is a magnetic
field where it has `magnetic_field` with x, y and z [T], and a time in `header.stamp`, `stamp` or
`timestamp`.
"""

import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from mcap.records import Schema

MAGNETIC_FIELD = 'sensor_msgs/msg/MagneticField'
_STAMPS = ('stamp', 'timestamp')
_SECONDS = ('sec', 'secs', 'seconds')
_NANOSECONDS = ('nanosec', 'nsec', 'nsecs', 'nanos')

SCHEMAS = ('jsonschema', 'protobuf')
"""Encodings of schemas that are read here."""


def type_of(schema: Schema) -> str:
    """The type of the messages of a schema: MagneticField where it has the fields of one."""
    is_field = schema.encoding in SCHEMAS and b'magnetic_field' in schema.data
    return MAGNETIC_FIELD if is_field else schema.name


def decoder_for(schema: Schema) -> Callable[[bytes], SimpleNamespace]:
    """Function from the bytes of a message to an object shaped like sensor_msgs/MagneticField.

    It raises ValueError where the message is none.
    """
    if schema.encoding == 'jsonschema':
        return lambda data: _field(json.loads(data, object_hook=lambda d: SimpleNamespace(**d)))
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for('protobuf', schema)
    if decode is None:
        raise ValueError('its protobuf schema cannot be read')
    return lambda data: _field(decode(data))


def _field(message: Any) -> SimpleNamespace:
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
    return SimpleNamespace(
        header=SimpleNamespace(
            stamp=SimpleNamespace(sec=_whole(stamp, _SECONDS), nanosec=_whole(stamp, _NANOSECONDS)),
            frame_id=str(getattr(header, 'frame_id', ''))),
        magnetic_field=SimpleNamespace(**{axis: _number(field, axis) for axis in 'xyz'}),
        magnetic_field_covariance=covariance or [0.0] * 9)


def _whole(stamp: Any, names: tuple[str, ...]) -> int:
    """The first of the fields `names` of a time."""
    for name in names:
        value = getattr(stamp, name, None)
        if isinstance(value, int) or isinstance(value, str) and value.isdigit():
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
