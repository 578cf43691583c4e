"""Messages of a recording in blocks, and reading that can be stopped."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np
from mcap.records import Schema

from mag_tracking.arrays import IntArray
from mag_tracking.messages.encodings import CDR, cdr_of
from mag_tracking.messages.types import ROS_SCHEMA, RawMessage, schema_of
from mag_tracking.recording.expansion import expanded_message

Progress: TypeAlias = Callable[[int], object]
"""Function that is called with the number of bytes read since the last call."""
_Item = TypeVar('_Item')


class ReadingStopped(Exception):
    """Raised when the caller stops the reading."""


def until_stopped(read: Callable[[Progress], Iterator[_Item]], progress: Progress | None = None,
                  stopped: Callable[[], bool] | None = None) -> Iterator[_Item]:
    """Iterate over the items of `read`, until `stopped` returns true after an item or a report of
    its `Progress` argument; ReadingStopped is raised then."""
    def advance(n: int) -> None:
        if progress is not None:
            progress(n)
        check()

    def check() -> None:
        if stopped is not None and stopped():
            raise ReadingStopped

    for item in read(advance):
        yield item
        check()


class ChannelKind(NamedTuple):
    """Topic and type of the messages of a channel."""

    topic: str
    type: str
    schema: Schema
    encoding: str = CDR

    @property
    def is_cdr(self) -> bool:
        """Whether the messages are encoded as CDR."""
        return self.encoding == CDR


class RecordingFile:
    """One file of a recording, with attributes of `Recording`; `losses` is updated in place."""

    def __init__(self, path: Path, losses: Counter[str]) -> None:
        self._path, self._losses = path, losses
        self._lost_offsets: set[int] = set()
        self.types: dict[str, str] = {}
        self.message_counts: Counter[str] = Counter()
        self.start_ns: int | None = None
        self.end_ns: int | None = None

    def _count_loss(self, offset: int, description: str, n: int = 1) -> None:
        """Count the unreadable part at byte `offset`, unless it has already been counted."""
        if offset not in self._lost_offsets:
            self._lost_offsets.add(offset)
            self._losses[description] += n


@dataclass(frozen=True)
class MessageBlock:
    """Block of messages in order of log time."""

    data: bytes
    kinds: Mapping[int, ChannelKind]
    """Topic and type by channel number."""
    channel: IntArray
    """Channel number of each message, (n,)."""
    log_time_ns: IntArray
    begin: IntArray
    """Index in `data` of the first byte of each message, (n,)."""
    end: IntArray
    """Index in `data` after the last byte of each message, (n,)."""

    @classmethod
    def of_rows(cls, data: bytes, kinds: Mapping[int, ChannelKind],
                rows: IntArray) -> 'MessageBlock':
        """Create a block of rows (n, 4) in any order: channel, log time [ns], begin and end."""
        block = cls(data, kinds, *np.ascontiguousarray(rows.T))
        if np.all(rows[1:, 1] >= rows[:-1, 1]):
            return block
        return block.part(np.argsort(block.log_time_ns, kind='stable'))

    @classmethod
    def of_messages(cls, messages: Sequence[RawMessage]) -> 'MessageBlock':
        """Create a block from messages in order of log time."""
        numbers: dict[tuple[str, str], int] = {}
        kinds: dict[int, ChannelKind] = {}
        channel = []
        for m in messages:
            number = numbers.setdefault((m.topic, m.type), len(numbers))
            kinds.setdefault(number, ChannelKind(m.topic, m.type, m.schema))
            channel.append(number)
        end = np.cumsum([len(m.data) for m in messages], dtype=np.int64)
        begin = np.append(0, end[:-1])[:len(messages)]
        return cls(b''.join(m.data for m in messages), kinds, np.array(channel, dtype=np.int64),
                   np.array([m.log_time_ns for m in messages], dtype=np.int64), begin, end)

    def __len__(self) -> int:
        return len(self.channel)

    def __iter__(self) -> Iterator[RawMessage]:
        return (self.message(k) for k in range(len(self)))

    def message(self, k: int) -> RawMessage:
        """Return message `k` of the block, converted to CDR."""
        topic, kind, schema, encoding = self.kinds[int(self.channel[k])]
        stored = self.data[self.begin[k]:self.end[k]]
        data, fault = cdr_of(encoding, kind, schema,
                             expanded_message(stored) if encoding == CDR else stored)
        is_defined = encoding == CDR and schema.encoding == ROS_SCHEMA
        return RawMessage(topic, kind, int(self.log_time_ns[k]), data,
                          schema if is_defined else schema_of(kind), fault)

    def part(self, selection: IntArray | slice) -> 'MessageBlock':
        """Select messages by index, in the order of the indices."""
        return MessageBlock(self.data, self.kinds, self.channel[selection],
                            self.log_time_ns[selection], self.begin[selection], self.end[selection])

    def with_used_kinds(self) -> 'MessageBlock':
        """Copy the block without the channels that have no messages in it."""
        return replace(self, kinds={n: self.kinds[n] for n in np.unique(self.channel).tolist()})

    def merged(self, other: 'MessageBlock') -> 'MessageBlock':
        """Merge this block with another block of the same file, in order of log time."""
        if not len(self):
            return other
        shift = len(other.data)
        block = MessageBlock(
            other.data + self.data, other.kinds, *(
                np.concatenate(pair) for pair in (
                    (self.channel, other.channel), (self.log_time_ns, other.log_time_ns),
                    (self.begin + shift, other.begin), (self.end + shift, other.end))))
        return block.part(np.argsort(block.log_time_ns, kind='stable'))

    def compacted(self) -> 'MessageBlock':
        """Copy the messages, so that the bytes of other messages can be freed."""
        end = np.cumsum(self.end - self.begin, dtype=np.int64)
        return MessageBlock(
            b''.join(self.data[b:e] for b, e in zip(self.begin, self.end, strict=True)),
            self.kinds, self.channel, self.log_time_ns, end - (self.end - self.begin), end)
