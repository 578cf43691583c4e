"""Conversion of ROS 1 messages to CDR, with the library `rosbags`."""

import dataclasses
import functools
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.messages.definitions import DEFINITIONS
from mag_tracking.messages.types import encoder

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


def cdr_of_ros1(data: bytes, type_name: str) -> bytes:
    """Convert a serialised ROS 1 message to CDR; empty if damaged or of an unsupported type.

    `type_name` is the name of the type in ROS 2.
    """
    if type_name not in DEFINITIONS:
        return b''
    try:
        message = _ros1_types().deserialize_ros1(data, type_name)
    except _decode_errors():
        return b''
    return encoder(type_name)(_as_dicts(message))


@functools.cache
def _decode_errors() -> tuple[type[Exception], ...]:
    """Exceptions that `rosbags` raises for damaged messages."""
    from rosbags.serde import SerdeError

    # Damaged bytes can also trigger assertions of the library, and too large or invalid strings.
    return (SerdeError, AssertionError, IndexError, KeyError, TypeError, ValueError, OverflowError,
            MemoryError, struct.error)


@functools.cache
def _ros1_types() -> 'Typestore':
    """Definitions of the ROS 1 message types, for `rosbags`."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)


def _as_dicts(value: Any) -> Any:
    """Convert a message to nested dicts."""
    if dataclasses.is_dataclass(value):
        return {f.name: _as_dicts(getattr(value, f.name)) for f in dataclasses.fields(value)
                if not f.name.startswith('__')}
    return value.tolist() if isinstance(value, np.ndarray) else value
