"""Exceptions that the MCAP library and its decompressors raise for damaged bytes."""

import struct
import zlib

import zstandard
from mcap.exceptions import McapError
from mcap.stream_reader import CRCValidationError

DECODE_ERRORS: tuple[type[Exception], ...] = (
    McapError, CRCValidationError, ValueError, KeyError, EOFError, struct.error, zlib.error,
    zstandard.ZstdError, RuntimeError, UnicodeDecodeError, MemoryError, OverflowError)
