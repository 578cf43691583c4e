"""One MCAP file: read chunk by chunk, checked, and as far as it is whole."""

import heapq
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from mag_tracking.errors import RecordingError
from mag_tracking.messages.self_described import cdr_of, type_of
from mag_tracking.messages.types import schema_of
from mag_tracking.recording.damage import DAMAGE
from mag_tracking.recording.interruptible import Progress
from mag_tracking.recording.raw_message import RawMessage


class McapFile:
    """One MCAP file of a recording.

    Attributes
    ----------
    types : {topic: message type}
    message_counts : {topic: int}, empty for a file that was cut off
    start_ns, end_ns : int or None
        Log times; None where the file does not tell.
    """

    def __init__(self, path: Path, losses: 'Counter[str]') -> None:
        """`losses` {what: number} grows with what cannot be read. Raises RecordingError."""
        self.types: dict[str, str] = {}
        self.message_counts: Counter[str] = Counter()
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._path, self._losses = path, losses
        self._index = self._inspect(path)

    def _inspect(self, file: Path) -> list[ChunkIndex] | None:
        """Read topics, counts and times of one file; its chunk index, or None without one."""
        with open(file, 'rb') as stream:
            if stream.read(5) != b'\x89MCAP':
                raise RecordingError(f'{file} is not an MCAP file')
            stream.seek(0)
            try:
                summary = make_reader(stream).get_summary()
            except DAMAGE:
                summary = None
        if summary is None:
            self._losses[f'{file.name} has no usable end (cut off?): read up to the damage'] = 1
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

    def messages(self, start_ns: int | None = None,
                 progress: Progress | None = None) -> Iterator[RawMessage]:
        """Iterate over the `RawMessage`s in order of log time, where the file has an index.

        Parameters
        ----------
        start_ns : int, optional
            Chunks that end before are left out.
        progress : function, optional
            Called with the bytes done since the last call.
        """
        with open(self._path, 'rb') as stream:
            if self._index:
                yield from self._from_index(stream, self._index, start_ns, progress)
            else:
                yield from self._from_stream(stream, progress)

    def _from_index(self, stream: BinaryIO, index: list[ChunkIndex], start_ns: int | None,
                    progress: Progress | None) -> Iterator[RawMessage]:
        """Messages of an intact file, in order of log time across chunks."""
        heap: list[tuple[int, int, int, RawMessage]] = []
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        for k, entry in enumerate(index):
            if start_ns is not None and entry.message_end_time < start_ns:
                continue
            stream.seek(entry.chunk_start_offset)
            try:
                chunk = next(iter(StreamReader(stream, skip_magic=True,
                                               emit_chunks=True).records))
                if not isinstance(chunk, Chunk):
                    raise ValueError('no chunk where the index says')
                found = self._of_chunk(chunk, schemas, channels)
            except DAMAGE as error:
                self._lose_chunk(entry, error)
                found = []
            for n, message in enumerate(found):
                heapq.heappush(heap, (message.log_time_ns, k, n, message))
            if progress:
                progress(entry.chunk_length)
            horizon = index[k + 1].message_start_time if k + 1 < len(index) else None
            while heap and (horizon is None or heap[0][0] < horizon):
                yield heapq.heappop(heap)[3]

    def _lose_chunk(self, entry: ChunkIndex, error: Exception) -> None:
        """Report a chunk that cannot be read."""
        seconds = (entry.message_end_time - entry.message_start_time) / 1e9
        after = (entry.message_start_time - (self.start_ns or entry.message_start_time)) / 1e9
        self._losses[f'a damaged stretch of {seconds:.1f} s at {after:.1f} s '
                    f'({type(error).__name__})'] += 1

    def _from_stream(self, stream: BinaryIO, progress: Progress | None) -> Iterator[RawMessage]:
        """Messages in the order of the file, up to where it breaks off."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        done = 0
        try:
            for record in StreamReader(stream, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    try:
                        yield from self._of_chunk(record, schemas, channels)
                    except DAMAGE as error:
                        self._losses[f'a damaged chunk ({type(error).__name__})'] += 1
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message) and _has_schema(record, channels):
                    yield _raw(record, schemas, channels)
                if progress:
                    here = stream.tell()
                    progress(here - done)
                    done = here
        except DAMAGE as error:
            self._losses[f'{os.path.basename(stream.name)}: nothing readable after byte '
                        f'{stream.tell()} of {os.fstat(stream.fileno()).st_size} '
                        f'({type(error).__name__})'] += 1

    @staticmethod
    def _of_chunk(chunk: Chunk, schemas: dict[int, Schema],
                  channels: dict[int, Channel]) -> list[RawMessage]:
        """The messages of one chunk, sorted by log time; raises where it is damaged."""
        messages = []
        for record in breakup_chunk(chunk, validate_crc=True):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message) and _has_schema(record, channels):
                messages.append(_raw(record, schemas, channels))
        return sorted(messages, key=lambda m: m.log_time_ns)


def _has_schema(message: Message, channels: dict[int, Channel]) -> bool:
    """Whether the message has a type at all; MCAP allows channels without (id 0), ROS does not."""
    return channels[message.channel_id].schema_id != 0


def _raw(message: Message, schemas: dict[int, Schema],
         channels: dict[int, Channel]) -> RawMessage:
    """The message with its topic and type; a magnetic field in JSON or protobuf as CDR."""
    channel = channels[message.channel_id]
    schema = schemas[channel.schema_id]
    kind, data = type_of(schema), message.data
    if kind != schema.name:
        data, schema = cdr_of(schema, data), schema_of(kind)
    return RawMessage(channel.topic, kind, message.log_time, data, schema)
