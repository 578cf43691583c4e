"""One MCAP file of a recording while it is written, and how much of it is whole."""

import errno
import os
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from mag_tracking.recording.rosbag2_folder import FileSummary, Opener, Topic, WholeStream


class OpenFile:
    """One MCAP file in the making; whatever writes may raise OSError.

    Attributes
    ----------
    counts, pending : Counter
        Messages by topic: all, and those of them that no whole chunk holds yet.
    """

    def __init__(self, path: Path, opener: Opener) -> None:
        self.path = path
        self._stream = WholeStream(opener(path))
        self.counts: Counter[str] = Counter()
        self.pending: Counter[str] = Counter()
        self._times: list[int] = []
        self._span: tuple[int | None, int | None] = (None, None)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._good = self._waiting = 0
        # Of a stream the writer takes only what `WholeStream` has.
        self._writer = Writer(cast(IO[bytes], self._stream), chunk_size=1 << 20,
                              compression=CompressionType.ZSTD)

    def start(self) -> None:
        """Write the header."""
        self._writer.start(profile='ros2', library='mag_tracking')
        self._mark()

    @property
    def size(self) -> int:
        """Bytes, at most, if it were flushed now."""
        return self._stream.offset + self._waiting

    def add(self, name: str, topic: Topic, sequence: int, data: bytes, log_ns: int,
            publish_ns: int) -> None:
        """Append a message."""
        self.counts[name] += 1
        self.pending[name] += 1
        if name not in self._channels:
            self._open_channel(name, topic)
        self._waiting += len(data) + 31
        before = self._stream.offset
        self._writer.add_message(self._channels[name], log_ns, data, publish_ns,
                                 sequence & 0xFFFFFFFF)
        self._times.append(log_ns)
        if self._stream.offset != before:
            self._mark()

    def _open_channel(self, name: str, topic: Topic) -> None:
        """Register schema and channel."""
        if topic.type not in self._schemas:
            encoding = 'ros2msg' if topic.definition else ''
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, encoding, topic.definition.encode())
        self._channels[name] = self._writer.register_channel(
            name, 'cdr', self._schemas[topic.type], {'offered_qos_profiles': topic.qos})

    def flush(self) -> None:
        """Close the chunk; from here on a crash cannot take its messages."""
        if self.pending:
            self._writer.flush()
            self._mark()
        if os.fstat(self._stream.raw.fileno()).st_nlink == 0:
            raise OSError(errno.ENOENT, 'the file was removed')

    def _mark(self) -> None:
        """All that is in the file so far is whole."""
        self._good, self._waiting = self._stream.offset, 0
        self.pending.clear()
        if self._times:
            self._span = min(self._times), max(self._times)
            self._times = [*self._span]

    def finish(self) -> None:
        """Write the index and close."""
        self.flush()
        self._writer.finish()
        os.fsync(self._stream.raw.fileno())
        self._stream.raw.close()

    def abandon(self) -> None:
        """Close after a failure; what is whole stays, without an index."""
        self.counts -= self.pending
        with suppress(OSError):
            self._stream.raw.truncate(self._good)
        with suppress(OSError):
            self._stream.raw.close()

    def summary(self) -> FileSummary:
        """What `metadata.yaml` is to say."""
        return FileSummary(self.path.name, Counter(self.counts), *self._span)
