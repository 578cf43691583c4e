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
from contextlib import suppress
from pathlib import Path

from mcap.writer import CompressionType, Writer

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.recording.repair import finish_file
from mag_tracking.recording.rosbag2_folder import (
    FileSummary,
    Topic,
    WholeStream,
    check_is_free,
    offered_qos,
    open_new,
    write_metadata,
)

FLUSH_NS = 400_000_000
"""What a crash may cost, less the time between two ticks [ns]."""
ROOM = 4 << 20
"""A disk with less free than this is not tried again [bytes]."""


class _OpenFile:
    """One MCAP file in the making; whatever writes may raise OSError.

    Attributes
    ----------
    counts, pending : Counter
        Messages by topic: all, and those of them that no whole chunk holds yet.
    """

    def __init__(self, path, opener):
        self.path = path
        self._stream = WholeStream(opener(path))
        self.counts, self.pending = Counter(), Counter()
        self._times, self._span = [], (None, None)
        self._schemas, self._channels = {}, {}
        self._good = self._waiting = 0
        self._writer = Writer(self._stream, chunk_size=1 << 20, compression=CompressionType.ZSTD)

    def start(self):
        """Write the header."""
        self._writer.start(profile='ros2', library='mag_tracking')
        self._mark()

    @property
    def size(self):
        """Bytes, at most, if it were flushed now."""
        return self._stream.offset + self._waiting

    def add(self, name, topic, sequence, data, log_ns, publish_ns):
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

    def _open_channel(self, name, topic):
        """Register schema and channel."""
        if topic.type not in self._schemas:
            encoding = 'ros2msg' if topic.definition else ''
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, encoding, topic.definition.encode())
        self._channels[name] = self._writer.register_channel(
            name, 'cdr', self._schemas[topic.type], {'offered_qos_profiles': topic.qos})

    def flush(self):
        """Close the chunk; from here on a crash cannot take its messages."""
        if self.pending:
            self._writer.flush()
            self._mark()
        if os.fstat(self._stream.raw.fileno()).st_nlink == 0:
            raise OSError(errno.ENOENT, 'the file was removed')

    def _mark(self):
        """All that is in the file so far is whole."""
        self._good, self._waiting = self._stream.offset, 0
        self.pending.clear()
        if self._times:
            self._times = [min(self._times), max(self._times)]
            self._span = tuple(self._times)

    def finish(self):
        """Write the index and close."""
        self.flush()
        self._writer.finish()
        os.fsync(self._stream.raw.fileno())
        self._stream.raw.close()

    def abandon(self):
        """Close after a failure; what is whole stays, without an index."""
        self.counts -= self.pending
        with suppress(OSError):
            self._stream.raw.truncate(self._good)
        with suppress(OSError):
            self._stream.raw.close()

    def summary(self):
        """What `metadata.yaml` is to say."""
        return FileSummary(self.path.name, Counter(self.counts), *self._span)


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

    def __init__(self, folder, split_bytes=10**9, split_ns=3600 * 10**9, retry_ns=2 * 10**9,
                 report=print, opener=open_new):
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
        self.folder = Path(folder)
        self._split_bytes, self._split_ns, self._retry_ns = split_bytes, split_ns, retry_ns
        self._report, self._opener = report, opener
        self.counts, self.dropped, self.repeated = Counter(), Counter(), 0
        self.unfinished, self._done = [], []
        self._topics, self._latched, self._sequence = {}, {}, Counter()
        self._now = self._flushed = self._retry_at = self._metadata_at = self._done_bytes = 0
        self._file = self._opened = None
        self._failing = self._stale = False
        check_is_free(self.folder)
        try:
            self._open()
        except OSError as error:
            raise OutputError(f'cannot record in {self.folder}: {error.strerror}') from error

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    @property
    def size(self):
        """Bytes written so far."""
        return self._done_bytes + (self._file.size if self._file else 0)

    def add_topic(self, name, type_name, definition='', qos=None, latched=0):
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

    def write(self, name, data, log_ns, publish_ns=None):
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
            self._finish()
        if self._file is None and not self._reopen(log_ns):
            self.dropped[name] += 1
        else:
            self.counts[name] += 1
            self._try(self._file.add, name, self._topics[name], *message)
        if name in self._latched:
            self._latched[name].append(message)

    def tick(self, now_ns):
        """To be called several times a second, with the time of a clock that never goes back."""
        self._now = now_ns
        self._opened = now_ns if self._opened is None else self._opened
        if self._file and now_ns - self._flushed >= FLUSH_NS:
            self._flushed = now_ns
            self._try(self._file.flush)
            self._recovered()
        if self._file and self._file.counts and now_ns - self._opened >= self._split_ns:
            self._finish()
        if self._stale and now_ns >= self._metadata_at:
            self._write_metadata()

    def close(self):
        """Finish the file and `metadata.yaml`; what cannot be finished is in `unfinished`."""
        if self._file:
            self._finish()
        for path in list(self.unfinished):
            with suppress(OSError, RecordingError):
                finish_file(path)
                self.unfinished.remove(path)
        self._write_metadata()
        if self.unfinished or self._stale:
            self._report(f'{self.folder} could not be finished: when there is space again, run '
                         f'mag-tracking repair {self.folder}')

    def _try(self, action, *arguments):
        """Whether `action` of the open file went well; if not, the file is given up."""
        try:
            action(*arguments)
        except OSError as error:
            self._give_up(error)
            return False
        return True

    def _finish(self):
        """Complete the open file."""
        if self._try(self._file.finish):
            self._recovered()
            self._end_of(self._file)
            self._file = None
            self._write_metadata()

    def _end_of(self, file):
        """Note a file that is not written to any more."""
        self._done.append(file.summary())
        self._done_bytes += file.size

    def _give_up(self, error):
        """Keep what is whole of the open file, count the rest as dropped, wait."""
        file, self._file = self._file, None
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

    def _wait(self, error):
        """No writing for a while; said once."""
        self._retry_at = self._now + self._retry_ns
        if not self._failing:
            self._report(f'cannot write in {self.folder} ({error.strerror}): messages are dropped '
                         'until it can be written again')
        self._failing = True

    def _reopen(self, log_ns):
        """Whether there is a file to write to again, with the latched messages in it."""
        if self._failing and self._now < self._retry_at:
            return False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if self._failing and shutil.disk_usage(self.folder).free < ROOM:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._open(log_ns)
        except OSError as error:
            self._wait(error)
            return False
        return True

    def _recovered(self):
        """Say that messages could be written again, when some have been."""
        if self._failing and self._file and self._file.counts:
            self._failing = False
            self._report(f'writing again; dropped so far: {self.dropped.total()}')

    def _open(self, log_ns=0):
        """Begin the next file; raises OSError, and leaves none behind then."""
        self.folder.mkdir(parents=True, exist_ok=True)
        names = (self.folder / f'{self.folder.resolve().name}_{n}.mcap'
                 for n in itertools.count(len(self._done)))
        file = _OpenFile(next(p for p in names if not p.exists()), self._opener)
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

    def _write_metadata(self):
        """Bring `metadata.yaml` up to date, now or some time later."""
        files = self._done + ([self._file.summary()] if self._file else [])
        try:
            write_metadata(self.folder, files, self._topics, self._opener)
            self._stale = False
        except OSError:
            # The messages are what counts: their files are written all the same.
            self._stale, self._metadata_at = True, self._now + self._retry_ns
