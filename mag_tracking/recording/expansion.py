"""Decompression with a limit on the size of the result, whatever size the data declare."""

import bz2
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.stream_reader import CRCValidationError

from mag_tracking.errors import SettingsError

DECODE_ERRORS: tuple[type[Exception], ...] = (
    McapError, CRCValidationError, ValueError, KeyError, EOFError, struct.error, zlib.error,
    zstandard.ZstdError, RuntimeError, UnicodeDecodeError, MemoryError, OverflowError)
"""Exceptions that the MCAP library and its decompressors raise for damaged bytes."""
LARGEST_CHUNK_MB = 256.0
"""Largest size of a decompressed chunk, message or record that is read [MB]."""
LARGEST_CHUNK_VARIABLE = 'MAG_TRACKING_LARGEST_CHUNK_MB'
"""Environment variable that replaces `LARGEST_CHUNK_MB`, in commands, nodes and workers."""
_STEP, _LARGE_STEP = 1 << 20, 4 << 20
"""Numbers of bytes that are decompressed at once. The larger one is for decompressors that copy
their remaining input at each step."""
_MAX_WINDOW = 64 << 20
"""Largest memory of previous output that a zstd frame may require, bytes."""
_MAGIC = {b'\x28\xb5\x2f\xfd': 'zstd', b'\x04\x22\x4d\x18': 'lz4'}


class RefusedDataError(ValueError):
    """Data that are intact, but too large or compressed in an unsupported way."""


def largest_chunk() -> int:
    """Size in bytes of the largest decompressed chunk, message or record that is read; raises
    SettingsError if the environment variable is not a positive number."""
    text = os.environ.get(LARGEST_CHUNK_VARIABLE) or str(LARGEST_CHUNK_MB)
    try:
        megabytes = float(text)
    except ValueError:
        megabytes = 0.0
    if not 0.0 < megabytes < 1e6:
        raise SettingsError(f'{LARGEST_CHUNK_VARIABLE}: expected a size in megabytes, between 0 '
                            f'and 1e6, got {text!r}')
    return int(megabytes * 1e6)


def check_size(size: int, limit: int) -> None:
    """Raise RefusedDataError if a size [bytes] exceeds the limit."""
    if size > limit:
        raise RefusedDataError(f'larger than {limit / 1e6:g} MB, the limit of '
                               f'{LARGEST_CHUNK_VARIABLE}')


def expanded(compression: str, data: bytes, limit: int, is_cut: bool = False) -> bytes:
    """Decompress data to at most `limit` bytes; raises RefusedDataError beyond it or for an unknown
    compression, and, unless `is_cut` permits a missing end, the errors for damaged data."""
    if compression in ('', 'none'):
        check_size(len(data), limit)
        return data
    if compression not in _PIECES:
        raise RefusedDataError(f'compressed with {compression!r}, which is not supported')
    # The buffer of BytesIO becomes the result without a copy.
    out = BytesIO()
    pieces = _PIECES[compression](data)
    while True:
        try:
            piece = next(pieces, b'')
        except (zstandard.ZstdError, RuntimeError, OSError, ValueError, EOFError):
            if not is_cut:
                raise
            piece = b''
        if not piece:
            return out.getvalue()
        check_size(out.tell() + len(piece), limit)
        out.write(piece)


def _zstd_pieces(data: bytes) -> Iterator[bytes]:
    with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(data) as reader:
        while piece := reader.read(_STEP):
            yield piece


def _pieces(decompressor: 'bz2.BZ2Decompressor | lz4.frame.LZ4FrameDecompressor',
            data: bytes) -> Iterator[bytes]:
    """Decompress piece by piece; raises EOFError if the end is missing."""
    while not decompressor.eof:
        piece = decompressor.decompress(data, max_length=_LARGE_STEP)
        if piece:
            yield piece
        elif not decompressor.eof:
            raise EOFError('the compressed data end too early')
        data = b''


_PIECES: dict[str, Callable[[bytes], Iterator[bytes]]] = {
    'zstd': _zstd_pieces,
    'lz4': lambda data: _pieces(lz4.frame.LZ4FrameDecompressor(), data),
    'bz2': lambda data: _pieces(bz2.BZ2Decompressor(), data)}


def expanded_message(data: bytes) -> bytes:
    """Decompress a CDR message that the recorder has compressed; empty if damaged or too large."""
    compression = _MAGIC.get(data[:4])
    if compression is None:
        return data
    try:
        return expanded(compression, data, largest_chunk())
    except DECODE_ERRORS:
        return b''
