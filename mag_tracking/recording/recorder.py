"""Recorder of serialised messages in a rosbag2 folder of MCAP files, with limited loss in a crash.

A chunk is completed and passed to the operating system every `FLUSH_INTERVAL_NS`, so less than
half a second is lost if the program is killed. The file then has no index. This package can read it
directly; other readers require a repair by `recording.repair.repair`.
"""

import errno
import itertools
import os
import shutil
from collections import Counter, deque
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from os import PathLike
from pathlib import Path
from typing import TypeAlias

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import checked_path
from mag_tracking.recording import writer
from mag_tracking.recording.repair import finish_file

FLUSH_INTERVAL_NS = 400_000_000
"""Interval between flushes [ns]. A crash loses at most one flush and one tick interval."""
MIN_FREE_BYTES = 4 << 20
"""Minimum free disk space for a new file after a failure [bytes]."""
_Message: TypeAlias = tuple[int, bytes, int, int]
"""Sequence number, CDR, log time [ns] and publish time [ns]."""


class Recorder(AbstractContextManager['Recorder']):
    """Records messages in a rosbag2 folder, in a sequence of files.

    A new file begins after `split_bytes` or `split_ns`. While the disk is full, messages are
    dropped and reported, and a new file is attempted every `retry_ns`. `counts` and `dropped` are
    numbers of messages by topic, `repeated` that of latched messages at the starts of files, which
    makes these complete; `unfinished` files have no index. `opener` creates a file and returns an
    unbuffered stream. Raises OutputError if the folder contains a recording or cannot be written.
    """

    def __init__(self, folder: str | PathLike[str], split_bytes: int = 10**9,
                 split_ns: int = 3600 * 10**9, retry_ns: int = 2 * 10**9,
                 report: Callable[[str], object] = print,
                 opener: writer.Opener = writer.open_locked) -> None:
        self.folder = checked_path(folder, OutputError)
        self._split_bytes, self._split_ns, self._retry_ns = split_bytes, split_ns, retry_ns
        self._report, self._opener = report, opener
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.repeated = 0
        self.unfinished: list[Path] = []
        self._summaries: list[writer.FileSummary] = []
        self._topics: dict[str, writer.Topic] = {}
        self._latched: dict[str, deque[_Message]] = {}
        self._sequence: Counter[str] = Counter()
        self._now_ns = self._flushed_ns = self._retry_at_ns = self._metadata_at_ns = \
            self._finished_bytes = 0
        self._file: writer.McapFileWriter | None = None
        self._opened_ns: int | None = None
        self._is_failing = self._metadata_is_stale = False
        writer.check_no_recording(self.folder)
        try:
            self._open_next()
        except OSError as error:
            raise OutputError(f'cannot record in {self.folder}: {error.strerror}') from error

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Upper bound of the total size of all files after the next flush, bytes."""
        return self._finished_bytes + (self._file.size if self._file else 0)

    def add_topic(self, name: str, type_name: str, definition: str = '', qos: str | None = None,
                  latched: int = 0) -> None:
        """Register a topic before its first message, or change its number of latched messages,
        which are repeated at the start of each later file.

        Without `definition` (`ros2msg` schema), only ROS can read the messages. `qos` is a result
        of `offered_qos`.
        """
        # All files use the same profile, because readers use it to match channels across files.
        self._topics.setdefault(
            name, writer.Topic(type_name, definition, qos or writer.offered_qos()))
        if latched:
            self._latched[name] = deque(self._latched.get(name, ()), latched)

    def write(self, name: str, data: bytes, log_ns: int, publish_ns: int | None = None) -> None:
        """Record a CDR message of a topic, received at `log_ns`, or count it as dropped."""
        message = (self._sequence[name], data, log_ns, publish_ns or log_ns)
        self._sequence[name] += 1
        if self._file and self._file.counts and self._file.size >= self._split_bytes:
            self._finish(self._file)
        file = self._file or self._reopen(log_ns)
        if file is None:
            self.dropped[name] += 1
        else:
            self.counts[name] += 1
            self._attempt(file, file.add, name, self._topics[name], *message)
        if name in self._latched:
            self._latched[name].append(message)

    def tick(self, now_ns: int) -> None:
        """Flush or split the file, and retry writing the metadata, when due; to be called several
        times per second with a monotonic clock."""
        self._now_ns = now_ns
        self._opened_ns = now_ns if self._opened_ns is None else self._opened_ns
        if self._file and now_ns - self._flushed_ns >= FLUSH_INTERVAL_NS:
            self._flushed_ns = now_ns
            self._attempt(self._file, self._file.flush)
            self._report_recovery()
        if self._file and self._file.counts and now_ns - self._opened_ns >= self._split_ns:
            self._finish(self._file)
        if self._metadata_is_stale and now_ns >= self._metadata_at_ns:
            self._write_metadata()

    def close(self) -> None:
        """Complete all files and `metadata.yaml`; report files that cannot be completed."""
        if self._file:
            self._finish(self._file)
        for path in list(self.unfinished):
            with suppress(OSError, RecordingError):
                finish_file(path)
                self.unfinished.remove(path)
        self._write_metadata()
        if self.unfinished or self._metadata_is_stale:
            self._report(f'the recording {self.folder} could not be completed: free disk space, '
                         f'then run mag-tracking repair {self.folder}')

    def _attempt(self, file: writer.McapFileWriter, action: Callable[..., None], *arguments: object
                 ) -> bool:
        """Call `action` on the open file; abandon the file on failure. Return True on success."""
        try:
            action(*arguments)
        except OSError as error:
            self._abandon(file, error)
            return False
        return True

    def _finish(self, file: writer.McapFileWriter) -> None:
        if self._attempt(file, file.flush) and self._attempt(file, file.finish):
            self._report_recovery()
            self._add_finished(file)
            self._file = None
            self._write_metadata()

    def _add_finished(self, file: writer.McapFileWriter) -> None:
        self._summaries.append(file.summary())
        self._finished_bytes += file.size

    def _abandon(self, file: writer.McapFileWriter, error: OSError) -> None:
        """Close the file at its last complete chunk, count lost messages, and schedule a retry."""
        self._file = None
        lost_counts = file.pending if file.path.exists() else file.counts
        self.dropped += lost_counts
        self.counts -= lost_counts
        file.abandon()
        if file.counts and file.path.exists():
            self._add_finished(file)
            self.unfinished.append(file.path)
        else:
            file.path.unlink(missing_ok=True)
        self._schedule_retry(error)

    def _schedule_retry(self, error: OSError) -> None:
        """Suspend writing until the next retry; report only the first failure."""
        self._retry_at_ns = self._now_ns + self._retry_ns
        if not self._is_failing:
            self._report(f'cannot write to {self.folder} ({error.strerror}): messages are dropped '
                         'until writing is possible again')
        self._is_failing = True

    def _reopen(self, log_ns: int) -> writer.McapFileWriter | None:
        """Open a new file with the latched messages; return None if that is not possible yet."""
        if self._is_failing and self._now_ns < self._retry_at_ns:
            return None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if self._is_failing and shutil.disk_usage(self.folder).free < MIN_FREE_BYTES:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._open_next(log_ns)
        except OSError as error:
            self._schedule_retry(error)
            return None
        return self._file

    def _report_recovery(self) -> None:
        """Report the end of a failure, once the new file contains a message."""
        if self._is_failing and self._file and self._file.counts:
            self._is_failing = False
            self._report(f'recording resumed; messages dropped so far: {self.dropped.total()}')

    def _open_next(self, log_ns: int = 0) -> None:
        """Create the next file with the latched messages, or remove it and raise OSError."""
        self.folder.mkdir(parents=True, exist_ok=True)
        paths = (self.folder / f'{self.folder.resolve().name}_{n}.mcap'
                 for n in itertools.count(len(self._summaries)))
        file = writer.McapFileWriter(next(p for p in paths if not p.exists()), self._opener)
        try:
            file.start()
            for name, messages in self._latched.items():
                for sequence, data, _, publish_ns in messages:
                    file.add(name, self._topics[name], sequence, data, log_ns, publish_ns)
            file.flush()
        except OSError:
            file.abandon()
            file.path.unlink(missing_ok=True)
            raise
        self.repeated += file.counts.total()
        self._file, self._opened_ns = file, None
        self._write_metadata()

    def _write_metadata(self) -> None:
        files = self._summaries + ([self._file.summary()] if self._file else [])
        try:
            writer.write_metadata(self.folder, files, self._topics, self._opener)
            self._metadata_is_stale = False
        except OSError:
            # Messages have priority: recording continues without up-to-date metadata.
            self._metadata_is_stale, self._metadata_at_ns = True, self._now_ns + self._retry_ns
