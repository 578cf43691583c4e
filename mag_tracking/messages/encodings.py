"""Encodings of recorded messages: their names, and conversion to CDR."""

import struct

from mcap.records import Schema

from mag_tracking.messages.definitions import DEFINITIONS
from mag_tracking.messages.ros1 import cdr_of_ros1
from mag_tracking.messages.self_described import (
    SELF_DESCRIBED,
    UNDECODABLE,
    cdr_of_self_described,
)
from mag_tracking.messages.types import MAGNETIC_FIELD

CDR = 'cdr'
"""Encoding of ROS 2 messages in MCAP files."""
ROS1 = 'ros1'
"""Encoding of ROS 1 messages in MCAP files."""
_XCDR2 = (6, 7)
"""Second byte of a message in XCDR2 of plain types, big and little endian."""
_ENCAPSULATIONS = {2: 'CDR with parameter lists', 3: 'CDR with parameter lists', 6: 'XCDR2',
                   7: 'XCDR2', 8: 'XCDR2 with delimiters', 9: 'XCDR2 with delimiters',
                   10: 'XCDR2 with parameter lists', 11: 'XCDR2 with parameter lists'}
"""Encodings that DDS may use in place of plain CDR, by the second byte of a message (DDS-XTypes
1.3, table 60)."""
_FIELD_DOUBLES = 12
"""Number of float64 values in a MagneticField: x, y, z and the covariance."""


def type_of(encoding: str, schema: Schema) -> str:
    """Message type of a channel.

    It is the name of the ROS 2 type if messages can be converted to it, otherwise the name of the
    schema with the encoding, such as 'std_msgs/msg/String (json)'.
    """
    name = _ros2_name(schema.name)
    if encoding == CDR:
        return name
    if encoding in SELF_DESCRIBED and (name == MAGNETIC_FIELD or b'magnetic_field' in schema.data):
        return MAGNETIC_FIELD
    if encoding == ROS1 and name in DEFINITIONS:
        return name
    return f'{schema.name or "no schema"} ({encoding or "no encoding"})'


def _ros2_name(name: str) -> str:
    """Name of a type as in ROS 2, from that name or the names in ROS 1 and in IDL."""
    parts = name.replace('::', '/').split('/')
    return '/'.join((parts[0], 'msg', parts[1]) if len(parts) == 2 else parts)


def cdr_of(encoding: str, kind: str, schema: Schema, data: bytes) -> tuple[bytes, str]:
    """Convert a message of a `kind` from `type_of` to plain CDR, or return the reason why not.

    Of the two results, data and fault, one is empty.
    """
    if encoding in SELF_DESCRIBED and kind == MAGNETIC_FIELD:
        return cdr_of_self_described(encoding, schema, data)
    if encoding == ROS1:
        data = cdr_of_ros1(data, kind)
    elif encoding != CDR:
        return b'', f'message in the encoding {encoding or "(none)"}'
    elif len(data) > 1 and data[1] in _ENCAPSULATIONS:
        if kind != MAGNETIC_FIELD or data[1] not in _XCDR2:
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
