"""Reader of recordings (MCAP, SQLite bags, ROS 1 bags) that tolerates and reports damage.

A damaged chunk of an MCAP file is skipped and reported. A truncated file is read up to its last
complete record. Memory use is limited to about one chunk.
"""

from collections import Counter
from collections.abc import Collection, Iterator
from os import PathLike
from pathlib import Path

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import checked_path, read_yaml
from mag_tracking.messages.types import RawMessage
from mag_tracking.recording.bag_file import ROS1_MAGIC, SQLITE_MAGIC, BagFile
from mag_tracking.recording.file_kind import HEAD_SIZE, describe_file
from mag_tracking.recording.mcap_file import MAGIC as MCAP_MAGIC
from mag_tracking.recording.mcap_file import McapFile
from mag_tracking.recording.message_block import MessageBlock, Progress

SUFFIXES = ('.mcap', '.db3', '.bag')
"""Suffixes of the files that are read in a folder; a file given itself may have any name."""
_COMPRESSED_SUFFIXES = {'.zstd': 'zstd', '.zst': 'zstd', '.lz4': 'lz4'}
"""Suffixes that the compression of whole files in rosbag2 adds, and the names of the programs."""


class Recording:
    """Recording in one file (MCAP, SQLite bag `.db3`, ROS 1 `.bag`) or in a rosbag2 folder.

    Raises RecordingError if `path` is not a readable recording.

    Attributes
    ----------
    types : message type by topic
    message_counts : number of messages by topic; empty for a truncated file
    start_ns, end_ns : log times of the first and last message; None if unknown
    losses : number of unreadable parts by description, updated while messages are read; the
        description begins with the plural of the part, such as 'damaged chunks (a.mcap)'
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = checked_path(path, RecordingError)
        self.types: dict[str, str] = {}
        self.message_counts: Counter[str] = Counter()
        self.losses: Counter[str] = Counter()
        self._files = _files(self.path)
        empty_files = [f for f in self._files if f.stat().st_size == 0]
        if len(empty_files) < len(self._files):
            # A crash between two files of a recording leaves an empty file, which is skipped. If
            # all files are empty, opening them fails.
            self._files = [f for f in self._files if f not in empty_files]
            self.losses.update(f'empty files ({f.name})' for f in empty_files)
        self._opened = [_open(f, self.losses) for f in self._files]
        for file in self._opened:
            self.types.update(file.types)
            self.message_counts.update(file.message_counts)
        starts = [f.start_ns for f in self._opened if f.start_ns is not None]
        ends = [f.end_ns for f in self._opened if f.end_ns is not None]
        self.start_ns, self.end_ns = min(starts, default=None), max(ends, default=None)

    def lies_in(self, folder: str | PathLike[str]) -> bool:
        """Whether a file of this recording, or a link to it, is directly in a folder."""
        folder = checked_path(folder, OutputError).resolve()
        return any(folder in (f.resolve().parent, f.parent.resolve()) for f in self._files)

    @property
    def size(self) -> int:
        """Total size of all files, bytes."""
        return sum(f.stat().st_size for f in self._files)

    def messages(self, topics: Collection[str] | None = None, start_ns: int | None = None,
                 progress: Progress | None = None) -> Iterator[RawMessage]:
        """Iterate over the messages of `topics` (None: all) from `start_ns` on, file by file, in
        order of log time.

        Messages of a file without an index are in file order. Unreadable parts are counted in
        `losses`. `progress` is called with the number of bytes read since the last call.
        """
        for block in self.blocks(start_ns, progress):
            for m in block:
                if (topics is None or m.topic in topics) and (
                        start_ns is None or m.log_time_ns >= start_ns):
                    yield m

    def blocks(self, start_ns: int | None = None, progress: Progress | None = None
               ) -> Iterator[MessageBlock]:
        """Iterate over blocks of messages, of which some may be before `start_ns`."""
        for file in self._opened:
            for block in file.blocks(start_ns, progress):
                for kind in block.kinds.values():
                    self.types.setdefault(kind.topic, kind.type)
                yield block
                # The bytes of this chunk are freed before the next chunk is read.
                del block


def _files(path: Path) -> list[Path]:
    """Files of a recording, in reading order; raises RecordingError."""
    if not path.exists():
        raise RecordingError(f'{path} does not exist')
    if path.is_file():
        if path.stat().st_size == 0:
            raise RecordingError(f'{path} is empty (0 bytes)')
        return [path]
    metadata = path / 'metadata.yaml'
    files = sorted(f for f in path.iterdir() if f.suffix in SUFFIXES)
    if metadata.exists():
        content = read_yaml(metadata, RecordingError)
        try:
            listed_names = content['rosbag2_bagfile_information']['relative_file_paths']
            files = [path / name for name in listed_names]
        except (KeyError, TypeError) as error:
            raise RecordingError(f'{metadata} is not rosbag2 metadata: relative_file_paths is '
                                 'missing or not a list') from error
    if not files:
        others = sorted(f for f in path.iterdir() if f.is_file())
        hint = f'; {describe_file(others[0])}' if others else ''
        raise RecordingError(f'{path} contains no recording ({", ".join(SUFFIXES)}){hint}')
    return [_listed_file(file) for file in files]


def _listed_file(file: Path) -> Path:
    """Return a file of a folder, or the file that resulted from decompressing it; raises
    RecordingError if neither exists."""
    program = _COMPRESSED_SUFFIXES.get(file.suffix)
    if program is not None and file.with_suffix('').exists():
        return file.with_suffix('')
    if not file.exists():
        raise RecordingError(f'{file} is listed in metadata.yaml but does not exist')
    if program is not None:
        raise RecordingError(f'{file} is compressed with {program} as a whole file: run '
                             f'`un{program} {file}`')
    return file


def _open(file: Path, losses: 'Counter[str]') -> McapFile | BagFile:
    try:
        with open(file, 'rb') as stream:
            head = stream.read(HEAD_SIZE)
        if head.startswith(MCAP_MAGIC):
            return McapFile(file, losses)
        if head.startswith((SQLITE_MAGIC, ROS1_MAGIC)):
            return BagFile(file, losses)
        raise RecordingError(describe_file(file))
    except OSError as error:
        raise RecordingError(f'cannot read {file}: {error.strerror}') from error
