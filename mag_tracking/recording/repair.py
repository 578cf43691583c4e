"""Repair of recordings that a crash or a full disk has truncated, by writing the missing index."""

import fcntl
import io
import shutil
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    MessageIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.summary import Summary

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import checked_path, new_binary_file
from mag_tracking.recording.decode_errors import DECODE_ERRORS
from mag_tracking.recording.rosbag2_folder import (
    FileSummary,
    Topic,
    UnbufferedWriter,
    write_metadata,
)

_MAGIC = b'\x89MCAP0\r\n'


class _Scan:
    """Scan of a file up to the first damage. It finds the end of the intact records and collects
    the data for an index."""

    def __init__(self, stream: BinaryIO) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.times: list[int] = []
        self.chunks: list[ChunkIndex] = []
        self.end, self.damaged = 0, 0
        self.has_data_end = False
        self._index: dict[int, MessageIndex] = {}
        try:
            for record in StreamReader(stream, emit_chunks=True).records:
                if isinstance(record, (DataEnd, Footer)):
                    self.has_data_end = True
                    break
                self._add_record(record, stream.tell())
                self.end = stream.tell()
        except DECODE_ERRORS:
            pass
        self._rebuilt_index = b''
        if self._lacks_index():
            self._rebuild_index()

    def _add_record(self, record: McapRecord, end: int) -> None:
        """Add a record that ends at byte `end`."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Message):
            self._count(record.channel_id, record.log_time)
        elif isinstance(record, Chunk):
            if self._lacks_index():
                self._drop_index()
            try:
                self._add_chunk(record, end)
            except DECODE_ERRORS:
                self.damaged += 1
        elif isinstance(record, MessageIndex) and self.chunks:
            index, length = self.chunks[-1], 15 + 16 * len(record.records)
            index.message_index_offsets[record.channel_id] = end - length
            index.message_index_length += length

    def _count(self, channel: int, time_ns: int) -> None:
        """Update the message counts and the time range with a message."""
        self.counts[channel] += 1
        low, high = self.times or (time_ns, time_ns)
        self.times = [min(low, time_ns), max(high, time_ns)]

    def _add_chunk(self, chunk: Chunk, end: int) -> None:
        """Add a chunk and its records; raises one of `DECODE_ERRORS` if the chunk is damaged."""
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        data = stream.read(length)
        self._index, offset = {}, 0
        while offset < length:
            opcode, size = struct.unpack_from('<BQ', data, offset)
            offset += 9
            if opcode == Opcode.MESSAGE:
                channel, _, time_ns = struct.unpack_from('<HIQ', data, offset)
                index = self._index.setdefault(channel, MessageIndex(channel, []))
                index.records.append((time_ns, offset - 9))
                self._count(channel, time_ns)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                kind: type[Schema] | type[Channel] = (
                    Schema if opcode == Opcode.SCHEMA else Channel)
                self._add_record(
                    kind.read(ReadDataStream(io.BytesIO(data[offset:offset + size]))), end)
            offset += size
        record_length = 9 + 40 + len(chunk.compression.encode()) + len(chunk.data)
        self.chunks.append(ChunkIndex(
            record_length, end - record_length, chunk.compression, len(chunk.data),
            chunk.message_end_time, 0, {}, chunk.message_start_time, chunk.uncompressed_size))

    def _lacks_index(self) -> bool:
        """Whether the message index of any channel in the last chunk is missing."""
        return bool(self.chunks) and (
            set(self.chunks[-1].message_index_offsets) != set(self._index))

    def _drop_index(self) -> None:
        """Discard the message indexes of the last chunk: an incomplete set would hide channels."""
        self.chunks[-1].message_index_offsets = {}
        self.chunks[-1].message_index_length = 0

    def _rebuild_index(self) -> None:
        """Rebuild the message indexes of the last chunk, which directly follow the chunk."""
        self._drop_index()
        chunk, builder = self.chunks[-1], RecordBuilder()
        self.end = chunk.chunk_start_offset + chunk.chunk_length
        for channel, index in self._index.items():
            chunk.message_index_offsets[channel] = self.end + builder.count
            index.write(builder)
        chunk.message_index_length = builder.count
        self._rebuilt_index = builder.end()

    def index(self) -> bytes:
        """Serialise the indexes and the footer of the file, which are written from byte `end`."""
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        data_end: bytes = self._rebuilt_index + builder.end()
        times = self.times or [0, 0]
        for record in (*self.schemas.values(), *self.channels.values(), Statistics(
                0, len(self.channels), dict(self.counts), len(self.chunks), self.counts.total(),
                times[1], times[0], 0, len(self.schemas)), *self.chunks):
            record.write(builder)
        summary: bytes = builder.end()
        start = self.end + len(data_end)
        crc = zlib.crc32(struct.pack('<BQQQ', Opcode.FOOTER, 20, start, 0), zlib.crc32(summary))
        Footer(start, 0, crc).write(builder)
        footer: bytes = builder.end()
        return data_end + summary + footer + _MAGIC


def _summary(stream: BinaryIO) -> Summary | None:
    """Read the index of a file; return None if there is no valid index."""
    stream.seek(0)
    try:
        return make_reader(stream).get_summary()
    except DECODE_ERRORS:
        return None


def finish_file(path: str | PathLike[str]) -> list[str]:
    """Add the index to a truncated file in place; a complete file is not modified.

    An incomplete record at the end is moved to `<name>.cut`.

    Parameters
    ----------
    path : path_like

    Returns
    -------
    list of str
        Report for the user. Empty for a complete file.

    Raises
    ------
    RecordingError
        If the file is not an MCAP file.
    OutputError
        If the file is still being recorded.
    OSError
        If the file cannot be written. The messages in the file are then unchanged.
    """
    path = Path(path)
    with open(path, 'r+b', buffering=0) as raw, open(path, 'rb') as stream:
        try:
            fcntl.flock(raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f'{path} is being recorded: stop the recording first') from None
        if _summary(stream) is not None:
            return []
        stream.seek(0)
        if stream.read(len(_MAGIC)) != _MAGIC:
            raise RecordingError(f'{path} is not an MCAP file')
        stream.seek(0)
        scan = _Scan(stream)
        n_cut = 0 if scan.has_data_end else path.stat().st_size - scan.end
        if n_cut:
            stream.seek(scan.end)
            with new_binary_file(f'{path}.cut') as cut:
                shutil.copyfileobj(stream, cut)
        _replace_end(raw, scan.end, scan.index())
    lines = [f'{path.name}: index written; messages: {scan.counts.total()}']
    if n_cut:
        lines.append(f'{path.name}: the incomplete end was moved to {path.name}.cut; bytes: '
                     f'{n_cut}')
    if scan.damaged:
        lines.append(f'{path.name}: damaged chunks skipped: {scan.damaged}')
    return lines


def _replace_end(raw: io.FileIO, end: int, index: bytes) -> None:
    """Write the index after the intact records; on OSError, remove the incomplete index."""
    raw.truncate(end)
    raw.seek(end)
    try:
        UnbufferedWriter(raw).write(index)
    except OSError:
        raw.truncate(end)
        raise


def repair(path: str | PathLike[str], report: Callable[[str], object] = print) -> int:
    """Repair a truncated recording.

    Parameters
    ----------
    path : path_like
        MCAP file, or folder of MCAP files, in which `metadata.yaml` is also rewritten.
    report : callable, optional
        Called with each message to the user.

    Returns
    -------
    int
        Number of files that were repaired.

    Raises
    ------
    RecordingError
        If `path` does not contain a recording.
    OutputError
        If the recording cannot be written or is still being recorded.
    """
    path = checked_path(path, RecordingError)
    files = [path] if path.is_file() else sorted(path.glob('*.mcap'), key=_number)
    if not files:
        raise RecordingError(f'{path} contains no .mcap file')
    n, summaries = 0, []
    topics: dict[str, Topic] = {}
    # A crash at a split leaves an empty file.
    empty_files = [file for file in files if file.stat().st_size < len(_MAGIC)]
    if len(empty_files) == len(files):
        raise RecordingError(f'{path} cannot be repaired: all .mcap files are empty')
    for file in empty_files:
        report(f'{file} is empty and was skipped')
    for file in [file for file in files if file not in empty_files]:
        try:
            lines = finish_file(file)
        except OSError as error:
            raise OutputError(f'cannot repair {file}: {error.strerror}') from error
        n += bool(lines)
        for line in lines:
            report(line)
        summaries.append(_summary_of(file, topics))
    if path.is_dir():
        try:
            write_metadata(path, summaries, topics)
        except OSError as error:
            raise OutputError(f'cannot write {path}/metadata.yaml: {error.strerror}') from error
    return n


def _number(file: Path) -> tuple[int, str]:
    """Sort key of a file: the number at the end of its name, which recorders increment."""
    number = file.stem.rpartition('_')[2]
    return (int(number) if number.isdigit() else -1, file.name)


def _summary_of(file: Path, topics: dict[str, Topic]) -> FileSummary:
    """Return the `FileSummary` of a complete file, and add the topics of the file to `topics`."""
    with open(file, 'rb') as stream:
        summary = make_reader(stream).get_summary()
    if summary is None or summary.statistics is None:
        raise RecordingError(f'the index of {file} has no statistics')
    counts: Counter[str] = Counter()
    for i, channel in summary.channels.items():
        schema = summary.schemas.get(channel.schema_id)
        qos = channel.metadata.get('offered_qos_profiles', '')
        topics.setdefault(channel.topic, Topic(schema.name if schema else '', '', qos))
        counts[channel.topic] += summary.statistics.channel_message_counts.get(i, 0)
    if not counts.total():
        return FileSummary(file.name, counts)
    s = summary.statistics
    return FileSummary(file.name, counts, s.message_start_time, s.message_end_time)
