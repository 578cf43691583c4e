"""A message as stored in a recording."""

from typing import NamedTuple

from mcap.records import Schema


class RawMessage(NamedTuple):
    """One message as stored in the file."""

    topic: str
    """Name of the topic."""
    type: str
    """Message type."""
    log_time_ns: int
    """Log time, ns since 1970."""
    data: bytes
    """Serialised message, CDR."""
    schema: Schema
    """Schema of the message type."""
