"""Extraction of readings, accelerations and true poses from a recording."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mag_tracking.analysis.track_errors import Truth
from mag_tracking.arrays import IntArray
from mag_tracking.errors import RecordingError
from mag_tracking.messages.encodings import UNDECODABLE
from mag_tracking.messages.message_arrays import magnetic_fields
from mag_tracking.messages.schema import (
    MagneticField,
    acceleration_of,
    reading_of,
    readings_of,
    stamp_ns,
)
from mag_tracking.messages.types import (
    FIELD_READINGS,
    IMU,
    MAGNETIC_FIELD,
    RAW_READINGS,
    RawMessage,
    decode,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.network.sensor_network import absolute, namespaces_of
from mag_tracking.recording.message_block import MessageBlock, Progress
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.truth import TRUTH_TYPES, TruthTopics
from mag_tracking.records import AccelerationSample, Readings
from mag_tracking.stages.health.clocks import ZERO_STAMP, ClockSpan
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
TRUTH_PREFIX = 'ground_truth/'
"""Prefix of topics with true poses, in the namespace of the sensors. Truth is used for reports,
never for tracking."""
BATCH_SIZE = 256
"""Maximum number of messages per batch of readings. The overhead of a batch equals the cost of a
few readings. The caller can stop only between batches."""
MAX_UNKNOWN_SENSORS = 20
MAX_TOPICS = 10


class TopicFindings(NamedTuple):
    """Properties of the topics of sensors."""

    unstamped: frozenset[str]
    """Topics whose first two messages have the timestamp 0. One such message may be the first of
    a simulation."""
    dated: frozenset[str]
    """Topics with timestamps since 1970, on which the timestamp 0 is missing. The timestamps of a
    simulation begin at 0."""
    frames: dict[str, set[str]]

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
    messages = (message for block in islice(recording.blocks(), MAX_FIRST_BLOCKS)
                for message in block if message.topic in topics)
    for message in islice(messages, N_FIRST_MESSAGES):
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


class SampleReader:
    """Iterates over the readings of a network in a recording and collects the true poses.

    `truth` is the topic of the true poses, by default all below `TRUTH_PREFIX`. Raises
    RecordingError if the recording contains no topic of the network, its namespace is ambiguous,
    `truth` is not a topic with poses, or the messages of the sensors have another type or encoding.

    Attributes
    ----------
    rejected : number of messages and readings that cannot be used, or not as they are, by cause
    clocks : first and last timestamp of each sensor so far, with their log times
    namespace : namespace of the network's relative topics in the recording
    """

    def __init__(self, recording: Recording, network: SensorNetwork,
                 truth: str | None = None) -> None:
        self._recording = recording
        self.namespace = _namespace(recording, network)
        self._sensors = {absolute(topic, self.namespace): name for topic, name in zip(
            network.topics, network.names, strict=True)}
        self._imus: dict[str, list[str]] = {}
        for topic, name in zip(network.imu_topics, network.names, strict=True):
            if topic is not None:
                self._imus.setdefault(absolute(topic, self.namespace), []).append(name)
        self._batch_topic = absolute(RAW_READINGS, self.namespace)
        truth = None if truth is None else absolute(truth, self.namespace)
        self._truth = TruthTopics(absolute(TRUTH_PREFIX, self.namespace), network.frame, truth)
        if truth is not None and recording.types and not self._truth.accepts(
                truth, recording.types.get(truth, '')):
            pose_topics = sorted(t for t, kind in recording.types.items() if kind in TRUTH_TYPES)
            raise RecordingError(f'{recording.path}: the truth topic {truth} has no poses: it is '
                                 f'{recording.types.get(truth, "not in the recording")}; '
                                 f'topics with poses: {", ".join(pose_topics) or "none found"}')
        self.rejected: Counter[str] = Counter()
        self._unknown_sensors: set[str] = set()
        self.clocks: dict[str, ClockSpan] = {}
        self._is_batched = recording.types.get(self._batch_topic) == FIELD_READINGS
        self._frames = FrameCheck(recording.path)
        self._found = self._examine_topics(network)
        self._shared = self._found.shared(network.names)

    def _examine_topics(self, network: SensorNetwork) -> TopicFindings:
        """Check the types and the first messages of the topics."""
        types = self._recording.types
        topics = [topic for topic in self._sensors if topic in types]
        for topic in topics:
            if types[topic] != MAGNETIC_FIELD:
                raise RecordingError(f'{self._recording.path}: {topic} carries {types[topic]}, not '
                                     f'{MAGNETIC_FIELD} in tesla: convert the messages')
        if self._is_batched:
            return TopicFindings(frozenset(), frozenset(), {})
        found = examine_topics(self._recording, topics or [
            topic for topic, kind in types.items() if kind == MAGNETIC_FIELD])
        if types and not topics and not found.shared(network.names):
            raise RecordingError(
                f'{self._recording.path} has none of the network\'s topics '
                f'({", ".join(self._sensors)}); {_candidates(types, found.frames)}')
        return found

    def missing_topics(self) -> list[str]:
        """Topics of the network that are not in the recording; none if one topic carries several
        sensors."""
        if self._is_batched or self._shared:
            return []
        return [t for t in self._sensors if t not in self._recording.types]

    def readings(self, progress: Progress | None = None) -> Iterator[Readings]:
        """Iterate over batches of readings in order of log time."""
        for block in self._recording.blocks(progress=progress):
            for first in range(0, len(block), BATCH_SIZE):
                # A recording may have thousands of other topics.
                part = block.part(slice(first, first + BATCH_SIZE)).with_used_kinds()
                readings = self._block_readings(part)
                if len(readings):
                    yield readings
            # The bytes of this chunk are freed before the next chunk is read.
            del block

    def _block_readings(self, block: MessageBlock) -> Readings:
        """Decode the readings in a block, in order of log time, and collect the true poses."""
        names = {number: self._sensors[kind.topic] for number, kind in block.kinds.items()
                 if kind.topic in self._sensors and kind.type == MAGNETIC_FIELD and kind.is_cdr
                 and kind.topic not in self._shared}
        rows = np.flatnonzero(np.isin(block.channel, list(names)))
        fields = magnetic_fields(block.data, block.begin[rows], block.end[rows])
        # Messages without a timestamp are decoded individually.
        is_fast = fields.is_decoded & (fields.stamp_ns != 0)
        rows = rows[is_fast]
        # The same sensor may have several channels.
        sensors = tuple(dict.fromkeys(names.values()))
        sensor_index = np.zeros(max(names, default=0) + 1, dtype=np.int64)
        sensor_index[list(names)] = [sensors.index(name) for name in names.values()]
        self._check_frames(block, rows, fields.frame[is_fast])
        C = fields.covariance
        batch = Readings(
            sensors, sensor_index[block.channel[rows]], fields.stamp_ns[is_fast],
            fields.field[is_fast], None if C is None else C[is_fast])
        self._note_clocks(batch, block.log_time_ns[rows])
        other_messages = np.setdiff1d(np.arange(len(block)),
                                      np.append(rows, self._truth.add_block(block)))
        parts, n_added = [], 0
        for k in other_messages:
            for record, _ in self._records([block.message(k)], {}):
                if isinstance(record, Readings):
                    n = int(np.searchsorted(rows, k))
                    parts += [batch.part(slice(n_added, n)), record]
                    n_added = n
        return Readings.joined([*parts, batch.part(slice(n_added, None))])

    def _check_frames(self, block: MessageBlock, rows: IntArray, frames: IntArray) -> None:
        """Check the frames, numbered (k,), of the messages `rows` (k,) of a block."""
        expected = np.full(max(block.kinds, default=0) + 1, -1, dtype=np.int64)
        for number, kind in block.kinds.items():
            expected[number] = self._frames.number(kind.topic)
        for i in np.flatnonzero(frames != expected[block.channel[rows]]):
            message = block.message(int(rows[i]))
            self._frames.check(message.topic, decode(message).header.frame_id, int(frames[i]))

    def readings_as_received(self, progress: Progress | None = None
                             ) -> Iterator[tuple[Readings, int]]:
        """Iterate over (readings, log time [ns]) of each message, in order of log time."""
        for record, log_time_ns in self._records(self._recording.messages(progress=progress), {}):
            if isinstance(record, Readings):
                yield record, log_time_ns

    def readings_and_accelerations(self, progress: Progress | None = None
                                   ) -> Iterator[Readings | AccelerationSample]:
        """Iterate over readings and accelerations message by message, in order of log time."""
        messages = self._recording.messages(progress=progress)
        return (record for record, _ in self._records(messages, self._imus))

    def _records(self, messages: Iterable[RawMessage], imus: Mapping[str, Sequence[str]]
                 ) -> Iterator[tuple[Readings | AccelerationSample, int]]:
        """Decode messages to (record, log time [ns]), collect the true poses, and count the
        messages that cannot be decoded; `imus` maps topics of accelerations to sensors."""
        for message in messages:
            sensor = self._sensors.get(message.topic)
            is_truth = self._truth.accepts(message.topic, message.type)
            is_batch = message.topic == self._batch_topic and message.type == FIELD_READINGS
            imu_sensors = imus.get(message.topic) if message.type == IMU else None
            is_shared = message.topic in self._shared
            if sensor is None and not (is_shared or imu_sensors or is_truth or is_batch):
                continue
            try:
                if (sensor is not None or is_shared) and message.type != MAGNETIC_FIELD:
                    raise RecordingError(f'{message.topic} carries {message.type}')
                content = decode(message)
                readings = readings_of(content) if is_batch else None
            except RecordingError:
                self.rejected[fault_of(message)] += 1
                continue
            if is_truth:
                self._truth.add(message.topic, content)
            elif readings is not None:
                readings = self._network_readings(readings)
                self._note_clocks(readings, np.full(len(readings), message.log_time_ns))
                yield readings, message.log_time_ns
            elif imu_sensors is not None:
                for name in imu_sensors:
                    yield acceleration_of(content, name), message.log_time_ns
            elif sensor is not None or is_shared:
                frame = content.header.frame_id
                if not is_shared:
                    self._frames.check(message.topic, frame)
                yield from self._single(content, frame if sensor is None or is_shared else sensor,
                                        message)

    def _single(self, content: MagneticField, sensor: str, message: RawMessage
                ) -> Iterator[tuple[Readings, int]]:
        """Convert a decoded message unless its sensor is not in the network or its time is
        missing."""
        reading = self._network_readings(reading_of(content, sensor))
        if not reading.stamp_ns.all():
            cause = f'{ZERO_STAMP} on {message.topic}'
            if message.topic in self._found.unstamped:
                self.rejected[f'{cause}, read with its log time'] += 1
                reading = replace(reading, stamp_ns=np.array([message.log_time_ns]))
            elif message.topic in self._found.dated:
                self.rejected[cause] += 1
                return
        if len(reading):
            self._note_clocks(reading, np.array([message.log_time_ns]))
            yield reading, message.log_time_ns

    def _note_clocks(self, readings: Readings, log_time_ns: IntArray) -> None:
        """Extend the clock of each sensor by readings, which were logged at `log_time_ns` (n,)."""
        for j in np.unique(readings.sensor).tolist():
            stamps, received = readings.stamp_ns, log_time_ns
            if len(readings.names) > 1:
                is_own = readings.sensor == j
                stamps, received = stamps[is_own], received[is_own]
            span = ClockSpan.of(stamps, received)
            earlier = self.clocks.get(readings.names[j], span)
            self.clocks[readings.names[j]] = earlier.until(span)

    def _network_readings(self, readings: Readings) -> Readings:
        """Select the readings of the network's sensors, and count readings of other sensors."""
        network_sensors = set(self._sensors.values())
        is_known = np.array([name in network_sensors for name in readings.names],
                            dtype=bool)[readings.sensor]
        if is_known.all():
            return readings
        for name in readings.part(~is_known).sensor_names():
            if len(self._unknown_sensors) < MAX_UNKNOWN_SENSORS:
                self._unknown_sensors.add(name)
            label = name if name in self._unknown_sensors else 'another sensor'
            self.rejected[f'reading of {label}, which is not in the network'] += 1
        return readings.part(is_known)

    def truth_arrays(self) -> dict[str, Truth]:
        """True poses read so far, by target; adds the counts of rejected poses to `rejected`."""
        self.rejected.update(self._truth.rejected)
        self._truth.rejected.clear()
        return self._truth.arrays()


def _candidates(types: Mapping[str, str], frames: Mapping[str, set[str]]) -> str:
    """Format the topics with magnetic fields and several `frames`, or else all topics."""
    fields = [topic + (f' (with the frame_ids {", ".join(sorted(frames[topic]))})'
                       if len(frames.get(topic, ())) > 1 else '')
              for topic, kind in sorted(types.items()) if kind == MAGNETIC_FIELD]
    topics = [f'{topic} ({kind})' for topic, kind in sorted(types.items())[:MAX_TOPICS]]
    return f'topics with magnetic fields: {", ".join(fields)}' if fields else \
        f'topics with magnetic fields: none found; topics: {", ".join(topics)}'


def _namespace(recording: Recording, network: SensorNetwork) -> str:
    """Namespace of the network's relative topics: configured, found in the recording, or '/';
    raises RecordingError if the recording has several."""
    if network.namespace is not None:
        return network.namespace
    names = [name for name, kind in recording.types.items()
             if kind in (MAGNETIC_FIELD, FIELD_READINGS)]
    found = namespaces_of((*network.topics, RAW_READINGS), names)
    if len(found) > 1:
        raise RecordingError(f'{recording.path} has the topics of the network in the namespaces '
                             f'{", ".join(found)}: choose one with --namespace')
    return found[0] if found else '/'
