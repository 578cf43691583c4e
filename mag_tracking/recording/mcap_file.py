"""One MCAP file: read chunk by chunk, checked, and as far as it is whole."""

import os
import struct
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from mag_tracking.errors import RecordingError
from mag_tracking.messages.self_described import SCHEMAS, cdr_of, type_of
from mag_tracking.messages.types import schema_of
from mag_tracking.recording.damage import DAMAGE
from mag_tracking.recording.interruptible import Progress
from mag_tracking.recording.raw_message import RawMessage

_RECORD = struct.Struct('<BQ')
"""What a record is, and its length."""
_MESSAGE = struct.Struct('<HIQQ')
"""Channel, sequence number, log time and time of publication, before the data of a message."""


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

    def blocks(self, start_ns: int | None = None,
               progress: Progress | None = None) -> Iterator[list[RawMessage]]:
        """Iterate over the `RawMessage`s, chunk by chunk; in order of log time where the file has
        an index.

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
                    progress: Progress | None) -> Iterator[list[RawMessage]]:
        """Messages of an intact file, in order of log time across chunks."""
        waiting: list[RawMessage] = []
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
                waiting = sorted(waiting + self._of_chunk(chunk, schemas, channels), key=_log_time)
            except DAMAGE as error:
                self._lose_chunk(entry, error)
            if progress:
                progress(entry.chunk_length)
            n = len(waiting)
            if k + 1 < len(index):
                n = bisect_left(waiting, index[k + 1].message_start_time, key=_log_time)
            yield waiting[:n]
            waiting = waiting[n:]
        yield waiting

    def _lose_chunk(self, entry: ChunkIndex, error: Exception) -> None:
        """Report a chunk that cannot be read."""
        seconds = (entry.message_end_time - entry.message_start_time) / 1e9
        after = (entry.message_start_time - (self.start_ns or entry.message_start_time)) / 1e9
        self._losses[f'a damaged stretch of {seconds:.1f} s at {after:.1f} s '
                    f'({type(error).__name__})'] += 1

    def _from_stream(self, stream: BinaryIO, progress: Progress | None
                     ) -> Iterator[list[RawMessage]]:
        """Messages in the order of the file, up to where it breaks off."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        done = 0
        try:
            for record in StreamReader(stream, emit_chunks=True).records:
                if isinstance(record, Chunk):
                    try:
                        yield self._of_chunk(record, schemas, channels)
                    except DAMAGE as error:
                        self._losses[f'a damaged chunk ({type(error).__name__})'] += 1
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message) and _has_schema(record, channels):
                    yield [_raw(record.channel_id, record.log_time, record.data, schemas,
                                channels)]
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
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data, at, messages = stream.read(size), 0, []
        while at < size:
            kind, length = _RECORD.unpack_from(data, at)
            begin, at = at + _RECORD.size, at + _RECORD.size + length
            if at > size:
                raise EOFError('a record that is longer than its chunk')
            if kind == Opcode.MESSAGE:
                channel, _, log_time_ns, _ = _MESSAGE.unpack_from(data, begin)
                if channels[channel].schema_id:
                    messages.append(_raw(channel, log_time_ns, data[begin + _MESSAGE.size:at],
                                         schemas, channels))
            elif kind == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(data[begin:at])))
                schemas[schema.id] = schema
            elif kind == Opcode.CHANNEL:
                found = Channel.read(ReadDataStream(BytesIO(data[begin:at])))
                channels[found.id] = found
        return sorted(messages, key=_log_time)


_log_time = attrgetter('log_time_ns')


def _has_schema(message: Message, channels: dict[int, Channel]) -> bool:
    """Whether the message has a type at all; MCAP allows channels without (id 0), ROS does not."""
    return channels[message.channel_id].schema_id != 0


def _raw(channel_id: int, log_time_ns: int, data: bytes, schemas: dict[int, Schema],
         channels: dict[int, Channel]) -> RawMessage:
    """The message with its topic and type; a magnetic field in JSON or protobuf as CDR."""
    channel = channels[channel_id]
    schema = schemas[channel.schema_id]
    if schema.encoding in SCHEMAS and (kind := type_of(schema)) != schema.name:
        return RawMessage(channel.topic, kind, log_time_ns, cdr_of(schema, data), schema_of(kind))
    return RawMessage(channel.topic, schema.name, log_time_ns, data, schema)
