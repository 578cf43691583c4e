"""Messages that are read at once: rows of arrays over their bytes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from mcap.records import Schema

from mag_tracking.arrays import IntArray
from mag_tracking.messages.self_described import SCHEMAS, cdr_of, type_of
from mag_tracking.messages.types import schema_of
from mag_tracking.recording.raw_message import RawMessage


class ChannelKind(NamedTuple):
    """What the messages of a channel are."""

    topic: str
    type: str
    """A magnetic field in JSON or protobuf counts as sensor_msgs/MagneticField."""
    schema: Schema
    is_cdr: bool
    """False: the bytes have to be turned into CDR."""

    @classmethod
    def of(cls, topic: str, schema: Schema) -> 'ChannelKind':
        """Of a channel in a file."""
        kind = type_of(schema) if schema.encoding in SCHEMAS else schema.name
        return cls(topic, kind, schema, kind == schema.name)


@dataclass(frozen=True)
class MessageBlock:
    """Messages in order of log time."""

    data: bytes
    kinds: Mapping[int, ChannelKind]
    """By the number of a channel."""
    channel: IntArray
    """(n,) channel of each message."""
    log_time_ns: IntArray
    """(n,)"""
    begin: IntArray
    end: IntArray
    """(n,) where its bytes are in `data`."""

    @classmethod
    def of_rows(cls, data: bytes, kinds: Mapping[int, ChannelKind],
                rows: IntArray) -> 'MessageBlock':
        """Of (n, 4) channel, log time, begin and end, in any order."""
        block = cls(data, kinds, *np.ascontiguousarray(rows.T))
        if np.all(rows[1:, 1] >= rows[:-1, 1]):
            return block
        return block.part(np.argsort(block.log_time_ns, kind='stable'))

    @classmethod
    def of_messages(cls, messages: Sequence[RawMessage]) -> 'MessageBlock':
        """Of messages in order of log time."""
        numbers: dict[tuple[str, str], int] = {}
        kinds: dict[int, ChannelKind] = {}
        channel = []
        for m in messages:
            number = numbers.setdefault((m.topic, m.type), len(numbers))
            kinds.setdefault(number, ChannelKind(m.topic, m.type, m.schema, True))
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
        """The message of a row."""
        topic, kind, schema, is_cdr = self.kinds[int(self.channel[k])]
        data = self.data[self.begin[k]:self.end[k]]
        if not is_cdr:
            data, schema = cdr_of(schema, data), schema_of(kind)
        return RawMessage(topic, kind, int(self.log_time_ns[k]), data, schema)

    def part(self, which: IntArray | slice) -> 'MessageBlock':
        """The messages of some of the rows, in that order."""
        return MessageBlock(self.data, self.kinds, self.channel[which], self.log_time_ns[which],
                            self.begin[which], self.end[which])

    def merged(self, other: 'MessageBlock') -> 'MessageBlock':
        """With those of another one of the same file, in order of log time."""
        if not len(self):
            return other
        # Few are left from the chunk before: only their bytes are kept.
        kept = [self.data[b:e] for b, e in zip(self.begin, self.end, strict=True)]
        size = np.array([len(m) for m in kept], dtype=np.int64)
        end = len(other.data) + np.cumsum(size)
        both = MessageBlock(
            other.data + b''.join(kept), other.kinds, *(
                np.concatenate(pair) for pair in (
                    (self.channel, other.channel), (self.log_time_ns, other.log_time_ns),
                    (end - size, other.begin), (end, other.end))))
        return both.part(np.argsort(both.log_time_ns, kind='stable'))
