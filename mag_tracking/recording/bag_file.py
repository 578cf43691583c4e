"""Reader of one SQLite bag (`.db3`) or ROS 1 bag (`.bag`), with the library `rosbags`."""

import bz2
import functools
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lz4.frame

from mag_tracking.errors import RecordingError
from mag_tracking.messages.encodings import cdr_of_ros1
from mag_tracking.messages.types import RawMessage, schema_of
from mag_tracking.recording import expansion
from mag_tracking.recording.message_block import MessageBlock, Progress, RecordingFile
from mag_tracking.units import LATEST_NS

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag1.reader import IndexData
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

ROS1_MAGIC = b'#ROSBAG V2.0'
SQLITE_MAGIC = b'SQLite format 3\0'
BLOCK_SIZE = 256
"""Largest number of messages that are read at once."""
BLOCK_BYTES = 16 << 20
"""Number of bytes after which a block is complete."""
_ROS1_COMPRESSIONS: dict[object, str] = {bz2.decompress: 'bz2', lz4.frame.decompress: 'lz4'}
"""Compression of a chunk by the decompressor that the library uses."""


class BagFile(RecordingFile):
    """Reader of one bag of a recording; raises RecordingError if the file is not a bag."""

    def __init__(self, path: Path, losses: 'Counter[str]') -> None:
        super().__init__(path, losses)
        with open(path, 'rb') as stream:
            self._is_ros1 = stream.read(len(ROS1_MAGIC)) == ROS1_MAGIC
        log = path.with_name(f'{path.name}-wal')
        if not self._is_ros1 and log.is_file() and log.stat().st_size:
            losses[f'write-ahead logs that are not read ({log.name}: run `sqlite3 {path.name} '
                   '"PRAGMA wal_checkpoint(TRUNCATE)"`)'] = 1
        with self._open_reader() as reader:
            for connection in reader.connections:
                if not (isinstance(connection.topic, str) and isinstance(connection.msgtype, str)):
                    continue
                self.types[connection.topic] = connection.msgtype
                self.message_counts[connection.topic] += connection.msgcount
            time_range = reader if self._is_ros1 else reader.metadata
            if self.message_counts.total() and isinstance(time_range.start_time, int) \
                    and isinstance(time_range.end_time, int):
                # The end time of the library is one nanosecond after the last message.
                self.start_ns, self.end_ns = time_range.start_time, time_range.end_time - 1

    def _open_reader(self) -> AbstractContextManager[Any]:
        # Imported here because most recordings are MCAP and do not need the library.
        from rosbags.rosbag1 import Reader
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        try:
            reader = (Reader if self._is_ros1 else Sqlite3Reader)(self._path)
            reader.open()
        except bag_errors() as error:
            raise RecordingError(f'{self._path} cannot be read as a bag: {error}') from error
        return closing(reader)

    def blocks(self, start_ns: int | None = None,
               progress: Progress | None = None) -> Iterator[MessageBlock]:
        """Iterate over blocks of CDR messages from `start_ns` on, in order of log time."""
        size, total = self._path.stat().st_size, max(self.message_counts.total(), 1)
        reported = n = n_bytes = 0
        messages: list[RawMessage] = []
        read = self._ros1_messages if self._is_ros1 else self._sqlite_messages
        with self._open_reader() as reader:
            for topic, kind, log_time_ns, data in read(reader, start_ns):
                if self._is_ros1:
                    data = cdr_of_ros1(data, kind)
                messages.append(RawMessage(topic, kind, log_time_ns, data, schema_of(kind)))
                n_bytes += len(data)
                if len(messages) < BLOCK_SIZE and n_bytes < BLOCK_BYTES:
                    continue
                yield MessageBlock.of_messages(messages)
                n += len(messages)
                messages, n_bytes = [], 0
                if progress and (position := size * n // total) > reported:
                    progress(position - reported)
                    reported = position
        if messages:
            yield MessageBlock.of_messages(messages)
            if progress and size > reported:
                progress(size - reported)

    def _sqlite_messages(self, reader: 'Sqlite3Reader', start_ns: int | None
                         ) -> Iterator[tuple[str, str, int, bytes]]:
        """Iterate over the messages up to the first damage, except those without time or data."""
        n = n_null = 0
        try:
            for connection, log_time_ns, data in reader.messages(reader.connections, start_ns):
                n += 1
                if isinstance(log_time_ns, int) and isinstance(data, bytes) \
                        and connection.topic in self.types:
                    yield connection.topic, connection.msgtype, min(log_time_ns, LATEST_NS), data
                else:
                    n_null += 1
        except bag_errors():
            self._losses[f'partially read files ({self._path.name}, up to message {n} of '
                         f'{self.message_counts.total()})'] = 1
        if n_null:
            self._losses[f'messages without topic, time or data (NULL in {self._path.name})'] \
                = n_null

    def _ros1_messages(self, reader: 'Ros1Reader', start_ns: int | None
                       ) -> Iterator[tuple[str, str, int, bytes]]:
        """Iterate over the messages, except those in damaged chunks."""
        limit = expansion.largest_chunk()
        # The library trusts the sizes in the file.
        reader.chunks = {position: chunk._replace(
            datasize=min(chunk.datasize, limit + 1),
            decompressor=partial(expansion.expanded, _ROS1_COMPRESSIONS.get(
                chunk.decompressor, 'none'), limit=limit))
            for position, chunk in reader.chunks.items()}
        order: list[tuple[int, IndexData]] = []
        while True:
            n = 0
            try:
                for connection, log_time_ns, data in reader.messages(start=start_ns):
                    n += 1
                    yield connection.topic, connection.msgtype, log_time_ns, data
                return
            except bag_errors() as error:
                # The order in which the library reads the messages.
                order = order or sorted(
                    ((number, entry) for number, entries in reader.indexes.items()
                     for entry in entries if start_ns is None or entry.time >= start_ns),
                    key=lambda pair: pair[1].time)
                if n >= len(order):
                    return
                damaged = order[n][1].chunk_pos
                reason = f', {error}' if isinstance(error, expansion.RefusedDataError) else ''
                self._count_loss(damaged, f'damaged chunks ({self._path.name}{reason})')
            order = [pair for pair in order[n:] if pair[1].chunk_pos != damaged]
            reader.indexes = {number: [] for number in reader.indexes}
            for number, entry in order:
                reader.indexes[number].append(entry)
            # The library has closed the chunk before the damaged one.
            reader.current_chunk = (-1, BytesIO())


@functools.cache
def bag_errors() -> tuple[type[Exception], ...]:
    """Exceptions that `rosbags` raises for damaged or invalid bags."""
    import apsw
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError
    from rosbags.serde import SerdeError

    # Damaged bytes can also trigger assertions of the library.
    return (Ros1Error, ReaderError, SerdeError, apsw.Error, OSError, AssertionError, IndexError,
            TypeError, AttributeError, OverflowError, *expansion.DECODE_ERRORS)
