"""Encoding of messages as CDR bytes, compiled; used by `types.py`."""

from collections.abc import Sequence
from typing import Any

SEQUENCE: int
"""Length of an array of variable size."""
ONE: int
"""Length of a field that is not an array."""

class Encoder:
    """Encoder from nested dicts to the CDR bytes of one message type.

    Parameters
    ----------
    fields : sequence of (str, int, str or Encoder, object)
        Name; array length, `SEQUENCE` or `ONE`; built-in type or encoder of the contained message;
        default (None selects zero or empty).
    """

    def __init__(self, fields: Sequence[tuple[str, int, str | Encoder, Any]]) -> None: ...
    def __call__(self, message: dict[str, Any]) -> bytes:
        """Encode a message.

        Parameters
        ----------
        message : dict
            Nested dicts of the fields; missing fields get their defaults.

        Returns
        -------
        bytes

        Raises
        ------
        ValueError
            If a value is out of range or an array has the wrong length. The message names the
            field.
        TypeError
            If a value has the wrong type.
        OverflowError
            If a number exceeds 64 bits or the range of a float.
        """
