"""Writers of MCAP recordings that rosbag2 can play."""

import errno
import fcntl
import io
import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from os import PathLike
from pathlib import Path
from typing import IO, NamedTuple, TypeAlias, cast

import yaml
from mcap.writer import CompressionType, Writer

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import checked_path, parse_yaml
from mag_tracking.messages.types import MessageDict, definition, encoder

MAX_TOPICS = 2000
"""Maximum number of topics; twice the maximum number of sensors. The time to write and to read
`metadata.yaml` grows with their number."""
MESSAGE_HEADER = 31
"""Number of bytes of a message record before its data."""
OFFERED_QOS = '''- history: keep_last
  depth: 10
  reliability: reliable
  durability: volatile
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: automatic
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
'''
"""Default QoS profile of a topic: reliable and volatile, depth 10."""
Opener: TypeAlias = Callable[[Path], io.FileIO]
"""Creates a file at a path and returns an unbuffered stream."""


def offered_qos(reliable: bool = True, latched: bool = False) -> str:
    """QoS profile as rosbag2 writes it, YAML: reliable or best-effort, latched or volatile."""
    text = OFFERED_QOS if reliable else OFFERED_QOS.replace('reliability: reliable',
                                                            'reliability: best_effort')
    return text.replace('durability: volatile', 'durability: transient_local') if latched else text


class Topic(NamedTuple):
    """Description of a topic in a recording."""

    type: str
    definition: str
    """Definition of the type as a `ros2msg` schema. Empty if unknown."""
    qos: str
    """Offered QoS profiles, as YAML."""


class FileSummary(NamedTuple):
    """Entry of one file in `metadata.yaml`; without messages, it has no log times."""

    name: str
    counts: Counter[str]
    first_ns: int | None = None
    last_ns: int | None = None


def open_unbuffered(path: Path) -> io.FileIO:
    """Create a file that must not exist, unbuffered, so that a crash loses no written data."""
    return open(path, 'xb', buffering=0)


def open_locked(path: Path) -> io.FileIO:
    """Create a file as `open_unbuffered`, and lock it, if possible, against repair."""
    stream = open_unbuffered(path)
    with suppress(OSError):
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return stream


class UnbufferedWriter:
    """Stream that writes all bytes or raises OSError.

    On a full disk, an unbuffered write may write only part of its data without raising an error.
    """

    def __init__(self, raw: io.FileIO) -> None:
        self.raw, self.offset = raw, 0

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Append data to the file."""
        remaining = memoryview(data)
        while remaining:
            n = self.raw.write(remaining)
            self.offset += n
            remaining = remaining[n:]

    def tell(self) -> int:
        """Number of bytes written."""
        return self.offset

    def flush(self) -> None:
        """Do nothing: there is no buffer."""


def check_no_recording(folder: Path) -> None:
    """Raise OutputError if a path is not a folder or contains a recording."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f'{folder} is not a folder')
    existing = sorted(p.name for pattern in ('metadata.yaml', '*.mcap', '*.db3')
                      for p in folder.glob(pattern))
    if existing:
        raise OutputError(f'{folder} already contains a recording ({existing[0]}): choose another '
                          f'folder, or run mag-tracking repair to complete a truncated recording')


def check_no_other_recording(path: Path) -> None:
    """Raise OutputError if the folder of a new file has a `metadata.yaml` that does not list it."""
    metadata = path.parent / 'metadata.yaml'
    try:
        # Only a regular file is read: a pipe or a device could block.
        if metadata.is_file() and f'- {path.name}\n' not in metadata.read_text(
                encoding='utf-8', errors='replace'):
            raise OutputError(f'{path.parent} contains another recording (its metadata.yaml does '
                              f'not list {path.name}): choose another folder')
    except OSError as error:
        raise OutputError(f'cannot read {metadata}: {error.strerror}') from error


def write_metadata(folder: Path, files: Sequence[FileSummary], topics: Mapping[str, Topic],
                   opener: Opener = open_locked) -> None:
    """Write the `metadata.yaml` of rosbag2 atomically, with the topics by name; raises OSError, or
    RecordingError if the QoS profiles of a topic are not valid YAML."""
    no_counts: Counter[str] = Counter()
    counts = sum((f.counts for f in files), no_counts)
    start, duration = _span([t for f in files for t in (f.first_ns, f.last_ns) if t is not None])
    content = {'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap',
        'duration': duration, 'starting_time': start, 'message_count': counts.total(),
        'topics_with_message_count': [
            {'topic_metadata': {'name': name, 'type': topics[name].type,
                                'serialization_format': 'cdr',
                                'offered_qos_profiles': parse_yaml(
                                    topics[name].qos, f'offered_qos_profiles of {name}',
                                    RecordingError),
                                'type_description_hash': ''},
             'message_count': n} for name, n in counts.items()],
        'compression_format': '', 'compression_mode': '',
        'relative_file_paths': [f.name for f in files],
        'files': [{'path': f.name, **dict(zip(('starting_time', 'duration'), _span(
            [f.first_ns or 0, f.last_ns or 0]), strict=True)), 'message_count': f.counts.total()}
            for f in files],
        'custom_data': None, 'ros_distro': 'jazzy'}}
    new_file = folder / '.metadata.yaml.new'
    new_file.unlink(missing_ok=True)
    stream = UnbufferedWriter(opener(new_file))
    try:
        stream.write(yaml.safe_dump(content, sort_keys=False).encode())
        os.replace(new_file, folder / 'metadata.yaml')
    finally:
        stream.raw.close()
        new_file.unlink(missing_ok=True)


def _span(times: Sequence[int]) -> tuple[dict[str, int], dict[str, int]]:
    """Metadata entries of start time and duration from log times [ns]; 0 without times."""
    first, last = min(times, default=0), max(times, default=0)
    return {'nanoseconds_since_epoch': first}, {'nanoseconds': last - first}


class McapFileWriter:
    """Writer of one MCAP file, which can be truncated to its complete chunks after a failure.

    `opener` creates the file; raises OSError if a write fails. `counts` are numbers of messages by
    topic, `pending` those that are not yet in a complete chunk.
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

    @property
    def is_closed(self) -> bool:
        """Whether the file is complete or was abandoned."""
        return self._stream.raw.closed

    def add(self, name: str, topic: Topic, sequence: int, data: bytes, log_ns: int,
            publish_ns: int) -> None:
        """Append a CDR message with the times at which it was received and published."""
        self.counts[name] += 1
        self.pending[name] += 1
        if name not in self._channels:
            self._open_channel(name, topic)
        self._buffered_size += MESSAGE_HEADER + len(data)
        previous_offset = self._stream.offset
        self._writer.add_message(self._channels[name], log_ns, data, publish_ns,
                                 sequence & 0xFFFFFFFF)
        self._times.append(log_ns)
        if self._stream.offset != previous_offset:
            self._mark_intact()

    def _open_channel(self, name: str, topic: Topic) -> None:
        if topic.type not in self._schemas:
            encoding = 'ros2msg' if topic.definition else ''
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, encoding, topic.definition.encode())
        self._channels[name] = self._writer.register_channel(
            name, 'cdr', self._schemas[topic.type], {'offered_qos_profiles': topic.qos})

    def flush(self) -> None:
        """Complete the chunk, so that a crash cannot lose it; raises OSError for a removed file."""
        self._complete_chunk()
        if os.fstat(self._stream.raw.fileno()).st_nlink == 0:
            raise OSError(errno.ENOENT, 'the file was removed')

    def _complete_chunk(self) -> None:
        if self.pending:
            self._writer.flush()
            self._mark_intact()

    def _mark_intact(self) -> None:
        """Mark all bytes written so far as complete chunks, which `abandon` keeps."""
        self._intact_size, self._buffered_size = self._stream.offset, 0
        self.pending.clear()
        if self._times:
            self._span = min(self._times), max(self._times)
            self._times = [*self._span]

    def finish(self) -> None:
        """Write the index and close the file."""
        self._complete_chunk()
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


class RecordingWriter(AbstractContextManager['RecordingWriter']):
    """Writes messages to an MCAP file and a `metadata.yaml` in its folder; a context manager.

    `latched` are the topics with transient local durability. Parent folders are created; raises
    OutputError if the folder contains another recording.
    """

    def __init__(self, path: str | PathLike[str], latched: Collection[str] = ()) -> None:
        self._latched = frozenset(latched)
        self._topics: dict[str, Topic] = {}
        self.path = checked_path(path, OutputError)
        check_no_other_recording(self.path)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.unlink(missing_ok=True)
            self._file = McapFileWriter(self.path, open_unbuffered)
        except OSError as error:
            raise OutputError(f'cannot write {self.path}: {error.strerror}') from error
        self._file.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def write(self, topic: str, type_name: str, message: MessageDict, time_ns: int) -> None:
        """Append a message with its fields and log time.

        Raises RecordingError if the type is unknown, OutputError beyond `MAX_TOPICS`.
        """
        if topic not in self._topics:
            if len(self._topics) == MAX_TOPICS:
                raise OutputError(f'{self.path}: the recording would have more than {MAX_TOPICS} '
                                  f'topics; the next one is {topic}')
            self._topics[topic] = Topic(type_name, definition(type_name),
                                        offered_qos(latched=topic in self._latched))
        self._file.add(topic, self._topics[topic], self._file.counts[topic],
                       encoder(type_name)(message), time_ns, time_ns)

    def close(self) -> None:
        """Complete the file and write `metadata.yaml`."""
        if not self._file.is_closed:
            self._file.finish()
            write_metadata(self.path.parent, [self._file.summary()], self._topics)
