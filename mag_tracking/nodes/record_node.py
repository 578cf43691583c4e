"""Recorder node that writes messages without decoding them and counts lost messages."""

import functools
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from tqdm import tqdm

from mag_tracking.apps.record import Selection, progress_line, summary
from mag_tracking.errors import RecordingError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.messages import types
from mag_tracking.nodes.connections import is_latched, subscriber_qos
from mag_tracking.nodes.convert import message_class
from mag_tracking.nodes.middleware import init_ros, shut_down
from mag_tracking.recording.recorder import Recorder
from mag_tracking.recording.writer import offered_qos

POLL_INTERVAL_S = 0.02
"""[s] Interval between fetches of messages."""
DISCOVERY_INTERVAL_S = 0.5
"""[s] Interval between searches for topics."""
PROGRESS_INTERVAL_S = 10.0
"""[s] Interval between progress lines if the output is not a terminal."""
DEPTHS = {types.MAGNETIC_FIELD: 1000, types.IMU: 1000, types.FIELD_READINGS: 1000}
"""Queue length by message type. A disk may stall for a second or more between two fetches."""
DEFAULT_DEPTH = 100
"""Queue length for other types, such as images, which are large."""


@functools.cache
def definition_of(type_name: str) -> str | None:
    """Definition of a type with all nested types (`ros2msg`); None if one is not installed."""
    try:
        return types.definition(type_name)
    except RecordingError:
        pass
    known, queue, schema = [type_name], [type_name], ''
    while queue:
        name = queue.pop(0)
        content = _file_content(name)
        if content is None:
            return None
        package, _, leaf = name.split('/')
        schema += content if not schema else f'{"=" * 80}\nMSG: {package}/{leaf}\n{content}'
        new_types = [t for t in types.referenced_types(content, package) if t not in known]
        known += new_types
        queue += new_types
    return schema


def _file_content(type_name: str) -> str | None:
    """Content of the .msg file of a type; None if the file is not installed."""
    package, kind, leaf = type_name.split('/')
    # ROS from PyPI leaves AMENT_PREFIX_PATH unset and is installed below sys.prefix.
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    for prefix in (*prefixes, sys.prefix):
        file = Path(prefix) / 'share' / package / kind / f'{leaf}.msg'
        if file.is_file():
            text = file.read_text(encoding='utf-8', errors='replace')
            return text if text.endswith('\n') else f'{text}\n'
    return None


class _PolledSubscription:
    """Polled subscription that counts lost messages."""

    def __init__(self, node: Node, topic: str, type_name: str, latched: bool) -> None:
        self.node, self.type, self.latched = node, type_name, latched
        self.depth = DEPTHS.get(type_name, DEFAULT_DEPTH)
        self.subscription = node.create_subscription(
            message_class(type_name), topic, lambda _: None,
            subscriber_qos(self.depth, latched), raw=True)
        self.publishers: tuple[tuple[int, ...], ...] = ()
        self.last_number: int | None = None
        self.n_lost = 0

    def fetch(self) -> list[tuple[int, int, bytes]]:
        """Remove the queued messages and return them as [(received_ns, sent_ns, data)]."""
        out: list[tuple[int, int, bytes]] = []
        handle = self.subscription.handle
        with handle:
            while len(out) < self.depth:
                taken = handle.take_message(self.subscription.msg_type, True)
                if taken is None:
                    break
                data, info = taken
                self._count_lost(info.get('publication_sequence_number'))
                received = info.get('received_timestamp') or time.time_ns()
                out.append((received, info.get('source_timestamp') or received, data))
        return out

    def _count_lost(self, number: int | None) -> None:
        """Count messages lost before a sequence number; none with several publishers."""
        if number is None or len(self.publishers) > 1:
            self.last_number = None
            return
        if self.last_number is not None and number > self.last_number:
            self.n_lost += number - self.last_number - 1
        self.last_number = number

    def set_publishers(self, infos: list[TopicEndpointInfo]) -> None:
        """Update the publishers; if one has disappeared, ignore the next sequence number jump."""
        publishers = tuple(sorted(tuple(i.endpoint_gid) for i in infos))
        if set(self.publishers) - set(publishers):
            self.last_number = None
        self.publishers = publishers


class RecordNode(Node):
    """Subscribes to the selected topics and passes their messages to a `Recorder`.

    The node is polled: the events executor of the Jazzy wheels fails in callbacks that request
    message info, and the single-threaded executor uses most of a core for twenty sensors. `report`
    is called with lines for the user; `refused` are {topic that is not recorded: reason}.
    """

    def __init__(self, recorder: Recorder, selection: Selection,
                 report: Callable[[str], None] = print) -> None:
        super().__init__('record_node', start_parameter_services=False)
        self.recorder, self._report = recorder, report
        self.selection = selection.resolved(self.resolve_topic_name)
        self._polled_subscriptions: dict[str, _PolledSubscription] = {}
        self.refused: dict[str, str] = {}
        self._described_topics: set[str] = set()
        self._n_lost_before: Counter[str] = Counter()
        # The types of these topics are known, so the subscriptions need not wait for a driver.
        for topic in self.selection.fields:
            self._subscribe(topic, types.MAGNETIC_FIELD, [])
        for topic in self.selection.imus:
            self._subscribe(topic, types.IMU, [])

    @property
    def lost(self) -> 'Counter[str]':
        """Numbers of lost messages by topic; topics without losses are omitted."""
        current = Counter({topic: s.n_lost for topic, s in self._polled_subscriptions.items()})
        return +(current + self._n_lost_before)

    def topic_counts(self) -> tuple[int, int]:
        """Number of subscribed topics that have a publisher, and number of subscribed topics."""
        return (sum(s.subscription.get_publisher_count() > 0
                    for s in self._polled_subscriptions.values()),
                len(self._polled_subscriptions))

    def discover(self) -> None:
        """Subscribe to new selected topics; update the publishers of subscribed topics."""
        for topic, _ in self.get_topic_names_and_types():
            if topic in self.refused or not self.selection.includes(topic):
                continue
            infos = self.get_publishers_info_by_topic(topic)
            if not infos:
                continue
            if topic in self._polled_subscriptions:
                self._update_publishers(topic, infos)
            else:
                self._subscribe(topic, infos[0].topic_type, infos)

    def _subscribe(self, topic: str, type_name: str, infos: list[TopicEndpointInfo]) -> None:
        """Subscribe to a topic, or report that its message type is not installed."""
        if message_class(type_name) is None:
            self._refuse(topic, f'message type {type_name} is not installed')
            return
        latched = bool(infos) and all(map(is_latched, infos))
        self._polled_subscriptions[topic] = _PolledSubscription(self, topic, type_name, latched)
        self._polled_subscriptions[topic].set_publishers(infos)

    def _describe(self, topic: str, polled: _PolledSubscription) -> None:
        """Add a topic to the recorder at its first message, when its publishers are known."""
        definition = definition_of(polled.type)
        if definition is None:
            self._report(f'{topic}: no definition of {polled.type} found: the recording of this '
                         'topic can only be read with ROS')
        infos = self.get_publishers_info_by_topic(topic)
        reliable = all(i.qos_profile.reliability == ReliabilityPolicy.RELIABLE for i in infos)
        self.recorder.add_topic(topic, polled.type, definition or '',
                                offered_qos(reliable, polled.latched),
                                max(1, len(infos)) if polled.latched else 0)
        self._described_topics.add(topic)

    def _refuse(self, topic: str, reason: str) -> None:
        """Report once that a topic is not recorded."""
        self.refused[topic] = reason
        self._report(f'{topic} is not recorded: {reason}')

    def _update_publishers(self, topic: str, infos: list[TopicEndpointInfo]) -> None:
        """Update a topic's publishers; replace a latched subscription if a publisher is not."""
        polled = self._polled_subscriptions[topic]
        other_types = sorted({i.topic_type for i in infos} - {polled.type})
        if other_types and f'{topic} as {other_types[0]}' not in self.refused:
            self._refuse(f'{topic} as {other_types[0]}', f'the topic has type {polled.type}')
        polled.set_publishers(infos)
        if polled.latched and not all(map(is_latched, infos)):
            # The latched subscription would not match the new publisher, which is not latched.
            self.poll()
            self._n_lost_before[topic] += polled.n_lost
            self.destroy_subscription(polled.subscription)
            self._polled_subscriptions[topic] = _PolledSubscription(self, topic, polled.type, False)
        elif polled.latched and topic in self._described_topics:
            self.recorder.add_topic(topic, polled.type, latched=len(infos))

    def poll(self) -> int:
        """Record the messages that have arrived; return their number."""
        records = []
        for topic, polled in self._polled_subscriptions.items():
            messages = polled.fetch()
            if messages and topic not in self._described_topics:
                self._describe(topic, polled)
            records += [(received, topic, sent, data) for received, sent, data in messages]
        for received, topic, sent, data in sorted(records, key=lambda r: r[0]):
            self.recorder.write(topic, data, received, sent)
        return len(records)


def log(text: str) -> None:
    """Print a line for the user without disturbing a progress bar; a closed terminal is ignored."""
    with suppress(OSError):
        tqdm.write(f'record: {text}', file=sys.stderr)


def run(selection: Selection, out: Path, split_bytes: int = 10**9,
        split_ns: int = 3600 * 10**9, ros_arguments: Sequence[str] = ()) -> int:
    """Record into folder `out` until SIGINT, SIGTERM or SIGHUP, in files of `split_bytes` or
    `split_ns`; return the exit status; raises OutputError if the recording cannot be written."""
    node, status = None, 1
    with recorded_signals(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as signals:
        try:
            with Recorder(out, split_bytes, split_ns, report=log) as recorder:
                init_ros(list(ros_arguments))
                node = RecordNode(recorder, selection, log)
                log(f'recording to {out}; press Ctrl-C to stop')
                _record(node, lambda: bool(signals))
            for line in summary(recorder, node.selection, node.lost, node.refused):
                print(line)
            status = 1 if recorder.unfinished else 0
        finally:
            shut_down([] if node is None else [node], status=status)
    return status


def _record(node: RecordNode, stopped: Callable[[], bool]) -> None:
    """Record messages, discover topics and show the progress until `stopped()`."""
    start = time.monotonic()
    next_discovery, next_line, topic_counts = start, start + PROGRESS_INTERVAL_S, None
    bar = tqdm(unit=' messages', unit_scale=True, disable=None)
    try:
        while rclpy.ok() and not stopped():
            now = time.monotonic()
            n = node.poll()
            node.recorder.tick(time.monotonic_ns())
            if now >= next_discovery:
                node.discover()
                next_discovery = now + DISCOVERY_INTERVAL_S
                topic_counts, previous_counts = node.topic_counts(), topic_counts
                if topic_counts != previous_counts:
                    log(f'publishers found for {topic_counts[0]} of {topic_counts[1]} topics')
            if bar.disable and now >= next_line:
                log(progress_line(node.recorder, now - start))
                next_line += PROGRESS_INTERVAL_S
            with suppress(OSError):
                bar.update(n)
            time.sleep(max(0.0, now + POLL_INTERVAL_S - time.monotonic()))
        node.poll()
    finally:
        # The terminal may have been closed (SIGHUP); the recording must still be finished.
        with suppress(OSError):
            bar.close()
