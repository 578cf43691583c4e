"""Writer of one MCAP file, which can be truncated to its complete chunks after a failure."""

import errno
import os
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from mag_tracking.recording.rosbag2_folder import FileSummary, Opener, Topic, UnbufferedWriter


class McapFileWriter:
    """Writer of one MCAP file of a recording; raises OSError if a write fails.

    `opener` creates the file and returns an unbuffered stream.

    Attributes
    ----------
    counts : number of messages by topic, including pending ones
    pending : number of messages by topic that are not yet in a complete chunk
    """

    def __init__(self, path: Path, opener: Opener) -> None:
        self.path = path
        self._stream = UnbufferedWriter(opener(path))
        self.counts: Counter[str] = Counter()
        self.pending: Counter[str] = Counter()
        self._times: list[int] = []
        self._span: tuple[int | None, int | None] = (None, None)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._intact_size = self._buffered_size = 0
        # The writer calls only stream methods that `UnbufferedWriter` has.
        self._writer = Writer(cast(IO[bytes], self._stream), chunk_size=1 << 20,
                              compression=CompressionType.ZSTD)

    def start(self) -> None:
        """Write the header of the file."""
        self._writer.start(profile='ros2', library='mag_tracking')
        self._mark_intact()

    @property
    def size(self) -> int:
        """Upper bound of the file size after the next flush, bytes."""
        return self._stream.offset + self._buffered_size

    def add(self, name: str, topic: Topic, sequence: int, data: bytes, log_ns: int,
            publish_ns: int) -> None:
        """Append a CDR message with the times at which it was received and published."""
        self.counts[name] += 1
        self.pending[name] += 1
        if name not in self._channels:
            self._open_channel(name, topic)
        # A message record has 31 bytes besides its data.
        self._buffered_size += len(data) + 31
        previous_offset = self._stream.offset
        self._writer.add_message(self._channels[name], log_ns, data, publish_ns,
                                 sequence & 0xFFFFFFFF)
        self._times.append(log_ns)
        if self._stream.offset != previous_offset:
            self._mark_intact()

    def _open_channel(self, name: str, topic: Topic) -> None:
        """Register the schema and the channel of a topic."""
        if topic.type not in self._schemas:
            encoding = 'ros2msg' if topic.definition else ''
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, encoding, topic.definition.encode())
        self._channels[name] = self._writer.register_channel(
            name, 'cdr', self._schemas[topic.type], {'offered_qos_profiles': topic.qos})

    def flush(self) -> None:
        """Complete the current chunk, so that a crash cannot lose its messages; raises OSError also
        if the file was removed."""
        if self.pending:
            self._writer.flush()
            self._mark_intact()
        if os.fstat(self._stream.raw.fileno()).st_nlink == 0:
            raise OSError(errno.ENOENT, 'the file was removed')

    def _mark_intact(self) -> None:
        """Mark all bytes written so far as complete chunks, which `abandon` keeps."""
        self._intact_size, self._buffered_size = self._stream.offset, 0
        self.pending.clear()
        if self._times:
            self._span = min(self._times), max(self._times)
            self._times = [*self._span]

    def finish(self) -> None:
        """Write the index and close the file."""
        self.flush()
        self._writer.finish()
        os.fsync(self._stream.raw.fileno())
        self._stream.raw.close()

    def abandon(self) -> None:
        """Truncate the file to its complete chunks after a failure; close it without an index."""
        self.counts -= self.pending
        with suppress(OSError):
            self._stream.raw.truncate(self._intact_size)
        with suppress(OSError):
            self._stream.raw.close()

    def summary(self) -> FileSummary:
        """Entry of the file in `metadata.yaml`."""
        return FileSummary(self.path.name, Counter(self.counts), *self._span)
