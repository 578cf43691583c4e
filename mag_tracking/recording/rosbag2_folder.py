"""Creation of MCAP files and of `metadata.yaml` in a rosbag2 folder."""

import fcntl
import io
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, TypeAlias

import yaml

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import parse_yaml
from mag_tracking.recording.writer import OFFERED_QOS

Opener: TypeAlias = Callable[[Path], io.FileIO]
"""Creates a file at a path and returns an unbuffered stream."""


class Topic(NamedTuple):
    """Description of a topic in a recording."""

    type: str
    """Message type."""
    definition: str = ''
    """Definition of the type as a `ros2msg` schema. Empty if unknown."""
    qos: str = OFFERED_QOS
    """Offered QoS profiles, as YAML."""


class FileSummary(NamedTuple):
    """Entry of one file in `metadata.yaml`."""

    name: str
    """Name of the file."""
    counts: Counter[str]
    """Number of messages by topic."""
    first_ns: int | None = None
    """Log time of the first message, ns. None if the file has no messages."""
    last_ns: int | None = None
    """Log time of the last message, ns. None if the file has no messages."""


def open_new(path: Path) -> io.FileIO:
    """Create a file that must not exist, unbuffered, so that a crash loses no written data.

    It is locked if the file system supports locks.
    """
    stream = open(path, 'xb', buffering=0)
    # The lock prevents a repair of a file that is still being written. Some file systems do not
    # support locks.
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


def write_metadata(folder: Path, files: Sequence[FileSummary], topics: Mapping[str, Topic],
                   opener: Opener = open_new) -> None:
    """Write the `metadata.yaml` of rosbag2 atomically, with the topics by name.

    Raises OSError, or RecordingError if the QoS profiles of a topic are not valid YAML.
    """
    no_counts: Counter[str] = Counter()
    counts = sum((f.counts for f in files), no_counts)
    first_times = [f.first_ns for f in files if f.first_ns is not None]
    last_times = [f.last_ns for f in files if f.last_ns is not None]
    content = {'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap', **_span(first_times, last_times),
        'message_count': counts.total(),
        'topics_with_message_count': [
            {'topic_metadata': {'name': name, 'type': topics[name].type,
                                'serialization_format': 'cdr',
                                'offered_qos_profiles': _qos_profiles(name, topics[name]),
                                'type_description_hash': ''},
             'message_count': n} for name, n in counts.items()],
        'compression_format': '', 'compression_mode': '',
        'relative_file_paths': [f.name for f in files],
        'files': [{'path': f.name, 'message_count': f.counts.total(),
                   **_span([f.first_ns or 0], [f.last_ns or 0])} for f in files],
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


def _qos_profiles(name: str, topic: Topic) -> object:
    """Parse the QoS profiles of a topic, stored as YAML; raises RecordingError if invalid."""
    return parse_yaml(topic.qos, f'offered_qos_profiles of {name}', RecordingError)


def _span(first_times: Sequence[int], last_times: Sequence[int]) -> dict[str, dict[str, int]]:
    """Metadata entries of start time and duration from first and last log times [ns] of files; 0 if
    there are none."""
    first, last = min(first_times, default=0), max(last_times, default=0)
    return {'starting_time': {'nanoseconds_since_epoch': first},
            'duration': {'nanoseconds': last - first}}
