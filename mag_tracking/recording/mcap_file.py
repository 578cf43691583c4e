"""Reader of one MCAP file, which checks each chunk and skips damaged chunks."""

import os
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from mag_tracking.errors import RecordingError
from mag_tracking.messages.self_described import type_of
from mag_tracking.recording import core
from mag_tracking.recording.decode_errors import DECODE_ERRORS
from mag_tracking.recording.interruptible import Progress
from mag_tracking.recording.message_block import ChannelKind, MessageBlock
from mag_tracking.units import LATEST_NS

BATCH_SIZE = 256
"""Maximum number of messages outside of chunks that are read at once."""
_DEFINITION_TYPES: dict[int, type[Schema] | type[Channel]] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}


class McapFile:
    """Reader of one MCAP file of a recording.

    Parameters
    ----------
    path : Path
    losses : Counter
        Number of unreadable parts by description, updated in place.

    Attributes
    ----------
    types : dict of str to str
        Message type by topic.
    message_counts : Counter
        Number of messages by topic. Empty for a truncated file.
    start_ns, end_ns : int, ns, or None
        Log times of the first and last message. None if unknown.

    Raises
    ------
    RecordingError
        If the file is not an MCAP file.
    """

    def __init__(self, path: Path, losses: 'Counter[str]') -> None:
        self.types: dict[str, str] = {}
        self.message_counts: Counter[str] = Counter()
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._path, self._losses = path, losses
        self._lost_offsets: set[int] = set()
        self._index = self._inspect(path)

    def _inspect(self, file: Path) -> list[ChunkIndex] | None:
        """Read topics, message counts and times; return the chunk index, or None if there is no
        index."""
        with open(file, 'rb') as stream:
            if stream.read(5) != b'\x89MCAP':
                raise RecordingError(f'{file} is not an MCAP file')
            stream.seek(0)
            try:
                summary = make_reader(stream).get_summary()
            except DECODE_ERRORS:
                summary = None
            except OSError:
                # A file of a few bytes has no valid position of the footer.
                summary = None
        if summary is None:
            self._losses[f'files without a valid index ({file.name}, possibly truncated)'] = 1
            return None
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            self.types[channel.topic] = type_of(schema) if schema else ''
        statistics = summary.statistics
        if statistics and statistics.message_count:
            for i, n in statistics.channel_message_counts.items():
                if i in summary.channels:
                    self.message_counts[summary.channels[i].topic] += n
            self.start_ns = statistics.message_start_time
            self.end_ns = statistics.message_end_time
        return sorted(summary.chunk_indexes, key=lambda c: c.message_start_time)

    def blocks(self, start_ns: int | None = None,
               progress: Progress | None = None) -> Iterator[MessageBlock]:
        """Iterate over the messages chunk by chunk, in order of log time if the file has an index.

        Parameters
        ----------
        start_ns : int, ns, optional
            Skip chunks that end earlier, if the file has an index.
        progress : callable, optional
            Called with the number of bytes read since the last call.

        Yields
        ------
        MessageBlock
        """
        with open(self._path, 'rb') as stream:
            if self._index:
                yield from self._indexed_blocks(stream, self._index, start_ns, progress)
            else:
                yield from self._streamed_blocks(stream, progress)

    def _indexed_blocks(self, stream: BinaryIO, index: list[ChunkIndex], start_ns: int | None,
                        progress: Progress | None) -> Iterator[MessageBlock]:
        """Iterate over the messages of a file with an index, in order of log time across chunks."""
        channels = _Channels()
        pending = MessageBlock.of_messages([])
        for k, entry in enumerate(index):
            if start_ns is not None and entry.message_end_time < start_ns:
                continue
            stream.seek(entry.chunk_start_offset)
            try:
                chunk = next(iter(StreamReader(stream, skip_magic=True,
                                               emit_chunks=True).records))
                if not isinstance(chunk, Chunk):
                    raise ValueError('no chunk at the indexed offset')
                pending = pending.merged(channels.block_of(chunk))
            except DECODE_ERRORS:
                self._count_lost_chunk(entry)
            if progress:
                progress(entry.chunk_length)
            n = len(pending)
            if k + 1 < len(index):
                n = int(np.searchsorted(pending.log_time_ns, index[k + 1].message_start_time))
            yield pending.part(slice(n))
            pending = pending.part(slice(n, None))
        yield pending

    def _count_lost_chunk(self, entry: ChunkIndex) -> None:
        """Count an unreadable chunk as a loss, described by its duration and start time."""
        duration_s = (entry.message_end_time - entry.message_start_time) / 1e9
        start_s = (entry.message_start_time - (self.start_ns or entry.message_start_time)) / 1e9
        self._count_loss(entry.chunk_start_offset, f'damaged segments ({self._path.name}, '
                         f'{duration_s:.1f} s long, {start_s:.1f} s after the start)')

    def _count_loss(self, offset: int, description: str) -> None:
        """Count the unreadable part at byte `offset`, unless it has already been counted."""
        if offset not in self._lost_offsets:
            self._lost_offsets.add(offset)
            self._losses[description] += 1

    def _streamed_blocks(self, stream: BinaryIO, progress: Progress | None
                         ) -> Iterator[MessageBlock]:
        """Iterate over the messages in file order, up to the first damage outside of a chunk."""
        channels, unchunked = _Channels(), _UnchunkedMessages()
        end = 0
        try:
            for record in StreamReader(stream, emit_chunks=True).records:
                record_end = stream.tell()
                if isinstance(record, Chunk):
                    yield from unchunked.flush(channels)
                    try:
                        yield channels.block_of(record)
                    except DECODE_ERRORS:
                        self._count_loss(end, f'damaged chunks ({self._path.name})')
                elif isinstance(record, Schema | Channel):
                    channels.add(record)
                elif isinstance(record, Message) and channels.has_schema(record.channel_id):
                    unchunked.add(record)
                    if len(unchunked) >= BATCH_SIZE:
                        yield from unchunked.flush(channels)
                if progress:
                    progress(record_end - end)
                end = record_end
            yield from unchunked.flush(channels)
        except DECODE_ERRORS:
            yield from unchunked.flush(channels)
            size = os.fstat(stream.fileno()).st_size
            # A file that ends after a complete record only lacks its index.
            if end < size:
                self._count_loss(end, f'partially read files ({self._path.name}, up to byte {end} '
                                      f'of {size})')


class _UnchunkedMessages:
    """Buffer that collects messages outside of chunks into blocks, which are faster to process."""

    def __init__(self) -> None:
        self._messages: list[Message] = []

    def __len__(self) -> int:
        return len(self._messages)

    def add(self, message: Message) -> None:
        """Add a message."""
        self._messages.append(message)

    def flush(self, channels: '_Channels') -> Iterator[MessageBlock]:
        """Yield the buffered messages as one block, if there are any, and empty the buffer."""
        messages, self._messages = self._messages, []
        if not messages:
            return
        ends = list(accumulate(len(m.data) for m in messages))
        rows = np.array([(m.channel_id, min(m.log_time, LATEST_NS), end - len(m.data), end)
                         for m, end in zip(messages, ends, strict=True)], dtype=np.int64)
        yield MessageBlock.of_rows(b''.join(m.data for m in messages), dict(channels.kinds), rows)


class _Channels:
    """Schemas and channels that have been read from a file."""

    def __init__(self) -> None:
        self._schemas: dict[int, Schema] = {}
        self._schema_of: dict[int, int] = {}
        self.kinds: dict[int, ChannelKind] = {}

    def add(self, record: Schema | Channel) -> None:
        """Add a schema or a channel; raises KeyError if the schema of a channel is unknown."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        else:
            self._schema_of[record.id] = record.schema_id
            if record.schema_id:
                self.kinds[record.id] = ChannelKind.of(record.topic,
                                                       self._schemas[record.schema_id])

    def has_schema(self, channel: int) -> bool:
        """Whether a channel has a schema; raises KeyError for an unknown channel.

        MCAP permits channels without a schema (id 0); ROS does not.
        """
        return self._schema_of[channel] != 0

    def block_of(self, chunk: Chunk) -> MessageBlock:
        """Read the messages of one chunk; raises one of `DECODE_ERRORS` if the chunk is damaged."""
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(size)
        rows, definitions = core.records_of(data, LATEST_NS)
        for kind, begin, end in definitions:
            self.add(_DEFINITION_TYPES[kind].read(ReadDataStream(BytesIO(data[begin:end]))))
        untyped = [c for c in np.unique(rows[:, 0]).tolist() if not self.has_schema(c)]
        if untyped:
            rows = rows[~np.isin(rows[:, 0], untyped)]
        return MessageBlock.of_rows(data, self.kinds, rows)
