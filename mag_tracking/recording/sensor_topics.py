"""Checks of the topics of sensors: readable messages, timestamps, and one sensor per topic."""

from collections import Counter
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from mag_tracking.errors import RecordingError
from mag_tracking.messages.schema import stamp_ns
from mag_tracking.messages.self_described import UNDECODABLE
from mag_tracking.messages.types import decode
from mag_tracking.recording.raw_message import RawMessage
from mag_tracking.recording.reader import Recording
from mag_tracking.units import NS

N_FIRST_MESSAGES = 200
"""Number of messages by which the topics of a recording are checked before it is read."""
MAX_FIRST_BLOCKS = 50
"""Number of blocks after which the check ends in any case."""
MIN_DATE_S = 1e8
"""Least timestamp that is a date, and not the time since the start of a simulation or a computer
[s since 1970]."""
N_FRAME_CHANGES = 3
"""Number of changes of frame_id after which a topic has several sensors. A driver that was
restarted with another frame changes it once or twice."""


class TopicFindings(NamedTuple):
    """Properties of the topics of sensors."""

    unstamped: frozenset[str]
    """Topics whose first two messages have the timestamp 0. One such message may be the first of
    a simulation."""
    dated: frozenset[str]
    """Topics with timestamps since 1970, on which the timestamp 0 is missing. The timestamps of a
    simulation begin at 0."""
    frames: dict[str, set[str]]
    """The frame_ids of the first messages of each topic."""

    def shared(self, names: Collection[str]) -> frozenset[str]:
        """Topics with the readings of several of the sensors `names`, named by their frame_id."""
        return frozenset(topic for topic, frames in self.frames.items()
                         if len(frames) > 1 and frames <= set(names))


def examine_topics(recording: Recording, topics: Collection[str]) -> TopicFindings:
    """Examine the first messages of the sensors' topics; raises RecordingError if none is
    readable."""
    n_zero: Counter[str] = Counter()
    n_read: Counter[str] = Counter()
    faults: Counter[str] = Counter()
    latest_ns: Counter[str] = Counter()
    frames: dict[str, set[str]] = {}
    for message in islice(_first_messages(recording, topics), N_FIRST_MESSAGES):
        try:
            header = decode(message).header
        except (RecordingError, AttributeError):
            faults[fault_of(message)] += 1
            continue
        n_zero[message.topic] += stamp_ns(header.stamp) == 0 and n_read[message.topic] < 2
        n_read[message.topic] += 1
        latest_ns[message.topic] = max(latest_ns[message.topic], stamp_ns(header.stamp))
        frames.setdefault(message.topic, set()).add(header.frame_id)
    if faults and not n_read:
        (cause, _), = faults.most_common(1)
        raise RecordingError(f'{recording.path}: no message of the sensors can be read: {cause}')
    return TopicFindings(
        frozenset(topic for topic, n in n_zero.items() if n == 2),
        frozenset(topic for topic, ns in latest_ns.items() if ns > MIN_DATE_S * NS), frames)


def _first_messages(recording: Recording, topics: Collection[str]) -> Iterator[RawMessage]:
    """Iterate over the messages on some topics in the first blocks of a recording."""
    for block in islice(recording.blocks(), MAX_FIRST_BLOCKS):
        yield from (message for message in block if message.topic in topics)


def fault_of(message: RawMessage) -> str:
    """Cause for which a message cannot be read."""
    return f'{message.fault or UNDECODABLE} on {message.topic}'


class FrameCheck:
    """Check that each topic has the readings of one sensor."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._frames: dict[str, list[str]] = {}
        self._numbers: dict[str, int] = {}

    def number(self, topic: str) -> int:
        """Number of the latest frame of a topic, as in `FieldArrays.frame`; -1 if it has none
        yet."""
        return self._numbers.get(topic, -1)

    def check(self, topic: str, frame: str, number: int = -1) -> None:
        """Check the frame of a reading, and store its number; raises RecordingError if the topic
        alternates between frames."""
        self._numbers[topic] = number
        frames = self._frames.setdefault(topic, [frame])
        if frame == frames[-1]:
            return
        is_new = frame not in frames
        frames.append(frame)
        if not is_new and len(frames) > N_FRAME_CHANGES:
            names = ', '.join(sorted(set(frames)))
            raise RecordingError(
                f'{self._path}: {topic} carries several sensors, with the frame_ids {names}: '
                'name the sensors of the network file as the frame_ids, or record each sensor on a '
                'topic of its own')
