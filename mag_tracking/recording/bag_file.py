"""Reader of one SQLite bag (`.db3`) or ROS 1 bag (`.bag`), with the library `rosbags`."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.errors import RecordingError
from mag_tracking.messages.definitions import DEFINITIONS
from mag_tracking.messages.types import encoder, schema_of
from mag_tracking.recording.decode_errors import DECODE_ERRORS
from mag_tracking.recording.interruptible import Progress
from mag_tracking.recording.message_block import MessageBlock
from mag_tracking.recording.raw_message import RawMessage

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
    from rosbags.typesys.store import Typestore

ROS1_SUFFIX = '.bag'
BAG_SUFFIXES = ('.db3', ROS1_SUFFIX)
BLOCK_SIZE = 256
"""Number of messages that are read at once."""


class BagFile:
    """Reader of one bag of a recording.

    Parameters
    ----------
    path : Path
    losses : Counter
        Number of unreadable parts by description, updated in place.

    Attributes
    ----------
    types : dict of str to str
        Message type by topic.
    message_counts : Counter
        Number of messages by topic.
    start_ns, end_ns : int, ns, or None
        Log times of the first and last message. None if the bag has no messages.

    Raises
    ------
    RecordingError
        If the file cannot be read as a bag.
    """

    def __init__(self, path: Path, losses: 'Counter[str]') -> None:
        self._path, self._is_ros1, self._losses = path, path.suffix == ROS1_SUFFIX, losses
        self.types: dict[str, str] = {}
        self.message_counts: Counter[str] = Counter()
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        with self._open_reader() as reader:
            for connection in reader.connections:
                self.types[connection.topic] = connection.msgtype
                self.message_counts[connection.topic] += connection.msgcount
            time_range = reader if self._is_ros1 else reader.metadata
            if self.message_counts.total():
                # The end time of the library is one nanosecond after the last message.
                self.start_ns, self.end_ns = time_range.start_time, time_range.end_time - 1

    def _open_reader(self) -> AbstractContextManager[Any]:
        """Open the bag with the reader of `rosbags`; raises RecordingError."""
        try:
            reader = self._new_reader()
            reader.open()
        except bag_errors() as error:
            raise RecordingError(f'{self._path} cannot be read as a bag: {error}') from error
        return closing(reader)

    def _new_reader(self) -> 'Ros1Reader | Sqlite3Reader':
        """Create the reader of `rosbags` for this type of bag."""
        # Imported here because most recordings are MCAP and do not need the library.
        if self._is_ros1:
            from rosbags.rosbag1 import Reader

            return Reader(self._path)
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        return Sqlite3Reader(self._path)

    def blocks(self, start_ns: int | None = None,
               progress: Progress | None = None) -> Iterator[MessageBlock]:
        """Iterate over blocks of CDR messages in order of log time.

        Parameters
        ----------
        start_ns : int, ns, optional
            Skip messages that were logged earlier.
        progress : callable, optional
            Called with the number of bytes read since the last call.

        Yields
        ------
        MessageBlock
        """
        size, total, reported, n = self._path.stat().st_size, self.message_counts.total(), 0, 0
        raw = self._raw(start_ns)
        while messages := list(islice(raw, BLOCK_SIZE)):
            yield MessageBlock.of_messages([
                RawMessage(topic, kind, log_time_ns,
                           cdr_of_ros1(data, kind) if self._is_ros1 else data, schema_of(kind))
                for topic, kind, log_time_ns, data in messages])
            n += len(messages)
            if progress and (position := size * n // total) > reported:
                progress(position - reported)
                reported = position

    def _raw(self, start_ns: int | None) -> Iterator[tuple[str, str, int, bytes]]:
        """Iterate over (topic, type, log time [ns], bytes) up to the first damage, if any.

        The damage is counted in `losses`.
        """
        n = 0
        with self._open_reader() as reader:
            try:
                for connection, log_time_ns, data in reader.messages(reader.connections, start_ns):
                    n += 1
                    yield connection.topic, connection.msgtype, log_time_ns, bytes(data)
            except bag_errors():
                self._losses[f'partially read files ({self._path.name}, up to message {n} of '
                             f'{self.message_counts.total()})'] = 1


@functools.cache
def bag_errors() -> tuple[type[Exception], ...]:
    """Exceptions that `rosbags` raises for damaged or invalid bags.

    Returns
    -------
    tuple of exception types
    """
    import apsw
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError
    from rosbags.serde import SerdeError

    # Damaged bytes can also trigger assertions of the library.
    return (Ros1Error, ReaderError, SerdeError, apsw.Error, OSError, AssertionError, IndexError,
            TypeError, OverflowError, *DECODE_ERRORS)


def cdr_of_ros1(data: bytes, type_name: str) -> bytes:
    """Convert a serialised ROS 1 message to CDR.

    Parameters
    ----------
    data : bytes
    type_name : str

    Returns
    -------
    bytes
        Empty if the message is damaged or its type is not supported.
    """
    if type_name not in DEFINITIONS:
        return b''
    try:
        message = _ros1_types().deserialize_ros1(data, type_name)
    except bag_errors():
        return b''
    return encoder(type_name)(_as_dicts(message))


@functools.cache
def _ros1_types() -> 'Typestore':
    """Definitions of the ROS 1 message types, for `rosbags`."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)


def _as_dicts(value: Any) -> Any:
    """Convert a message to nested dicts."""
    if dataclasses.is_dataclass(value):
        return {f.name: _as_dicts(getattr(value, f.name)) for f in dataclasses.fields(value)
                if not f.name.startswith('__')}
    return value.tolist() if isinstance(value, np.ndarray) else value
