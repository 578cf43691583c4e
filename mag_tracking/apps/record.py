"""Topic selection, progress and summary of the command `mag-tracking record`."""

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

from mag_tracking.messages import types
from mag_tracking.quantities import quantity

if TYPE_CHECKING:
    from mag_tracking.recording.recorder import Recorder


class Selection(NamedTuple):
    """Topics to record; names may be relative, but are absolute in the result of `resolved`.

    They are those of the fields, and of sensor_msgs/Imu, of the sensors of the network, `topics`,
    and with `results` or `all_topics` those of the nodes, or all.
    """

    fields: tuple[str, ...] = ()
    imus: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    results: bool = False
    all_topics: bool = False
    readings: str = types.RAW_READINGS
    result_prefixes: tuple[str, ...] = ('calibration_node/', 'detection_node/', 'tracker_node/')
    result_topics: tuple[str, ...] = (types.CALIBRATED_READINGS, types.CALIBRATION_STATE,
                                      types.NETWORK_FRAME)

    def resolved(self, resolve: Callable[[str], str]) -> 'Selection':
        """Selection with absolute names of topics, which `resolve` returns."""
        return self._replace(
            fields=tuple(map(resolve, self.fields)), imus=tuple(map(resolve, self.imus)),
            topics=tuple(map(resolve, self.topics)), readings=resolve(self.readings),
            result_prefixes=tuple(f'{resolve(name.rstrip("/"))}/' for name in self.result_prefixes),
            result_topics=tuple(map(resolve, self.result_topics)))

    def includes(self, topic: str) -> bool:
        """Whether to record a topic, given by its absolute name."""
        if topic == self.readings or topic in self.fields + self.imus + self.topics:
            return True
        # Topics with a name component that begins with an underscore are hidden, as in rosbag2.
        if self.all_topics and '/_' not in topic:
            return True
        return self.results and (topic.startswith(self.result_prefixes) or topic == '/diagnostics'
                                 or topic in self.result_topics
                                 or topic.removesuffix('_calibrated') in self.fields)


def progress_line(recorder: 'Recorder', seconds: float) -> str:
    """Describe the progress of a recording in one line, `seconds` after the start."""
    dropped = recorder.dropped.total()
    messages = quantity(recorder.counts.total(), 'message')
    return (f'{seconds:.0f} s: {messages}, {recorder.size / 1e6:.1f} MB'
            + (f', dropped: {dropped}' if dropped else ''))


def summary(recorder: 'Recorder', selection: Selection, lost: Mapping[str, int],
            refused: Mapping[str, str]) -> Iterator[str]:
    """Summarise a recording: its content, the messages lost before they were recorded, by topic,
    and the reasons for refused topics."""
    messages = quantity(recorder.counts.total(), 'message')
    yield f'{recorder.folder}: {messages}, {recorder.size / 1e6:.2f} MB'
    for topic, n in sorted((+recorder.counts).items()):
        yield f'  {topic}  {n}'
    for topic in selection.fields + selection.topics:
        if not recorder.counts[topic] and topic not in refused:
            yield f'  warning: no messages on {topic}'
    for topic, n in sorted((+recorder.dropped).items()):
        yield f'  warning: {topic}: messages dropped while the disk was full: {n}'
    for topic, n in sorted(lost.items()):
        yield f'  warning: {topic}: messages lost before recording: {n}'
    for topic, reason in sorted(refused.items()):
        yield f'  warning: {topic} was not recorded: {reason}'
