"""Records serialised messages into a rosbag2 folder of MCAP files, and loses little to a crash.

A chunk is closed and handed to the operating system every `FLUSH_NS`, so a killed
program loses less than a second. What it leaves has no index: this package reads
it as it is, others after `recording_repair.repair`.
"""

import errno
import itertools
import os
import shutil
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import TypeAlias

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import checked_path
from mag_tracking.recording.open_file import OpenFile
from mag_tracking.recording.repair import finish_file
from mag_tracking.recording.rosbag2_folder import (
    FileSummary,
    Opener,
    Topic,
    check_is_free,
    open_new,
    write_metadata,
)
from mag_tracking.recording.writer import offered_qos

FLUSH_NS = 400_000_000
"""What a crash may cost, less the time between two ticks [ns]."""
ROOM = 4 << 20
"""A disk with less free than this is not tried again [bytes]."""


_Message: TypeAlias = tuple[int, bytes, int, int]
"""Sequence number, CDR, log time, publish time."""


class Recorder:
    """Writes messages into a rosbag2 folder, file after file.

    While the disk is full, messages are dropped, counted and reported; as soon as
    there is space it goes on in a new file.

    Attributes
    ----------
    counts, dropped : Counter
        Messages by topic: recorded, and lost because they could not be written.
    repeated : int
        Latched messages that a further file begins with, so that it can be used alone.
    unfinished : list of Path
        Files without an index.
    """

    def __init__(self, folder: str | PathLike[str], split_bytes: int = 10**9,
                 split_ns: int = 3600 * 10**9, retry_ns: int = 2 * 10**9,
                 report: Callable[[str], object] = print, opener: Opener = open_new) -> None:
        """
        Parameters
        ----------
        folder : path
            Made if need be; must not hold a recording.
        split_bytes, split_ns : int
            A new file begins when one is that large, or has been open for that long.
        retry_ns : int
            How long to wait after a failure.
        report : function
            Takes a line of text for the user.
        opener : function
            From a path to an unbuffered stream.

        Raises OutputError where the folder holds a recording or cannot be written.
        """
        self.folder = checked_path(folder, OutputError)
        self._split_bytes, self._split_ns, self._retry_ns = split_bytes, split_ns, retry_ns
        self._report, self._opener = report, opener
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.repeated = 0
        self.unfinished: list[Path] = []
        self._done: list[FileSummary] = []
        self._topics: dict[str, Topic] = {}
        self._latched: dict[str, deque[_Message]] = {}
        self._sequence: Counter[str] = Counter()
        self._now = self._flushed = self._retry_at = self._metadata_at = self._done_bytes = 0
        self._file: OpenFile | None = None
        self._opened: int | None = None
        self._failing = self._stale = False
        check_is_free(self.folder)
        try:
            self._open()
        except OSError as error:
            raise OutputError(f'cannot record in {self.folder}: {error.strerror}') from error

    def __enter__(self) -> 'Recorder':
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._done_bytes + (self._file.size if self._file else 0)

    def add_topic(self, name: str, type_name: str, definition: str = '', qos: str | None = None,
                  latched: int = 0) -> None:
        """Tell about a topic before its first message.

        Parameters
        ----------
        definition : str
            Text of the type, as a `ros2msg` schema; without it only ROS reads the messages.
        qos : str
            `offered_qos`; its defaults if left out.
        latched : int
            How many of the latest messages each further file begins with.
        """
        # One profile for all files: readers match the files' channels by it.
        self._topics.setdefault(name, Topic(type_name, definition, qos or offered_qos()))
        if latched:
            self._latched[name] = deque(self._latched.get(name, ()), latched)

    def write(self, name: str, data: bytes, log_ns: int, publish_ns: int | None = None) -> None:
        """Record a serialised message of a topic that was added.

        Parameters
        ----------
        data : bytes
            CDR.
        log_ns, publish_ns : int
            When it was received and sent; the same if left out.
        """
        message = (self._sequence[name], data, log_ns, publish_ns or log_ns)
        self._sequence[name] += 1
        if self._file and self._file.counts and self._file.size >= self._split_bytes:
            self._finish(self._file)
        file = self._file or self._reopened(log_ns)
        if file is None:
            self.dropped[name] += 1
        else:
            self.counts[name] += 1
            self._try(file, file.add, name, self._topics[name], *message)
        if name in self._latched:
            self._latched[name].append(message)

    def tick(self, now_ns: int) -> None:
        """To be called several times a second, with the time of a clock that never goes back."""
        self._now = now_ns
        self._opened = now_ns if self._opened is None else self._opened
        if self._file and now_ns - self._flushed >= FLUSH_NS:
            self._flushed = now_ns
            self._try(self._file, self._file.flush)
            self._recovered()
        if self._file and self._file.counts and now_ns - self._opened >= self._split_ns:
            self._finish(self._file)
        if self._stale and now_ns >= self._metadata_at:
            self._write_metadata()

    def close(self) -> None:
        """Finish the file and `metadata.yaml`; what cannot be finished is in `unfinished`."""
        if self._file:
            self._finish(self._file)
        for path in list(self.unfinished):
            with suppress(OSError, RecordingError):
                finish_file(path)
                self.unfinished.remove(path)
        self._write_metadata()
        if self.unfinished or self._stale:
            self._report(f'{self.folder} could not be finished: when there is space again, run '
                         f'mag-tracking repair {self.folder}')

    def _try(self, file: OpenFile, action: Callable[..., None], *arguments: object) -> bool:
        """Whether `action` of the open file went well; if not, the file is given up."""
        try:
            action(*arguments)
        except OSError as error:
            self._give_up(file, error)
            return False
        return True

    def _finish(self, file: OpenFile) -> None:
        """Complete the open file."""
        if self._try(file, file.finish):
            self._recovered()
            self._end_of(file)
            self._file = None
            self._write_metadata()

    def _end_of(self, file: OpenFile) -> None:
        """Note a file that is not written to any more."""
        self._done.append(file.summary())
        self._done_bytes += file.size

    def _give_up(self, file: OpenFile, error: OSError) -> None:
        """Keep what is whole of the open file, count the rest as dropped, wait."""
        self._file = None
        lost = file.pending if file.path.exists() else file.counts
        self.dropped += lost
        self.counts -= lost
        file.abandon()
        if file.counts and file.path.exists():
            self._end_of(file)
            self.unfinished.append(file.path)
        else:
            file.path.unlink(missing_ok=True)
        self._wait(error)

    def _wait(self, error: OSError) -> None:
        """No writing for a while; said once."""
        self._retry_at = self._now + self._retry_ns
        if not self._failing:
            self._report(f'cannot write in {self.folder} ({error.strerror}): messages are dropped '
                         'until it can be written again')
        self._failing = True

    def _reopened(self, log_ns: int) -> OpenFile | None:
        """A file to write to again, with the latched messages in it; None while there is none."""
        if self._failing and self._now < self._retry_at:
            return None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if self._failing and shutil.disk_usage(self.folder).free < ROOM:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._open(log_ns)
        except OSError as error:
            self._wait(error)
            return None
        return self._file

    def _recovered(self) -> None:
        """Say that messages could be written again, when some have been."""
        if self._failing and self._file and self._file.counts:
            self._failing = False
            self._report(f'writing again; dropped so far: {self.dropped.total()}')

    def _open(self, log_ns: int = 0) -> None:
        """Begin the next file; raises OSError, and leaves none behind then."""
        self.folder.mkdir(parents=True, exist_ok=True)
        names = (self.folder / f'{self.folder.resolve().name}_{n}.mcap'
                 for n in itertools.count(len(self._done)))
        file = OpenFile(next(p for p in names if not p.exists()), self._opener)
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
        self._file, self._opened = file, None
        self._write_metadata()

    def _write_metadata(self) -> None:
        """Bring `metadata.yaml` up to date, now or some time later."""
        files = self._done + ([self._file.summary()] if self._file else [])
        try:
            write_metadata(self.folder, files, self._topics, self._opener)
            self._stale = False
        except OSError:
            # The messages are what counts: their files are written all the same.
            self._stale, self._metadata_at = True, self._now + self._retry_ns
