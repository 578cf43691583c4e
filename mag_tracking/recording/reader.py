"""Reader of MCAP recordings that survives damage and reports it.

It reads chunk by chunk and checks the CRC of each: a damaged chunk is skipped and
reported, a truncated file is read up to the cut. Memory stays at about one chunk.
"""

import heapq
import os
from collections import Counter
from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path
from typing import BinaryIO, NamedTuple

import yaml
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from mag_tracking.errors import RecordingError
from mag_tracking.recording.damage import DAMAGE
from mag_tracking.recording.interruptible import Progress


class RawMessage(NamedTuple):
    """One message as it is in the file."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes
    schema: Schema


class Recording:
    """One MCAP file, or a rosbag2 folder of them.

    Attributes
    ----------
    path : Path
    types : {topic: message type}
    message_counts : {topic: int}, empty for a file that was cut off
    start_ns, end_ns : int or None
        Log times; None where the file does not tell.
    losses : Counter
        {what: number}, grows while reading.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        """Raises RecordingError where there is no readable recording at `path`."""
        self.path = Path(path)
        self.types: dict[str, str] = {}
        self.message_counts: Counter[str] = Counter()
        self.losses: Counter[str] = Counter()
        self._files = _files(self.path)
        empty = [f for f in self._files if f.stat().st_size == 0]
        if len(empty) < len(self._files):
            # A crash at a split leaves one; an only file is told by `_inspect`.
            self._files = [f for f in self._files if f not in empty]
            self.losses.update(f'{f.name} is empty (0 bytes)' for f in empty)
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._indexes = [self._inspect(f) for f in self._files]

    def lies_in(self, folder: str | PathLike[str]) -> bool:
        """Whether a file of this recording is in `folder` itself."""
        return any(f.resolve().parent == Path(folder).resolve() for f in self._files)

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(f.stat().st_size for f in self._files)

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
            self.losses[f'{file.name} has no usable end (cut off?): read up to the damage'] = 1
            return None
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            self.types[channel.topic] = schema.name if schema else ''
        statistics = summary.statistics
        if statistics and statistics.message_count:
            for i, n in statistics.channel_message_counts.items():
                if i in summary.channels:
                    self.message_counts[summary.channels[i].topic] += n
            starts = [t for t in (self.start_ns, statistics.message_start_time) if t is not None]
            ends = [t for t in (self.end_ns, statistics.message_end_time) if t is not None]
            self.start_ns, self.end_ns = min(starts), max(ends)
        return sorted(summary.chunk_indexes, key=lambda c: c.message_start_time)

    def messages(self, topics: Collection[str] | None = None, start_ns: int | None = None,
                 progress: Progress | None = None) -> Iterator[RawMessage]:
        """Iterate over the `RawMessage`s, in order of log time.

        Parameters
        ----------
        topics : collection of str, optional
            All if left out.
        start_ns : int, optional
            Leave out what was logged before.
        progress : function, optional
            Called with the bytes done since the last call.

        What could not be read is counted in `losses`.
        """
        for file, index in zip(self._files, self._indexes, strict=True):
            with open(file, 'rb') as stream:
                if index:
                    records = self._from_index(stream, index, start_ns, progress)
                else:
                    records = self._from_stream(stream, progress)
                for m in records:
                    self.types.setdefault(m.topic, m.type)
                    if (topics is None or m.topic in topics) and (
                            start_ns is None or m.log_time_ns >= start_ns):
                        yield m

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
        self.losses[f'a damaged stretch of {seconds:.1f} s at {after:.1f} s '
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
                        self.losses[f'a damaged chunk ({type(error).__name__})'] += 1
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
            self.losses[f'{os.path.basename(stream.name)}: nothing readable after byte '
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
    """The message with its topic and type."""
    channel = channels[message.channel_id]
    schema = schemas[channel.schema_id]
    return RawMessage(channel.topic, schema.name, message.log_time, message.data, schema)


def _files(path: Path) -> list[Path]:
    """The MCAP files of a recording, in order."""
    if not path.exists():
        raise RecordingError(f'there is no {path}')
    if path.is_file():
        if path.suffix == '.db3':
            raise RecordingError(f'{path} is an SQLite bag; convert it with `ros2 bag convert`')
        if path.stat().st_size == 0:
            raise RecordingError(f'{path} is empty (0 bytes)')
        return [path]
    metadata = path / 'metadata.yaml'
    files = sorted(path.glob('*.mcap'))
    if metadata.exists():
        try:
            content = yaml.safe_load(metadata.read_text(encoding='utf-8'))
            listed = content['rosbag2_bagfile_information']['relative_file_paths']
            files = [path / name for name in listed]
        except (yaml.YAMLError, KeyError, TypeError) as error:
            raise RecordingError(f'{metadata} is not rosbag2 metadata: {error}') from error
    if not files:
        raise RecordingError(f'{path} holds no .mcap file')
    for file in files:
        if not file.exists():
            raise RecordingError(f'{file}, which metadata.yaml names, is not there')
        if file.suffix != '.mcap':
            raise RecordingError(f'{file} is not MCAP; convert it with `ros2 bag convert`')
    return files
