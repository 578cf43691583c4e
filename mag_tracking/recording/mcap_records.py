"""Records of an MCAP file: their positions, the summary, and the content of chunks.

Reference: MCAP format specification, version 0.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.summary import Summary

from mag_tracking.recording.decode_errors import DECODE_ERRORS
from mag_tracking.recording.expansion import check_size, expanded

MAGIC = b'\x89MCAP0\r\n'
"""First and last bytes of a file."""
MIN_BYTES_PER_MESSAGE = 128
"""The largest number of messages in a chunk is its largest size divided by this number, because
the position of each message also takes memory."""
RECORD_HEADER = struct.Struct('<BQ')
"""Operation code and length of the content of a record."""
_FOOTER = struct.Struct('<BQQQI8s')
"""Record `Footer` (operation code, length, start of summary and of summary offsets, CRC) and
`MAGIC`."""
_CHUNK_HEADER = struct.Struct('<QQQII')
"""Times of the first and last message [ns], uncompressed size, CRC, length of the compression."""
_MAX_NAME = 64
"""Largest accepted length of the name of a compression."""
_CRC_STEP = 1 << 20


class Record(NamedTuple):
    """Position of a record in a file."""

    opcode: int
    begin: int
    """Offset of the operation code, bytes."""
    end: int
    """Offset after the record, bytes. Beyond the end of the file for a truncated record."""


def file_size(stream: BinaryIO) -> int:
    """Size of an open file in bytes."""
    return os.fstat(stream.fileno()).st_size


def records(stream: BinaryIO, begin: int, end: int) -> Iterator[Record]:
    """Iterate over the positions of records without reading their content.

    It ends at the offset `end` or after a record that exceeds it.
    """
    while begin + RECORD_HEADER.size <= end:
        stream.seek(begin)
        opcode, length = RECORD_HEADER.unpack(stream.read(RECORD_HEADER.size))
        record = Record(opcode, begin, begin + RECORD_HEADER.size + length)
        yield record
        begin = record.end


class ChunkHeader(NamedTuple):
    """Fields of a chunk before its content."""

    start_ns: int
    """Log time of the first message [ns]."""
    end_ns: int
    """Log time of the last message [ns]."""
    uncompressed_size: int
    """Declared size of the content, bytes."""
    crc: int
    """CRC of the content; 0 if unknown."""
    compression: str
    size: int
    """Size of the compressed content, bytes."""


def chunk_header(stream: BinaryIO, chunk: Record) -> ChunkHeader:
    """Read the header of a chunk, up to the beginning of its content.

    Raises ValueError if there is no intact header, EOFError if the content is longer than the
    chunk.
    """
    stream.seek(chunk.begin)
    opcode, length = RECORD_HEADER.unpack(stream.read(RECORD_HEADER.size))
    if opcode != Opcode.CHUNK or chunk.begin + RECORD_HEADER.size + length != chunk.end:
        raise ValueError('no chunk at the indexed offset')
    start_ns, end_ns, uncompressed, crc, name_length = _CHUNK_HEADER.unpack(
        stream.read(_CHUNK_HEADER.size))
    if name_length > _MAX_NAME:
        raise ValueError('the name of the compression is too long')
    compression = stream.read(name_length).decode()
    (size,) = struct.unpack('<Q', stream.read(8))
    if stream.tell() + size > chunk.end:
        raise EOFError('the content exceeds its chunk')
    return ChunkHeader(start_ns, end_ns, uncompressed, crc, compression, size)


def chunk_content(stream: BinaryIO, chunk: Record, limit: int) -> bytes:
    """Read and decompress the records in a chunk, at most `limit` bytes.

    Of a chunk beyond the end of the file, the part that was written is read without checking the
    CRC, which covers the whole. Raises one of DECODE_ERRORS if the chunk is damaged,
    RefusedDataError if it is too large or has an unsupported compression.
    """
    is_cut = chunk.end > file_size(stream)
    header = chunk_header(stream, chunk)
    check_size(min(header.size, file_size(stream) - stream.tell()), limit)
    data = expanded(header.compression, stream.read(header.size), limit, is_cut)
    if header.crc and not is_cut and zlib.crc32(data) != header.crc:
        raise ValueError('the CRC of the chunk is wrong')
    return data


def has_footer(stream: BinaryIO) -> bool:
    """Whether a file is complete: it ends with a footer, with or without a summary."""
    return _footer(stream) is not None


def _footer(stream: BinaryIO) -> tuple[int, int] | None:
    """Return the offset of the summary (0 if there is none) and its CRC (0 if unknown)."""
    size = file_size(stream)
    if size < len(MAGIC) + _FOOTER.size:
        return None
    stream.seek(size - _FOOTER.size)
    opcode, length, start, _, crc, magic = _FOOTER.unpack(stream.read(_FOOTER.size))
    is_valid = opcode == Opcode.FOOTER and length == 20 and magic == MAGIC
    return (start, crc) if is_valid else None


def read_summary(stream: BinaryIO) -> Summary | None:
    """Read the summary of a file; None if it is missing or damaged."""
    start, crc = _footer(stream) or (0, 0)
    if start == 0:
        return None
    try:
        if crc:
            _check_crc(stream, start, crc)
        stream.seek(0)
        return make_reader(stream).get_summary()
    except DECODE_ERRORS:
        return None


def _check_crc(stream: BinaryIO, start: int, crc: int) -> None:
    """Check the CRC of the summary from byte `start`; raises ValueError."""
    # The CRC covers the summary and the footer up to the CRC itself.
    remaining, found = file_size(stream) - 12 - start, 0
    stream.seek(start)
    while remaining > 0:
        data = stream.read(min(remaining, _CRC_STEP))
        found, remaining = zlib.crc32(data, found), remaining - len(data)
    if found != crc:
        raise ValueError('the CRC of the summary is wrong')


