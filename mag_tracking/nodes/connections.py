"""Monitoring of the connections of a node: throughput, latency, missing or faulty peer nodes."""

import time
from collections.abc import Callable, Collection, Mapping

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.sensor_network import absolute
from mag_tracking.nodes.diagnostics import ERROR, OK, WARN, status_of
from mag_tracking.quantities import quantity
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.health.sensor_health import MAX_LIVE_DELAY_S
from mag_tracking.stages.health.window import quantiles
from mag_tracking.units import NS

MAX_NAMED = 4
"""Maximum number of names in a message; the remaining names are only counted."""
SILENCE_TIMEOUT_S = 2.0
"""[s] A sensor or node that has sent nothing for longer than this is reported as silent."""
FIRST_MESSAGE_TIMEOUT_S = 8.0
"""[s] Grace period for the first message; longer than learning a background takes."""
MAX_LOAD = 0.95
"""Maximum fraction of the time that a node can spend on messages without falling behind."""
MAX_LATENCY_S = 1.0
"""[s] A larger median latency causes a warning, because the poses are then too old for control."""
MAX_LATENCIES = 10_000
"""Maximum number of latencies stored between two reports; enough for a thousand sensors."""


def topic_findings(node: Node, sensor: str, topic: str) -> list[Finding]:
    """Faults of the publishers of an absolute sensor topic: wrong type, several publishers."""
    publishers = node.get_publishers_info_by_topic(topic)
    found = [Finding(True, sensor, f'{p.node_name} publishes {p.topic_type} on {topic}',
                     f'the type must be {MAGNETIC_FIELD}', Cause.WRONG_TYPE)
             for p in publishers if p.topic_type != MAGNETIC_FIELD]
    if len(publishers) > 1:
        names = ', '.join(sorted(name for name in map(node_of, publishers) if name)) or 'unknown'
        found.append(Finding(True, sensor, f'{len(publishers)} publishers of {topic}: {names}',
                             'stop all but one', Cause.SEVERAL_PUBLISHERS))
    return found


def node_of(endpoint: TopicEndpointInfo) -> str | None:
    """Absolute name of the node of an endpoint; None until the middleware has announced it."""
    namespace = endpoint.node_namespace
    return absolute(endpoint.node_name, namespace) if namespace.startswith('/') else None


def is_latched(publisher: TopicEndpointInfo) -> bool:
    """Whether a publisher also sends its latest messages to subscribers that join later."""
    return bool(publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def subscriber_qos(depth: int, latched: bool) -> QoSProfile:
    """QoS that matches every publisher or, if `latched`, receives earlier messages."""
    if latched:
        return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE,
                          durability=DurabilityPolicy.TRANSIENT_LOCAL)
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


def no_message_finding(node: Node, sensor: str, topic: str, known: Mapping[str, str]) -> Finding:
    """Fault of a sensor from which no message has been received; the advice may name other topics
    with magnetic fields, except those of `known`, the topic of each sensor."""
    if node.count_publishers(topic):
        return Finding(True, sensor, f'no message received on {topic}, although it has a '
                       'publisher', 'check the sensor and its driver', Cause.NO_MESSAGES)
    namespace = node.get_namespace().rstrip('/')
    other_topics = sorted((name for name, kinds in node.get_topic_names_and_types()
                           if MAGNETIC_FIELD in kinds and name not in known.values()
                           and not name.endswith('_calibrated') and node.count_publishers(name)),
                          key=lambda name: (not name.startswith(f'{namespace}/'), name))
    advice = 'start its driver, or remap its topic'
    if other_topics:
        advice += f'; magnetic fields are published on {shortened(other_topics)}'
    return Finding(True, sensor, f'no message received: {topic} has no publisher', advice,
                   Cause.NO_MESSAGES)


def shortened(names: list[str]) -> str:
    """Join names with commas; after `MAX_NAMED` names, only count the remaining names."""
    n_more = len(names) - MAX_NAMED
    return ', '.join(names[:MAX_NAMED]) + (f' and {n_more} more' if n_more > 0 else '')


class Flow:
    """Statistics of the messages that a node receives from one source: the sensors or a node.

    `batches` are topics of batches of readings, which may be used instead of `topics`;
    `last_received` is by `time.monotonic()`; `n_lost` messages did not fit into the input queue.
    """

    def __init__(self, source: str) -> None:
        self.source, self.n_lost = source, 0
        self.topics: list[str] = []
        self.batches: list[str] = []
        self.last_received: float | None = None
        self._n_messages, self._n_reported_lost, self._busy_s = 0, 0, 0.0
        self._latencies: list[float] = []
        self._latest_latency_s: float | None = None
        self._start_time = self._report_time = time.monotonic()

    def add(self, stamp_ns: int, arrival_ns: int, start_s: float) -> None:
        """Add a message that arrived at `arrival_ns` by the clock of the node, and whose processing
        began at `start_s` of `time.monotonic()`."""
        self._n_messages += 1
        self.last_received = time.monotonic()
        duration_s = self.last_received - start_s
        self._busy_s += duration_s
        self._latest_latency_s = (arrival_ns - stamp_ns) / NS + duration_s
        if len(self._latencies) < MAX_LATENCIES:
            self._latencies.append(self._latest_latency_s)

    @property
    def n_latencies(self) -> int:
        """Number of latencies stored for the next report."""
        return len(self._latencies)

    @property
    def is_live(self) -> bool:
        """Whether the latest message was live and not replayed from a recording."""
        return self._latest_latency_s is not None and abs(self._latest_latency_s) < MAX_LIVE_DELAY_S

    def status(self, node: str, has_publisher: Callable[[], bool]) -> DiagnosticStatus:
        """Diagnostics of the messages since the last call, under the title of the `node`."""
        now = time.monotonic()
        elapsed, self._report_time = max(now - self._report_time, 1e-9), now
        latencies, self._latencies = self._latencies, []
        new_losses, self._n_reported_lost = self.n_lost - self._n_reported_lost, self.n_lost
        level, message = OK, 'running'
        busy = self._busy_s / elapsed
        median, percentile_99 = quantiles(
            [v for v in latencies if abs(v) < MAX_LIVE_DELAY_S], 0.5, 0.99)
        if self.last_received is None:
            message = f'waiting for {shortened(self.topics)}'
            if now - self._start_time > FIRST_MESSAGE_TIMEOUT_S:
                level = WARN
                message = f'no message received on {shortened(self.topics)}' + (
                    '' if has_publisher() else ': no publisher found; start the driver or the '
                    'preceding node')
        elif now - self.last_received > SILENCE_TIMEOUT_S:
            level = WARN
            message = f'no message from {self.source} for {now - self.last_received:.0f} s'
            if not has_publisher():
                level = ERROR
                message += ', and its topics have no publisher: check that it is running'
        elif new_losses:
            level, message = WARN, f'{quantity(new_losses, "message")} from {self.source} lost: ' \
                'the input queue was full; reduce the load of this computer'
        elif busy > MAX_LOAD or median > MAX_LATENCY_S:
            level, message = WARN, f'input from {self.source}: load {100.0 * busy:.0f} %' + (
                f', latency {1e3 * median:.0f} ms: this computer is too slow, or its clock differs '
                'from the clock of the sensors' if median > MAX_LATENCY_S else
                ': this computer is too slow')
        values = {'messages': self._n_messages, 'lost in the queue': self.n_lost,
                  'latency, median [ms]': f'{1e3 * median:.4g}',
                  'latency, 99 % [ms]': f'{1e3 * percentile_99:.4g}',
                  'busy [%]': f'{100.0 * busy:.3g}'}
        self._busy_s = 0.0
        return status_of(f'{node}: from {self.source}', message, level, values)


class SubscriberMonitor:
    """Checks that a node with the `role` of the next processing step, which is identified by the
    message type that it `publishes`, still subscribes to an absolute topic."""

    def __init__(self, role: str, topic: str, publishes: str) -> None:
        self.role, self.topic, self._publishes = role, topic, publishes
        self._known_nodes: set[str] = set()

    def status(self, node: str, names: Collection[str],
               types_of: Callable[[str], Collection[str]]) -> DiagnosticStatus:
        """Diagnostics of the connection, now to the nodes `names`, titled by the `node`."""
        self._known_nodes |= {name for name in set(names) - self._known_nodes
                              if self._publishes in types_of(name)}
        missing_nodes = sorted(self._known_nodes - set(names))
        is_gone = bool(missing_nodes) and not self._known_nodes.intersection(names)
        message = 'running' if self._known_nodes else \
            f'no {self.role} node has subscribed to {self.topic} yet'
        if is_gone:
            has, it_is = ('has', 'it is') if len(missing_nodes) == 1 else ('have', 'they are')
            message = f'{", ".join(missing_nodes)} {has} disappeared: check that {it_is} running'
        return status_of(f'{node}: to {self.role}', message, ERROR if is_gone else OK)
