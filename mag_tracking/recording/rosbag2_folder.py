"""What a rosbag2 folder of MCAP files consists of: new files, `metadata.yaml`."""

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
from mag_tracking.recording.writer import OFFERED_QOS
from mag_tracking.yaml_file import parse_yaml

Opener: TypeAlias = Callable[[Path], io.FileIO]
"""From the path of a new file to a stream without a buffer."""


class Topic(NamedTuple):
    """What a recording says about a topic."""

    type: str
    definition: str = ''
    qos: str = OFFERED_QOS


class FileSummary(NamedTuple):
    """What `metadata.yaml` says about one file."""

    name: str
    counts: Counter[str]
    first_ns: int | None = None
    last_ns: int | None = None


def open_new(path: Path) -> io.FileIO:
    """A file of one's own to write to, without a buffer that a crash would lose."""
    stream = open(path, 'xb', buffering=0)
    # A repair of a file that is still written would spoil it. Some file systems know no locks.
    with suppress(OSError):
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return stream


class WholeStream:
    """Writes all of what it is given, or raises: a full disk takes a part of it without a word."""

    def __init__(self, raw: io.FileIO) -> None:
        self.raw, self.offset = raw, 0

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Append `data`."""
        rest = memoryview(data)
        while rest:
            n = self.raw.write(rest)
            self.offset += n
            rest = rest[n:]

    def tell(self) -> int:
        """Bytes written."""
        return self.offset

    def flush(self) -> None:
        """Nothing waits here."""


def check_is_free(folder: Path) -> None:
    """Raise OutputError where `folder` is no place for a new recording."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f'{folder} is not a folder')
    there = sorted(p.name for pattern in ('metadata.yaml', '*.mcap', '*.db3')
                   for p in folder.glob(pattern))
    if there:
        raise OutputError(f'{folder} holds a recording already ({there[0]}); choose another '
                          f'folder (one that was cut off is made whole by mag-tracking repair)')


def write_metadata(folder: Path, files: Sequence[FileSummary], topics: Mapping[str, Topic],
                   opener: Opener = open_new) -> None:
    """Write rosbag2's `metadata.yaml`, all or nothing.

    Parameters
    ----------
    files : list of FileSummary
    topics : {name: Topic}

    Raises OSError, and RecordingError where a topic's QoS is not YAML.
    """
    nothing: Counter[str] = Counter()
    counts = sum((f.counts for f in files), nothing)
    firsts = [f.first_ns for f in files if f.first_ns is not None]
    lasts = [f.last_ns for f in files if f.last_ns is not None]
    content = {'rosbag2_bagfile_information': {
        'version': 9, 'storage_identifier': 'mcap', **_span(firsts, lasts),
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
    new = folder / '.metadata.yaml.new'
    new.unlink(missing_ok=True)
    stream = WholeStream(opener(new))
    try:
        stream.write(yaml.safe_dump(content, sort_keys=False).encode())
        os.replace(new, folder / 'metadata.yaml')
    finally:
        stream.raw.close()
        new.unlink(missing_ok=True)


def _qos_profiles(name: str, topic: Topic) -> object:
    """The QoS profiles of a topic as a list; recordings, and `Topic`, have them as YAML text."""
    return parse_yaml(topic.qos, f'offered_qos_profiles of {name}', RecordingError)


def _span(firsts: Sequence[int], lasts: Sequence[int]) -> dict[str, dict[str, int]]:
    """Start and duration, as rosbag2 has them."""
    first, last = min(firsts, default=0), max(lasts, default=0)
    return {'starting_time': {'nanoseconds_since_epoch': first},
            'duration': {'nanoseconds': last - first}}
