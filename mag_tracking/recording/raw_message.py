"""Message of a recording."""

from typing import NamedTuple

from mcap.records import Schema


class RawMessage(NamedTuple):
    """Message of a recording, converted to CDR if it is stored in another encoding."""

    topic: str
    """Name of the topic."""
    type: str
    """Message type."""
    log_time_ns: int
    """Log time, ns since 1970."""
    data: bytes
    """Serialised message, CDR. Empty if the stored message cannot be converted."""
    schema: Schema
    """Schema of the message type."""
    fault: str = ''
    """Why the stored message cannot be converted. Empty if it can."""
