"""record_node: records topics as they are, serialised, and counts what did not reach it."""

import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from tqdm import tqdm

from mag_tracking.apps.record import Selection, progress_line, summary
from mag_tracking.interrupts import recorded_signals
from mag_tracking.messages.types import (
    FIELD_READINGS,
    IMU,
    MAGNETIC_FIELD,
)
from mag_tracking.nodes.convert import message_class
from mag_tracking.nodes.definitions import definition_of
from mag_tracking.nodes.middleware import begin
from mag_tracking.nodes.shutdown import shut_down
from mag_tracking.recording.recorder import Recorder
from mag_tracking.recording.writer import offered_qos

POLL_S = 0.02
"""How often messages are fetched [s]."""
DISCOVER_S = 0.5
"""How often topics are looked for [s]."""
LINE_S = 10.0
"""Time between two lines of progress where there is no terminal [s]."""
DEPTHS = {MAGNETIC_FIELD: 1000, IMU: 1000, FIELD_READINGS: 1000}
"""Messages that may wait between two fetches (a disk may stall for a second or more)."""
OTHER_DEPTH = 100
"""The same of other types: images are large."""


class _Source:
    """A subscription that is asked for its messages, and what is known of its publishers."""

    def __init__(self, node: Node, topic: str, type_name: str, latched: bool) -> None:
        self.node, self.type, self.latched = node, type_name, latched
        self.depth = DEPTHS.get(type_name, OTHER_DEPTH)
        # A best-effort reader matches every publisher, but is not given what was latched.
        self.subscription = node.create_subscription(
            message_class(type_name), topic, lambda _: None, QoSProfile(
                depth=self.depth, reliability=ReliabilityPolicy.RELIABLE if latched
                else ReliabilityPolicy.BEST_EFFORT,
                durability=DurabilityPolicy.TRANSIENT_LOCAL if latched
                else DurabilityPolicy.VOLATILE), raw=True)
        self.publishers: tuple[tuple[int, ...], ...] = ()
        self.last: int | None = None
        self.lost = 0

    def take(self) -> list[tuple[int, int, bytes]]:
        """The messages that wait: [(received_ns, sent_ns, data)]."""
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
        """Count the gap before a message, where one publisher numbers them."""
        if number is None or len(self.publishers) > 1:
            self.last = None
            return
        if self.last is not None and number > self.last:
            self.lost += number - self.last - 1
        self.last = number

    def set_publishers(self, infos: list[TopicEndpointInfo]) -> None:
        """Who publishes now; another publisher counts anew."""
        publishers = tuple(sorted(tuple(i.endpoint_gid) for i in infos))
        if set(self.publishers) - set(publishers):
            self.last = None
        self.publishers = publishers


class RecordNode(Node):
    """Subscribes to what is wanted and hands it to a `Recorder`.

    No executor spins it: `poll` fetches. The events executor of the Jazzy wheels
    fails on callbacks that ask for a message's time and number, and the other one
    takes most of a core for twenty sensors.
    """

    def __init__(self, recorder: Recorder, selection: Selection,
                 report: Callable[[str], None] = print) -> None:
        super().__init__('record_node', start_parameter_services=False)
        self.recorder, self._report = recorder, report
        self.selection = selection.resolved(self.resolve_topic_name)
        self._sources: dict[str, _Source] = {}
        self._refused: dict[str, str] = {}
        self._described: set[str] = set()
        self._lost_before: Counter[str] = Counter()
        # Their type is known: nothing is missed of a driver that starts later.
        for topic in self.selection.fields:
            self._subscribe(topic, MAGNETIC_FIELD, [])
        for topic in self.selection.imus:
            self._subscribe(topic, IMU, [])

    @property
    def lost(self) -> 'Counter[str]':
        """{topic: messages that were published and never fetched}, where there were any."""
        now = Counter({topic: s.lost for topic, s in self._sources.items()})
        return +(now + self._lost_before)

    @property
    def refused(self) -> dict[str, str]:
        """{topic: why it is not recorded}."""
        return self._refused

    def heard(self) -> tuple[int, int]:
        """(topics that have a publisher, topics subscribed to)."""
        return (sum(s.subscription.get_publisher_count() > 0 for s in self._sources.values()),
                len(self._sources))

    def discover(self) -> None:
        """Subscribe to wanted topics that are new, and follow changes of the known ones."""
        for topic, _ in self.get_topic_names_and_types():
            if topic in self._refused or not self.selection.wants(topic):
                continue
            infos = self.get_publishers_info_by_topic(topic)
            if not infos:
                continue
            if topic in self._sources:
                self._follow(topic, infos)
            else:
                self._subscribe(topic, infos[0].topic_type, infos)

    def _subscribe(self, topic: str, type_name: str, infos: list[TopicEndpointInfo]) -> None:
        """Begin to record a topic."""
        if message_class(type_name) is None:
            self._refuse(topic, f'{type_name} is not installed')
            return
        latched = bool(infos) and all(map(_latched, infos))
        self._sources[topic] = _Source(self, topic, type_name, latched)
        self._sources[topic].set_publishers(infos)

    def _describe(self, topic: str, source: _Source) -> None:
        """Tell the recorder about a topic, whose publishers are known at its first message."""
        text = definition_of(source.type)
        if text is None:
            self._report(f'{topic}: no definition of {source.type} found: only ROS can read it')
        infos = self.get_publishers_info_by_topic(topic)
        reliable = all(i.qos_profile.reliability == ReliabilityPolicy.RELIABLE for i in infos)
        self.recorder.add_topic(topic, source.type, text or '',
                                offered_qos(reliable, source.latched),
                                max(1, len(infos)) if source.latched else 0)
        self._described.add(topic)

    def _refuse(self, topic: str, why: str) -> None:
        """Say once that a topic is not recorded."""
        self._refused[topic] = why
        self._report(f'{topic} is not recorded: {why}')

    def _follow(self, topic: str, infos: list[TopicEndpointInfo]) -> None:
        """Keep up with a topic's publishers."""
        source = self._sources[topic]
        others = sorted({i.topic_type for i in infos} - {source.type})
        if others and f'{topic} as {others[0]}' not in self._refused:
            self._refuse(f'{topic} as {others[0]}', f'it is expected as {source.type}')
        source.set_publishers(infos)
        if source.latched and not all(map(_latched, infos)):
            # It asks for more than the new publisher gives, and would get nothing of it.
            self.poll()
            self._lost_before[topic] += source.lost
            self.destroy_subscription(source.subscription)
            self._sources[topic] = _Source(self, topic, source.type, False)
        elif source.latched and topic in self._described:
            self.recorder.add_topic(topic, source.type, latched=len(infos))

    def poll(self) -> int:
        """Record what has come; the number of messages."""
        found = []
        for topic, source in self._sources.items():
            messages = source.take()
            if messages and topic not in self._described:
                self._describe(topic, source)
            found += [(received, topic, sent, data) for received, sent, data in messages]
        for received, topic, sent, data in sorted(found, key=lambda f: f[0]):
            self.recorder.write(topic, data, received, sent)
        return len(found)


def _latched(info: TopicEndpointInfo) -> bool:
    """Whether a publisher keeps its messages for those who come later."""
    return bool(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def say(text: str) -> None:
    """A line for the user, beside a progress bar; nobody may be there to read it."""
    with suppress(OSError):
        tqdm.write(f'record: {text}', file=sys.stderr)


def run(selection: Selection, out: Path, split_bytes: int = 10**9,
        split_ns: int = 3600 * 10**9, ros_arguments: Sequence[str] = ()) -> int:
    """Record until SIGINT, SIGTERM or SIGHUP; returns the exit status.

    If the middleware hangs at the end, the process ends: see `leave`. The recording is closed then.

    Parameters
    ----------
    selection : Selection
    out : path
        Folder for the recording.
    split_bytes, split_ns : int
        A new file begins when one is that large, or has been open for that long.
    ros_arguments : sequence of str
        Of the node, beginning with `--ros-args`.

    Raises OutputError where `out` cannot take a recording.
    """
    node, status = None, 1
    with recorded_signals(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as seen:
        try:
            with Recorder(out, split_bytes, split_ns, report=say) as recorder:
                begin(list(ros_arguments))
                node = RecordNode(recorder, selection, say)
                say(f'recording into {out}; Ctrl-C ends it')
                _record(node, lambda: bool(seen))
            for line in summary(recorder, node.selection, node.lost, node.refused):
                print(line)
            status = 1 if recorder.unfinished else 0
        finally:
            shut_down([] if node is None else [node], status=status)
    return status


def _record(node: RecordNode, stopped: Callable[[], bool]) -> None:
    """Fetch and record until `stopped()`, and show it."""
    begin = time.monotonic()
    next_look, next_line, heard = begin, begin + LINE_S, None
    bar = tqdm(unit=' messages', unit_scale=True, disable=None)
    try:
        while rclpy.ok() and not stopped():
            now = time.monotonic()
            n = node.poll()
            node.recorder.tick(time.monotonic_ns())
            if now >= next_look:
                node.discover()
                next_look = now + DISCOVER_S
                heard, before = node.heard(), heard
                if heard != before:
                    say(f'{heard[0]} of {heard[1]} topics have a publisher')
            if bar.disable and now >= next_line:
                say(progress_line(node.recorder, now - begin))
                next_line += LINE_S
            with suppress(OSError):
                bar.update(n)
            time.sleep(max(0.0, now + POLL_S - time.monotonic()))
        node.poll()
    finally:
        # The terminal may be gone (SIGHUP); the recording goes on to its end.
        with suppress(OSError):
            bar.close()
