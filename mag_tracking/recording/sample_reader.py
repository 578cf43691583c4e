"""From a recording to readings and truth."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from mag_tracking.errors import RecordingError
from mag_tracking.messages.message_arrays import magnetic_fields
from mag_tracking.messages.schema import acceleration_of, reading_of, readings_of
from mag_tracking.messages.types import (
    FIELD_READINGS,
    IMU,
    MAGNETIC_FIELD,
    RAW_READINGS,
    decode,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.network.topics import absolute, namespaces_of
from mag_tracking.recording.interruptible import Progress
from mag_tracking.recording.message_block import MessageBlock
from mag_tracking.recording.raw_message import RawMessage
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.truth import TRUTH_TYPES, TruthTopics
from mag_tracking.records import AccelerationSample, Readings
from mag_tracking.report.metrics import Truth

TRUTH_PREFIX = 'ground_truth/'
"""Poses on topics below this, in the namespace of the sensors, are truth: for reports, never for
tracking."""
GATHERED = 256
"""Messages at most whose readings are gathered in one batch: each batch costs as much as a few
readings, and a reader may want to stop after any."""


class SampleReader:
    """Iterates over the readings of a network in a recording; collects the truth beside them.

    Attributes
    ----------
    rejected : Counter
        {cause: number} of messages and readings that cannot be used.
    namespace : str
        Of the network's relative topics in the recording.
    """

    def __init__(self, recording: Recording, network: SensorNetwork,
                 truth: str | None = None) -> None:
        """Raises RecordingError where the recording has none of the network's topics, or nothing
        that can be `truth`, the name of a topic.
        """
        self._recording = recording
        self.namespace = _namespace(recording, network)
        self._sensors = {absolute(topic, self.namespace): name for topic, name in zip(
            network.topics, network.names, strict=True)}
        self._imus: dict[str, list[str]] = {}
        for topic, name in zip(network.imu_topics, network.names, strict=True):
            if topic is not None:
                self._imus.setdefault(absolute(topic, self.namespace), []).append(name)
        self._many = absolute(RAW_READINGS, self.namespace)
        truth = None if truth is None else absolute(truth, self.namespace)
        self._truth = TruthTopics(absolute(TRUTH_PREFIX, self.namespace), network.frame, truth)
        if truth is not None and recording.types and not self._truth.wants(
                truth, recording.types.get(truth, '')):
            poses = sorted(t for t, kind in recording.types.items() if kind in TRUTH_TYPES)
            raise RecordingError(f'{recording.path}: the truth on {truth} is '
                                 f'{recording.types.get(truth, "not in the recording")}; its poses '
                                 f'are on: {", ".join(poses) or "no topic at all"}')
        self.rejected: Counter[str] = Counter()
        self._together = recording.types.get(self._many) == FIELD_READINGS
        if recording.types and not self._together \
                and not any(t in recording.types for t in self._sensors):
            fields = sorted(t for t, k in recording.types.items() if k == MAGNETIC_FIELD)
            raise RecordingError(
                f'{recording.path} has none of the network\'s topics ({", ".join(self._sensors)}); '
                f'its magnetic fields are on: {", ".join(fields) or "no topic at all"}')
        for topic in self._sensors:
            kind = recording.types.get(topic)
            if kind not in (None, MAGNETIC_FIELD):
                raise RecordingError(f'{recording.path}: {topic} carries {kind}, '
                                     f'not {MAGNETIC_FIELD}')

    def missing_topics(self) -> list[str]:
        """The network's topics that are not in the recording; none where readings came together."""
        if self._together:
            return []
        return [t for t in self._sensors if t not in self._recording.types]

    def readings(self, progress: Progress | None = None) -> Iterator[Readings]:
        """Iterate over batches of `Readings` in order of log time; see `Recording.messages`."""
        for block in self._recording.blocks(progress=progress):
            for first in range(0, len(block), GATHERED):
                readings = self._of_block(block.part(slice(first, first + GATHERED)))
                if len(readings):
                    yield readings

    def _of_block(self, block: MessageBlock) -> Readings:
        """`Readings` of all messages that are of the network's sensors, in their order."""
        names = {number: self._sensors[kind.topic] for number, kind in block.kinds.items()
                 if kind.topic in self._sensors and kind.type == MAGNETIC_FIELD and kind.is_cdr}
        rows = np.flatnonzero(np.isin(block.channel, list(names)))
        fields = magnetic_fields(block.data, block.begin[rows], block.end[rows])
        rows = rows[fields.is_decoded]
        # A sensor may have several channels.
        sensors = tuple(dict.fromkeys(names.values()))
        place = np.zeros(max(names, default=0) + 1, dtype=np.int64)
        place[list(names)] = [sensors.index(name) for name in names.values()]
        C = fields.covariance
        together = Readings(
            sensors, place[block.channel[rows]], fields.stamp_ns[fields.is_decoded],
            fields.field[fields.is_decoded], None if C is None else C[fields.is_decoded])
        others = np.setdiff1d(np.arange(len(block)), np.append(rows, self._truth.take(block)))
        parts, done = [], 0
        for k in others:
            for record, _ in self._records_of([block.message(k)], {}):
                if isinstance(record, Readings):
                    n = int(np.searchsorted(rows, k))
                    parts += [together.part(slice(done, n)), record]
                    done = n
        return Readings.joined([*parts, together.part(slice(done, None))])

    def readings_as_received(self, progress: Progress | None = None
                             ) -> Iterator[tuple[Readings, int]]:
        """Iterate over (`Readings` of one message, log time [ns]) in order of the latter."""
        for record, log_time_ns in self._records({}, progress):
            if isinstance(record, Readings):
                yield record, log_time_ns

    def readings_and_accelerations(self, progress: Progress | None = None
                                   ) -> Iterator[Readings | AccelerationSample]:
        """Iterate over `Readings` and `AccelerationSample`s, message by message."""
        return (record for record, _ in self._records(self._imus, progress))

    def _records(self, imus: Mapping[str, Sequence[str]], progress: Progress | None
                 ) -> Iterator[tuple[Readings | AccelerationSample, int]]:
        """(record, log time) of the sensors, and of the accelerometers {topic: sensors}."""
        return self._records_of(self._recording.messages(progress=progress), imus)

    def _records_of(self, messages: Iterable[RawMessage], imus: Mapping[str, Sequence[str]]
                    ) -> Iterator[tuple[Readings | AccelerationSample, int]]:
        """The same of some of the messages; what cannot be used is counted."""
        for message in messages:
            sensor = self._sensors.get(message.topic)
            truth = self._truth.wants(message.topic, message.type)
            many = message.topic == self._many and message.type == FIELD_READINGS
            shaken = imus.get(message.topic) if message.type == IMU else None
            if sensor is None and shaken is None and not truth and not many:
                continue
            try:
                content = decode(message)
                readings = readings_of(content) if many else None
            except RecordingError:
                self.rejected[f'undecodable message on {message.topic}'] += 1
                continue
            if truth:
                self._truth.add(message.topic, content)
            elif readings is not None:
                yield self._of_network(readings), message.log_time_ns
            elif shaken is not None:
                for name in shaken:
                    yield acceleration_of(content, name), message.log_time_ns
            elif sensor is not None:
                yield reading_of(content, sensor), message.log_time_ns

    def _of_network(self, readings: Readings) -> Readings:
        """Those of the network's sensors; the others are counted."""
        known = set(self._sensors.values())
        is_known = np.array([name in known for name in readings.names], dtype=bool)[readings.sensor]
        if is_known.all():
            return readings
        self.rejected.update(f'reading of {name}, which is not in the network'
                             for name in readings.part(~is_known).sensor_names())
        return readings.part(is_known)

    def truth_arrays(self) -> dict[str, Truth]:
        """{name: arrays} of the true poses that were read."""
        self.rejected.update(self._truth.rejected)
        self._truth.rejected.clear()
        return self._truth.arrays()


def _namespace(recording: Recording, network: SensorNetwork) -> str:
    """Namespace of the network's relative topics in a recording; the root where none is recorded.

    Raises RecordingError where several are possible.
    """
    if network.namespace is not None:
        return network.namespace
    names = [name for name, kind in recording.types.items()
             if kind in (MAGNETIC_FIELD, FIELD_READINGS)]
    found = namespaces_of((*network.topics, RAW_READINGS), names)
    if len(found) > 1:
        raise RecordingError(f'{recording.path} has the topics of the network in the namespaces '
                             f'{", ".join(found)}: choose one with --namespace')
    return found[0] if found else '/'
