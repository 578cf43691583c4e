"""Blocks of messages: their bytes, and arrays of their channels, log times and byte positions."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from mcap.records import Schema

from mag_tracking.arrays import IntArray
from mag_tracking.messages.self_described import SUPPORTED_ENCODINGS, cdr_of, type_of
from mag_tracking.messages.types import schema_of
from mag_tracking.recording.raw_message import RawMessage


class ChannelKind(NamedTuple):
    """Topic and type of the messages of a channel."""

    topic: str
    """Name of the topic."""
    type: str
    """Message type. A magnetic field in JSON or protobuf has the type sensor_msgs/MagneticField."""
    schema: Schema
    """Schema in the file."""
    is_cdr: bool
    """Whether the messages are encoded as CDR. Other encodings must be converted."""

    @classmethod
    def of(cls, topic: str, schema: Schema) -> 'ChannelKind':
        """Describe a channel by its topic and the schema in the file.

        Parameters
        ----------
        topic : str
        schema : Schema

        Returns
        -------
        ChannelKind
        """
        kind = type_of(schema) if schema.encoding in SUPPORTED_ENCODINGS else schema.name
        return cls(topic, kind, schema, kind == schema.name)


@dataclass(frozen=True)
class MessageBlock:
    """Block of messages in order of log time."""

    data: bytes
    """Bytes of all messages."""
    kinds: Mapping[int, ChannelKind]
    """Topic and type by channel number."""
    channel: IntArray
    """Channel number of each message, (n,)."""
    log_time_ns: IntArray
    """Log time of each message, (n,) ns."""
    begin: IntArray
    """Index in `data` of the first byte of each message, (n,)."""
    end: IntArray
    """Index in `data` after the last byte of each message, (n,)."""

    @classmethod
    def of_rows(cls, data: bytes, kinds: Mapping[int, ChannelKind],
                rows: IntArray) -> 'MessageBlock':
        """Create a block from the positions of messages.

        Parameters
        ----------
        data : bytes
        kinds : mapping of int to ChannelKind
        rows : (n, 4) int array
            Channel, log time [ns], and begin and end in `data`; one row per message, in any order.

        Returns
        -------
        MessageBlock
        """
        block = cls(data, kinds, *np.ascontiguousarray(rows.T))
        if np.all(rows[1:, 1] >= rows[:-1, 1]):
            return block
        return block.part(np.argsort(block.log_time_ns, kind='stable'))

    @classmethod
    def of_messages(cls, messages: Sequence[RawMessage]) -> 'MessageBlock':
        """Create a block from individual messages.

        Parameters
        ----------
        messages : sequence of RawMessage
            In order of log time.

        Returns
        -------
        MessageBlock
        """
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
        """Return one message, converted to CDR.

        Parameters
        ----------
        k : int
            Index in the block.

        Returns
        -------
        RawMessage
        """
        topic, kind, schema, is_cdr = self.kinds[int(self.channel[k])]
        data = self.data[self.begin[k]:self.end[k]]
        if not is_cdr:
            data, schema = cdr_of(schema, data), schema_of(kind)
        return RawMessage(topic, kind, int(self.log_time_ns[k]), data, schema)

    def part(self, selection: IntArray | slice) -> 'MessageBlock':
        """Select messages.

        Parameters
        ----------
        selection : int array or slice
            Indices of the messages. The order of the indices is kept.

        Returns
        -------
        MessageBlock
        """
        return MessageBlock(self.data, self.kinds, self.channel[selection],
                            self.log_time_ns[selection], self.begin[selection], self.end[selection])

    def with_used_kinds(self) -> 'MessageBlock':
        """Copy the block without the channels that have no messages in it.

        Returns
        -------
        MessageBlock
        """
        return replace(self, kinds={n: self.kinds[n] for n in np.unique(self.channel).tolist()})

    def merged(self, other: 'MessageBlock') -> 'MessageBlock':
        """Merge this block with another block of the same file, in order of log time.

        Parameters
        ----------
        other : MessageBlock

        Returns
        -------
        MessageBlock
        """
        if not len(self):
            return other
        # Few messages remain from the previous chunk, so only their bytes are kept.
        remaining = [self.data[b:e] for b, e in zip(self.begin, self.end, strict=True)]
        length = np.array([len(m) for m in remaining], dtype=np.int64)
        end = len(other.data) + np.cumsum(length)
        block = MessageBlock(
            other.data + b''.join(remaining), other.kinds, *(
                np.concatenate(pair) for pair in (
                    (self.channel, other.channel), (self.log_time_ns, other.log_time_ns),
                    (end - length, other.begin), (end, other.end))))
        return block.part(np.argsort(block.log_time_ns, kind='stable'))
