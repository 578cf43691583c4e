"""The bytes of messages, compiled; `types.py` says what it is for."""

from collections.abc import Sequence
from typing import Any

SEQUENCE: int
"""The length of an array that says it itself."""
ONE: int
"""The length of what is no array."""

class Encoder:
    """Function from the messages of one type, as nested dicts, to CDR bytes."""

    def __init__(self, fields: Sequence[tuple[str, int, str | Encoder, Any]]) -> None:
        """Of each field the name, the length of an array, the type and the default or None."""
    def __call__(self, message: dict[str, Any]) -> bytes:
        """Raises ValueError, which names the field, TypeError or OverflowError where it does not
        fit the type."""
