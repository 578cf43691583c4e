"""Reader of one MCAP file, which checks each chunk and skips damaged chunks.

Reference: MCAP format specification, version 0.
"""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Schema, Statistics
from mcap.summary import Summary

from mag_tracking.arrays import IntArray
from mag_tracking.errors import RecordingError
from mag_tracking.messages.encodings import type_of
from mag_tracking.recording import core, expansion
from mag_tracking.recording.message_block import ChannelKind, MessageBlock, Progress, RecordingFile
from mag_tracking.units import LATEST_NS

MAGIC = b'\x89MCAP0\r\n'
MIN_BYTES_PER_MESSAGE = 128
"""The largest number of messages in a chunk is its largest size divided by this number, because
the position of each message also takes memory."""
RECORD_HEADER = struct.Struct('<BQ')
"""Operation code and length of the content of a record."""
_FOOTER = struct.Struct('<BQQQI8s')
"""Record `Footer` (code, length, start of summary and of summary offsets, CRC) and `MAGIC`."""
_CHUNK_HEADER = struct.Struct('<QQQII')
"""Times of the first and last message [ns], uncompressed size, CRC, length of the compression."""
_MAX_NAME = 64
_CRC_STEP = 1 << 20
CONTENT = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
"""Operation codes of the records in a chunk, which may also be outside of chunks."""
MAX_MERGED_SIZE = 64 << 20
"""Size of a chunk above which its messages are not sorted among those of other chunks, because
that takes several times the memory [bytes]."""
UNCHUNKED_SIZE = 1 << 20
"""Number of bytes of consecutive records outside of chunks that are read at once."""


class Record(NamedTuple):
    """Position of a record in a file."""

    opcode: int
    begin: int
    end: int
    """Offset after the record, bytes. Beyond the end of the file for a truncated record."""


def file_size(stream: BinaryIO) -> int:
    """Size of an open file in bytes."""
    return os.fstat(stream.fileno()).st_size


def records(stream: BinaryIO, begin: int, end: int) -> Iterator[Record]:
    """Iterate over the positions of records up to the offset `end`, or a record that exceeds it."""
    while begin + RECORD_HEADER.size <= end:
        stream.seek(begin)
        opcode, length = RECORD_HEADER.unpack(stream.read(RECORD_HEADER.size))
        record = Record(opcode, begin, begin + RECORD_HEADER.size + length)
        yield record
        begin = record.end


class ChunkHeader(NamedTuple):
    """Fields of a chunk before its content."""

    start_ns: int
    end_ns: int
    crc: int
    """CRC of the content; 0 if unknown."""
    compression: str
    size: int
    """Size of the compressed content, bytes."""


def chunk_header(stream: BinaryIO, chunk: Record) -> ChunkHeader:
    """Read the header of a chunk, up to its content; raises ValueError or EOFError if damaged."""
    stream.seek(chunk.begin)
    opcode, length = RECORD_HEADER.unpack(stream.read(RECORD_HEADER.size))
    if opcode != Opcode.CHUNK or chunk.begin + RECORD_HEADER.size + length != chunk.end:
        raise ValueError('no chunk at the indexed offset')
    start_ns, end_ns, _, crc, name_length = _CHUNK_HEADER.unpack(
        stream.read(_CHUNK_HEADER.size))
    if name_length > _MAX_NAME:
        raise ValueError('the name of the compression is too long')
    compression = stream.read(name_length).decode()
    (size,) = struct.unpack('<Q', stream.read(8))
    if stream.tell() + size > chunk.end:
        raise EOFError('the content exceeds its chunk')
    return ChunkHeader(start_ns, end_ns, crc, compression, size)


def chunk_content(stream: BinaryIO, chunk: Record, limit: int) -> bytes:
    """Read and decompress the records in a chunk, at most `limit` bytes.

    Of a chunk beyond the end of the file, the part that was written is read without checking the
    CRC, which covers the whole. Raises one of DECODE_ERRORS, also RefusedDataError.
    """
    is_cut = chunk.end > file_size(stream)
    header = chunk_header(stream, chunk)
    expansion.check_size(min(header.size, file_size(stream) - stream.tell()), limit)
    data = expansion.expanded(header.compression, stream.read(header.size), limit, is_cut)
    if header.crc and not is_cut and zlib.crc32(data) != header.crc:
        raise ValueError('the CRC of the chunk is wrong')
    return data


def definitions_of(data: bytes, places: Iterable[tuple[int, int, int]]
                   ) -> Iterator[Schema | Channel]:
    """Schemas and channels at the `places` (opcode, begin, end) in the records of a chunk."""
    for opcode, begin, end in places:
        kind: type[Schema] | type[Channel] = Schema if opcode == Opcode.SCHEMA else Channel
        yield kind.read(ReadDataStream(BytesIO(data[begin:end])))


def _footer(stream: BinaryIO) -> tuple[int, int] | None:
    """Return the offset of the summary (0 without one) and its CRC (0 if unknown); None if the
    file is incomplete: it does not end with a footer."""
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
    except expansion.DECODE_ERRORS:
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


class _Part(NamedTuple):
    """Part of a file that is read at once: a chunk, or consecutive records outside of chunks."""

    record: Record
    """Position. The operation code is that of the first record."""
    start_ns: int
    end_ns: int


class McapFile(RecordingFile):
    """Reader of one MCAP file of a recording; raises RecordingError for another kind of file.

    Schemas and channels are those of the summary and of the parts that were read. A file without a
    summary is read once when it is opened, to find its topics and chunks.
    """

    def __init__(self, path: Path, losses: 'Counter[str]') -> None:
        super().__init__(path, losses)
        self._limit = expansion.largest_chunk()
        self._channels, self._counts = _Channels(), Counter[int]()
        self._parts: list[_Part] = []
        with open(path, 'rb') as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                raise RecordingError(f'{path} is not an MCAP file')
            summary = read_summary(stream)
            if summary is None and _footer(stream) is None:
                self._losses[f'files without a valid index ({path.name}, possibly truncated)'] = 1
            self._inspect(stream, summary or Summary())
        self._parts.sort(key=lambda part: part.start_ns)
        self.types = {kind.topic: kind.type for kind in self._channels.kinds.values()}

    def _inspect(self, stream: BinaryIO, summary: Summary) -> None:
        """Find the parts of the file, the topics, the message counts and the times."""
        for schema in summary.schemas.values():
            self._channels.add(schema)
        for channel in summary.channels.values():
            self._channels.add(channel)
        statistics = summary.statistics
        indexed = sorted(summary.chunk_indexes, key=lambda entry: entry.chunk_start_offset)
        ends = [len(MAGIC), *(entry.chunk_start_offset + entry.chunk_length for entry in indexed)]
        # A summary may omit channels and schemas; they are then read from the chunks. Those of a
        # valid index lie in the file, one after the other.
        if len(self._channels.kinds) < (statistics.channel_count if statistics else 1) \
                or ends[-1] > file_size(stream) or any(
                    entry.chunk_start_offset < end
                    for entry, end in zip(indexed, ends, strict=False)):
            indexed = []
        position = len(MAGIC)
        for entry in indexed:
            begin = entry.chunk_start_offset
            self._scan(stream, position, begin)
            self._parts.append(_Part(Record(Opcode.CHUNK, begin, begin + entry.chunk_length),
                                     min(entry.message_start_time, LATEST_NS),
                                     min(entry.message_end_time, LATEST_NS)))
            position = begin + entry.chunk_length + entry.message_index_length
        self._scan(stream, position, file_size(stream))
        self._set_counts(statistics, not indexed)

    def _set_counts(self, statistics: Statistics | None, is_scanned: bool) -> None:
        """Set message counts and times from the statistics of the summary, or from the scan."""
        counts: dict[int, int] = dict(self._counts) if is_scanned else {}
        if self._parts:
            self.start_ns = min(part.start_ns for part in self._parts)
            self.end_ns = max(part.end_ns for part in self._parts)
        if statistics and statistics.message_count:
            counts = statistics.channel_message_counts or counts
            self.start_ns = statistics.message_start_time
            self.end_ns = statistics.message_end_time
        for channel, n in counts.items():
            if channel in self._channels.kinds:
                self.message_counts[self._channels.kinds[channel].topic] += n

    def _scan(self, stream: BinaryIO, begin: int, end: int) -> None:
        """Find the parts between two offsets that the index does not contain, up to the end of the
        data section or the first record that is cut or invalid, which counts as a loss."""
        run: Record | None = None
        for record in records(stream, begin, end):
            begin = record.begin
            is_valid = record.end <= end and record.opcode != 0
            in_run = is_valid and record.opcode in CONTENT
            if run and (not in_run or record.end - run.begin > UNCHUNKED_SIZE):
                self._add_scanned(stream, run)
                run = None
            if record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            if record.opcode == Opcode.CHUNK:
                self._add_scanned(stream, record)
            elif in_run:
                run = (run or record)._replace(end=record.end)
            if not is_valid:
                break
            begin = record.end
        if run:
            self._add_scanned(stream, run)
        if begin < end:
            self._count_loss(begin, f'partially read files ({self._path.name}, up to byte '
                                    f'{begin} of {end})')

    def _add_scanned(self, stream: BinaryIO, record: Record) -> None:
        """Read a part for the first time; add it if it contains messages."""
        try:
            _, rows = self._read(stream, record)
        except expansion.DECODE_ERRORS as error:
            if record.end <= file_size(stream):
                self._count_loss(record.begin,
                                 f'damaged chunks ({self._path.name}{_reason(error)})')
            return
        if len(rows):
            self._parts.append(_Part(record, int(rows[:, 1].min()), int(rows[:, 1].max())))
            self._counts.update(sorted(rows[:, 0].tolist()))

    def _read(self, stream: BinaryIO, record: Record) -> tuple[bytes, IntArray]:
        """Read the records of a part: their bytes and the rows of its messages; raises one of
        `DECODE_ERRORS` if it is damaged."""
        if record.opcode == Opcode.CHUNK:
            data = chunk_content(stream, record, self._limit)
        else:
            expansion.check_size(record.end - record.begin, self._limit)
            stream.seek(record.begin)
            data = stream.read(record.end - record.begin)
        rows, definitions, end = core.records_of(data, LATEST_NS,
                                                 self._limit // MIN_BYTES_PER_MESSAGE)
        if end < len(data) and record.end <= file_size(stream):
            raise EOFError('the chunk ends within a record')
        for definition in definitions_of(data, definitions):
            self._channels.add(definition)
        return data, rows

    def blocks(self, start_ns: int | None = None,
               progress: Progress | None = None) -> Iterator[MessageBlock]:
        """Iterate over the chunks by log time, without those that end before `start_ns`."""
        pending = MessageBlock.of_messages([])
        parts = [p for p in self._parts if start_ns is None or p.end_ns >= start_ns]
        starts = [p.start_ns for p in parts[1:]]
        with open(self._path, 'rb') as stream:
            for part, next_start_ns in zip(parts, [*starts, LATEST_NS + 1], strict=False):
                try:
                    block = self._block(stream, part.record)
                except expansion.DECODE_ERRORS as error:
                    self._count_lost_part(part, error)
                    block = MessageBlock.of_messages([])
                if progress:
                    progress(min(part.record.end, file_size(stream)) - part.record.begin)
                if len(block.data) > MAX_MERGED_SIZE:
                    yield pending
                    pending, next_start_ns = block, LATEST_NS + 1
                else:
                    pending = pending.merged(block)
                n = int(np.searchsorted(pending.log_time_ns, next_start_ns))
                block, pending = pending.part(slice(n)), pending.part(slice(n, None)).compacted()
                yield block
                # The bytes of this chunk are freed before the next chunk is read.
                del block

    def _block(self, stream: BinaryIO, record: Record) -> MessageBlock:
        """Read the messages of a part, except those whose channel or schema is not defined."""
        data, rows = self._read(stream, record)
        undefined = np.setdiff1d(rows[:, 0], list(self._channels.kinds))
        if len(undefined):
            is_undefined = np.isin(rows[:, 0], undefined)
            self._count_loss(record.begin, f'messages of undefined channels ({self._path.name}, '
                             'defined in a damaged part)', int(is_undefined.sum()))
            rows = rows[~is_undefined]
        return MessageBlock.of_rows(data, self._channels.kinds, rows)

    def _count_lost_part(self, part: _Part, error: Exception) -> None:
        duration_s = (part.end_ns - part.start_ns) / 1e9
        start_s = (part.start_ns - (self.start_ns or part.start_ns)) / 1e9
        self._count_loss(part.record.begin, f'damaged segments ({self._path.name}, '
                         f'{duration_s:.1f} s long, {start_s:.1f} s after the start'
                         f'{_reason(error)})')


def _reason(error: Exception) -> str:
    """Format why an intact chunk is not read; empty for a damaged chunk."""
    return f', {error}' if isinstance(error, expansion.RefusedDataError) else ''


class _Channels:
    """Schemas and channels that have been read from a file; `kinds` by number of the channel."""

    def __init__(self) -> None:
        self._schemas: dict[int, Schema] = {0: Schema(id=0, data=b'', encoding='', name='')}
        self._waiting: dict[int, list[Channel]] = {}
        self.kinds: dict[int, ChannelKind] = {}

    def add(self, record: Schema | Channel) -> None:
        """Add a schema or a channel. A channel is defined when its schema is."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record
            for channel in self._waiting.pop(record.id, ()):
                self.add(channel)
        elif record.schema_id in self._schemas:
            encoding, schema = record.message_encoding, self._schemas[record.schema_id]
            self.kinds[record.id] = ChannelKind(
                record.topic, type_of(encoding, schema), schema, encoding)
        else:
            self._waiting.setdefault(record.schema_id, []).append(record)
