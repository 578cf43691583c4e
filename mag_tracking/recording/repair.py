"""Repair of recordings that a crash or a full disk has truncated, by writing the missing index."""

import fcntl
import shutil
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Schema, Statistics

from mag_tracking.arrays import IntArray
from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import checked_path, new_binary_file
from mag_tracking.recording import core, mcap_file, writer
from mag_tracking.recording.bag_file import ROS1_MAGIC, SQLITE_MAGIC
from mag_tracking.recording.expansion import DECODE_ERRORS, largest_chunk
from mag_tracking.recording.file_kind import HEAD_SIZE, describe_file


class _Scan:
    """Scan of a file up to the first damage, for the end of the intact records and an index."""

    def __init__(self, stream: BinaryIO) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.times: list[int] = []
        self.chunks: list[ChunkIndex] = []
        self.end, self.damaged, self.n_from_cut_chunk = len(mcap_file.MAGIC), 0, 0
        self.has_data_end = self._is_damaged = False
        self._stream, self._limit = stream, largest_chunk()
        self._rows: IntArray = np.zeros((0, 4), dtype=np.int64)
        self._appended = b''
        size = mcap_file.file_size(stream)
        for record in mcap_file.records(stream, self.end, size):
            self.has_data_end = record.opcode in (Opcode.DATA_END, Opcode.FOOTER)
            if self.has_data_end or record.opcode == 0:
                break
            if record.end > size:
                with suppress(*DECODE_ERRORS):
                    self._recover_chunk(record)
                break
            try:
                self._add_record(record)
            except DECODE_ERRORS:
                self.damaged += 1
            self.end = record.end
        if self._lacks_index():
            self._rebuild_index()

    def _add_record(self, record: mcap_file.Record) -> None:
        """Add a complete record; raises one of `DECODE_ERRORS` if it is damaged."""
        if record.opcode == Opcode.CHUNK:
            if self._lacks_index():
                self._drop_index()
            # The message indexes of a damaged chunk are not used.
            self._is_damaged = True
            header = mcap_file.chunk_header(self._stream, record)
            data = mcap_file.chunk_content(self._stream, record, self._limit)
            self._rows, _ = self._add_content(data)
            self.chunks.append(ChunkIndex(
                record.end - record.begin, record.begin, header.compression, header.size,
                header.end_ns, 0, {}, header.start_ns, len(data)))
            self._is_damaged = False
        elif record.opcode in mcap_file.CONTENT:
            self._stream.seek(record.begin)
            self._add_content(self._stream.read(record.end - record.begin))
        elif record.opcode == Opcode.MESSAGE_INDEX and self.chunks and not self._is_damaged:
            self._stream.seek(record.begin + mcap_file.RECORD_HEADER.size)
            (channel,) = struct.unpack('<H', self._stream.read(2))
            self.chunks[-1].message_index_offsets[channel] = record.begin
            self.chunks[-1].message_index_length += record.end - record.begin

    def _add_content(self, data: bytes) -> tuple[IntArray, int]:
        """Add records; return the rows of their messages and the length of the complete records."""
        rows, definitions, end = core.records_of(
            data, 2**63 - 1, self._limit // mcap_file.MIN_BYTES_PER_MESSAGE)
        for definition in mcap_file.definitions_of(data, definitions):
            if isinstance(definition, Schema):
                self.schemas[definition.id] = definition
            else:
                self.channels[definition.id] = definition
        self.counts.update(sorted(rows[:, 0].tolist()))
        if len(rows):
            times = (*self.times, int(rows[:, 1].min()), int(rows[:, 1].max()))
            self.times = [min(times), max(times)]
        return rows, end

    def _recover_chunk(self, record: mcap_file.Record) -> None:
        """Write the complete records at the beginning of a cut chunk as a new chunk."""
        if record.opcode != Opcode.CHUNK:
            return
        data = mcap_file.chunk_content(self._stream, record, self._limit)
        rows, end = self._add_content(data)
        if not len(rows):
            return
        if self._lacks_index():
            self._drop_index()
        self._rows, self.n_from_cut_chunk, data = rows, len(rows), data[:end]
        first_ns, last_ns = int(rows[:, 1].min()), int(rows[:, 1].max())
        content, builder = zstandard.compress(data), RecordBuilder()
        Chunk('zstd', content, last_ns, first_ns, zlib.crc32(data), len(data)).write(builder)
        self._appended = builder.end()
        self.chunks.append(ChunkIndex(len(self._appended), record.begin, 'zstd', len(content),
                                      last_ns, 0, {}, first_ns, len(data)))

    def _lacks_index(self) -> bool:
        return bool(self.chunks) and (
            set(self.chunks[-1].message_index_offsets) != set(self._rows[:, 0].tolist()))

    def _drop_index(self) -> None:
        """Discard the message indexes of the last chunk: an incomplete set would hide channels."""
        self.chunks[-1].message_index_offsets = {}
        self.chunks[-1].message_index_length = 0

    def _rebuild_index(self) -> None:
        """Rebuild the message indexes of the last chunk, which directly follow the chunk."""
        self._drop_index()
        chunk, indexes = self.chunks[-1], b''
        end = chunk.chunk_start_offset + chunk.chunk_length
        if not self._appended:
            self.end = end
        # Channels are in order of their first messages.
        for channel in dict.fromkeys(self._rows[:, 0].tolist()):
            chunk.message_index_offsets[channel] = end + len(indexes)
            rows = self._rows[self._rows[:, 0] == channel]
            entries = rows[:, 1:3].astype('<u8') - np.array([0, writer.MESSAGE_HEADER], '<u8')
            indexes += mcap_file.RECORD_HEADER.pack(Opcode.MESSAGE_INDEX, 6 + entries.nbytes) \
                + struct.pack('<HI', channel, entries.nbytes) + entries.tobytes()
        chunk.message_index_length = len(indexes)
        self._appended += indexes

    def index(self) -> bytes:
        """Serialise the indexes and the footer of the file, which are written from byte `end`."""
        builder = RecordBuilder()
        DataEnd(0).write(builder)
        data_end: bytes = self._appended + builder.end()
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
        return data_end + summary + footer + mcap_file.MAGIC


def finish_file(path: str | PathLike[str]) -> list[str]:
    """Add the index to a truncated file in place; return a report, empty for a complete file.

    An incomplete record at the end is moved to `<name>.cut`. Raises OutputError if the file is
    still being recorded; after an OSError, the messages in the file are unchanged.
    """
    path = Path(path)
    with open(path, 'r+b', buffering=0) as raw, open(path, 'rb') as stream:
        try:
            fcntl.flock(raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f'{path} is being recorded: stop the recording first') from None
        head = stream.read(HEAD_SIZE)
        if head.startswith((SQLITE_MAGIC, ROS1_MAGIC)):
            raise RecordingError(f'{path} is a bag: only MCAP files can be repaired')
        if not head.startswith(mcap_file.MAGIC):
            raise RecordingError(describe_file(path))
        if mcap_file.read_summary(stream) is not None:
            return []
        scan = _Scan(stream)
        n_cut = 0 if scan.has_data_end else path.stat().st_size - scan.end
        if n_cut:
            stream.seek(scan.end)
            with new_binary_file(f'{path}.cut') as cut:
                shutil.copyfileobj(stream, cut)
        index = scan.index()
        raw.truncate(scan.end)
        raw.seek(scan.end)
        try:
            writer.UnbufferedWriter(raw).write(index)
        except OSError:
            raw.truncate(scan.end)
            raise
    details = {f'the incomplete end was moved to {path.name}.cut; bytes': n_cut,
               'messages recovered from the incomplete chunk at the end': scan.n_from_cut_chunk,
               'damaged chunks skipped': scan.damaged}
    return [f'{path.name}: index written; messages: {scan.counts.total()}',
            *(f'{path.name}: {text}: {n}' for text, n in details.items() if n)]


def repair(path: str | PathLike[str], report: Callable[[str], object] = print) -> int:
    """Repair a truncated MCAP file or folder, including `metadata.yaml`; return the number of
    files; raises RecordingError if nothing can be recovered, OutputError while it is recorded."""
    path = checked_path(path, RecordingError)
    files = [path] if path.is_file() else sorted(path.glob('*.mcap'), key=_number)
    if not files:
        raise RecordingError(f'{path} contains no .mcap file')
    n, summaries = 0, []
    losses: Counter[str] = Counter()
    topics: dict[str, writer.Topic] = {}
    # A crash at a split leaves an empty file.
    empty_files = [file for file in files if file.stat().st_size < len(mcap_file.MAGIC)]
    if len(empty_files) == len(files):
        raise RecordingError(f'{path} cannot be repaired: all .mcap files are empty')
    for file in empty_files:
        report(f'{file} is empty and was skipped')
    for file in (file for file in files if file not in empty_files):
        try:
            lines = finish_file(file)
            if not lines:
                for _ in mcap_file.McapFile(file, losses).blocks():
                    pass
        except OSError as error:
            raise OutputError(f'cannot repair {file}: {error.strerror}') from error
        n += bool(lines)
        for line in lines:
            report(line)
        summaries.append(_summary_of(file, topics))
    if n and not any(summary.counts.total() for summary in summaries):
        raise RecordingError(f'{path}: nothing recovered: there is no complete message')
    if path.is_dir():
        try:
            writer.write_metadata(path, summaries, topics)
        except OSError as error:
            raise OutputError(f'cannot write {path}/metadata.yaml: {error.strerror}') from error
    for loss, number in losses.items():
        report(f'{loss}: {number}, which cannot be restored')
    if losses and not n:
        raise RecordingError(f'{path}: nothing recovered: damaged chunks cannot be restored')
    return n


def _number(file: Path) -> tuple[int, str]:
    """Sort key of a file: the number at the end of its name, which recorders increment."""
    number = file.stem.rpartition('_')[2]
    return (int(number) if number.isdigit() else -1, file.name)


def _summary_of(file: Path, topics: dict[str, writer.Topic]) -> writer.FileSummary:
    """Return the `FileSummary` of a complete file, and add the topics of the file to `topics`."""
    with open(file, 'rb') as stream:
        summary = make_reader(stream).get_summary()
    if summary is None or summary.statistics is None:
        raise RecordingError(f'the index of {file} has no statistics')
    counts: Counter[str] = Counter()
    for i, channel in summary.channels.items():
        schema = summary.schemas.get(channel.schema_id)
        qos = channel.metadata.get('offered_qos_profiles', '')
        topics.setdefault(channel.topic, writer.Topic(schema.name if schema else '', '', qos))
        counts[channel.topic] += summary.statistics.channel_message_counts.get(i, 0)
    if not counts.total():
        return writer.FileSummary(file.name, counts)
    s = summary.statistics
    return writer.FileSummary(file.name, counts, s.message_start_time, s.message_end_time)
