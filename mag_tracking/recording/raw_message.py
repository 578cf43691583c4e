"""A message as it is in a recording."""

from typing import NamedTuple

from mcap.records import Schema


class RawMessage(NamedTuple):
    """One message as it is in the file."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes
    schema: Schema
