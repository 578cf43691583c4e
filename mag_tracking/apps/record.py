"""Which topics `mag-tracking record` records, and what it reports."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

from mag_tracking.messages.types import (
    CALIBRATED_READINGS,
    CALIBRATION_STATE,
    NETWORK_FRAME,
    RAW_READINGS,
)

RESULTS_OF = ('calibration_node/', 'detection_node/', 'tracker_node/')
"""Prefixes of topics of results, in the namespace of the recorder."""
RESULTS = (CALIBRATED_READINGS, CALIBRATION_STATE, NETWORK_FRAME)
"""Other topics of results."""


class Recorded(Protocol):
    """What is asked of a recorder."""

    counts: Counter[str]
    """Messages written, per topic."""
    dropped: Counter[str]
    """Messages dropped while the disk was full, per topic."""

    @property
    def folder(self) -> Path:
        """Folder of the recording."""

    @property
    def size(self) -> int:
        """Bytes written."""


class Selection(NamedTuple):
    """Which topics to record, as the user names them or, `resolved`, as the graph does."""

    fields: tuple[str, ...] = ()
    """Magnetic fields of the network."""
    imus: tuple[str, ...] = ()
    """Where its sensors may publish sensor_msgs/Imu."""
    topics: tuple[str, ...] = ()
    results: bool = False
    everything: bool = False
    readings: str = RAW_READINGS
    """Topic of the readings of many sensors."""
    results_of: tuple[str, ...] = RESULTS_OF
    result_topics: tuple[str, ...] = RESULTS

    def resolved(self, resolve: Callable[[str], str]) -> 'Selection':
        """The selection with absolute names; `resolve` takes a name and returns its absolute one.
        """
        return self._replace(
            fields=tuple(map(resolve, self.fields)), imus=tuple(map(resolve, self.imus)),
            topics=tuple(map(resolve, self.topics)), readings=resolve(self.readings),
            results_of=tuple(f'{resolve(name.rstrip("/"))}/' for name in self.results_of),
            result_topics=tuple(map(resolve, self.result_topics)))

    def wants(self, topic: str) -> bool:
        """Whether to record a topic."""
        if topic == self.readings or topic in self.fields + self.imus + self.topics:
            return True
        # ROS hides what has a part that begins with an underscore, and so does rosbag2.
        if self.everything and '/_' not in topic:
            return True
        return self.results and (topic.startswith(self.results_of) or topic == '/diagnostics'
                                 or topic in self.result_topics
                                 or topic.removesuffix('_calibrated') in self.fields)


def progress_line(recorder: Recorded, seconds: float) -> str:
    """What there is so far, as a line."""
    dropped = recorder.dropped.total()
    return (f'{seconds:.0f} s: {recorder.counts.total()} messages, {recorder.size / 1e6:.1f} MB'
            + (f', dropped: {dropped}' if dropped else ''))


def summary(recorder: Recorded, selection: Selection, lost: Mapping[str, int],
            refused: Mapping[str, str]) -> Iterator[str]:
    """Lines that say what is in a recording, and what is not."""
    yield f'{recorder.folder}: {recorder.counts.total()} messages, {recorder.size / 1e6:.2f} MB'
    for topic, n in sorted((+recorder.counts).items()):
        yield f'  {topic}  {n}'
    for topic in selection.fields + selection.topics:
        if not recorder.counts[topic] and topic not in refused:
            yield f'  warning: nothing on {topic}'
    for topic, n in sorted((+recorder.dropped).items()):
        yield f'  warning: {topic}: dropped while the disk was full: {n}'
    for topic, n in sorted(lost.items()):
        yield f'  warning: {topic}: lost before they were recorded: {n}'
    for topic, why in sorted(refused.items()):
        yield f'  warning: {topic} is not recorded: {why}'
