"""Base class of nodes that run stages: parameters, network, diagnostics and main loop."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from mag_tracking.errors import RecordingError, SettingsError
from mag_tracking.messages.schema import stamp_ns
from mag_tracking.network.file import read_network
from mag_tracking.nodes import diagnostics
from mag_tracking.nodes.connections import Flow, SubscriberMonitor, node_of, shortened
from mag_tracking.nodes.ros_params import declare_settings, fixed_parameter
from mag_tracking.nodes.scheduling import steady_timer
from mag_tracking.pipeline import settings_for
from mag_tracking.stages.stage import Stage

RESULT_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of results for users."""
STREAM_QOS = QoSProfile(depth=500, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of subscriptions between the nodes, and of a replay, which may be fast."""
PUBLISHER_QOS = QoSProfile(depth=250, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of publishers between the nodes. A restarted node can skip at most 256 older messages with
one request (RTPS 2.3, 8.3.5.5); it would receive nothing until a second one."""
SENSOR_QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""QoS of subscriptions to sensors; best effort matches reliable and best-effort publishers."""
LATCHED_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                         durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""QoS of topics whose latest message is sent to late subscribers."""
TRANSFORM_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of /tf, as in tf2."""
READY = 'ready'
"""State of a node that has received input and operates normally."""
_Record = TypeVar('_Record')


class StageNode(Node):
    """Node that reads the network file and the settings of one group of stages.

    `flows` are the statistics of the inputs, by source; `now_ns` is the arrival time of the current
    message. Raises SettingsError and NetworkError for invalid parameters and network files.
    """

    def __init__(self, name: str, group: str, **node_arguments: Any) -> None:
        super().__init__(name, **node_arguments)
        path = fixed_parameter(self, 'network', '', 'Path of the network file.')
        if not path:
            raise SettingsError(f'{name}: parameter network is empty; set it to the path of a '
                                'network file')
        target = fixed_parameter(self, 'target', 'vehicle', 'Kind of target: vehicle, magnet '
                                 '(in a hand) or bench (a magnet on a bench).')
        reliable = fixed_parameter(self, 'reliable_input', False, 'Subscribe to the inputs with '
                                   'reliable QoS, for a replay.')
        self.network_path = Path(path).resolve()
        self.input_qos = STREAM_QOS if reliable else SENSOR_QOS
        self.is_replayed = reliable or self.get_parameter('use_sim_time').value
        self.network = read_network(self.network_path)
        defaults = settings_for(target)
        self.settings = declare_settings(self, defaults, group)
        if self.settings.track.target != defaults.track.target:
            raise SettingsError(f'{name}: parameter track.target is {self.settings.track.target!r}'
                                f', but target is {target!r}; set target only')
        self.diagnostics = diagnostics.DiagnosticsPublisher(self)
        self._reported_rejections: dict[tuple[str, str], int] = {}
        self.flows: dict[str, Flow] = {}
        self._subscriber_monitors: list[SubscriberMonitor] = []
        self.now_ns = 0
        self._reported_state = ''
        steady_timer(self, 1.0, self._publish_diagnostics)

    def state(self) -> str:
        """State of the node: waiting for input, or ready."""
        silent_topics = [topic for flow in self.flows.values() if flow.last_received is None
                         for topic in flow.topics]
        return f'waiting for {shortened(silent_topics)}' if silent_topics else READY

    def report_state(self) -> None:
        """Log the state if it has changed."""
        state = self.state()
        if state != self._reported_state:
            self._reported_state = state
            self.diagnostics.log.info(state)

    @property
    def sensor_topics(self) -> tuple[str, ...]:
        """Topics of the sensors: absolute names, after remapping."""
        return tuple(map(self.resolve_topic_name, self.network.topics))

    def stages(self) -> dict[str, Stage[Any, Any]]:
        """Stages whose counts are published in diagnostics, by name."""
        raise NotImplementedError

    def queues(self) -> dict[str, int]:
        """Number of queued records of each stage, by name."""
        return {}

    def monitor_subscriber(self, role: str, topic: str, publishes: str) -> None:
        """Report if the node of the next step stops subscribing to a topic."""
        self._subscriber_monitors.append(
            SubscriberMonitor(role, self.resolve_topic_name(topic), publishes))

    def publisher(self, message_type: Any, topic: str, qos: QoSProfile) -> Publisher:
        """Create a publisher that logs subscribers with incompatible QoS."""
        def incompatible(event: Any) -> None:
            self.get_logger().warning(
                f'a subscriber of {topic} requests incompatible QoS (policy '
                f'{event.last_policy_kind}) and receives nothing; adapt its QoS')

        events = PublisherEventCallbacks(incompatible_qos=incompatible)
        return self.create_publisher(message_type, topic, qos, event_callbacks=events)

    def subscription(self, message_type: Any, topic: str, callback: Callable[[Any], None],
                     qos: QoSProfile, source: str = '', batches: bool = False) -> Subscription:
        """Create a subscription that logs publishers with incompatible QoS; a `source` is reported
        in diagnostics; with `batches`, the topic is an alternative to its other topics."""
        flow = self.flows.setdefault(source, Flow(source)) if source else None
        if flow is not None:
            (flow.batches if batches else flow.topics).append(self.resolve_topic_name(topic))

        def incompatible(event: Any) -> None:
            self.get_logger().warning(
                f'a publisher of {topic} offers incompatible QoS (policy '
                f'{event.last_policy_kind}): its messages are not received; adapt its QoS')

        def lost(event: Any) -> None:
            if flow is not None:
                flow.n_lost += event.total_count_change

        return self.create_subscription(
            message_type, topic, callback if flow is None else self._timed(
                flow, callback, lambda message: stamp_ns(message.header.stamp)), qos,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=incompatible, message_lost=lost))

    def direct_input(self, source: str, topics: Sequence[str], callback: Callable[[_Record], None],
                     stamp_of: Callable[[_Record], int]) -> Callable[[_Record], None]:
        """Create a function that receives records of the step `source` directly instead of by the
        `topics`; `stamp_of` returns the timestamp of a record in ns."""
        flow = self.flows.setdefault(source, Flow(source))
        flow.topics += map(self.resolve_topic_name, topics)
        return self._timed(flow, callback, stamp_of)

    def _timed(self, flow: Flow, callback: Callable[[_Record], None],
               stamp_of: Callable[[_Record], int]) -> Callable[[_Record], None]:
        """Create a function that processes a record and adds it to the statistics of `flow`."""
        def receive(record: _Record) -> None:
            start_s = time.monotonic()
            self.now_ns = self.get_clock().now().nanoseconds
            callback(record)
            flow.add(stamp_of(record), self.now_ns, start_s)

        return receive

    def converted(self, convert: Callable[[], _Record], stage: Stage[Any, Any],
                  kind: str) -> _Record | None:
        """Convert a message; log and count an invalid one and return None."""
        try:
            return convert()
        except RecordingError as error:
            stage.counts[f'rejected: bad {kind}'] += 1
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return None

    def _publish_diagnostics(self) -> None:
        """Publish the state of the stages and connections; log the node's state if it changed."""
        statuses, queues, title = [], self.queues(), self.diagnostics.title
        for name, stage in self.stages().items():
            increases = {k: n for k, n in stage.counts.items() if k.startswith('rejected: ')
                         and n != self._reported_rejections.get((name, k), 0)}
            self._reported_rejections |= {(name, cause): n for cause, n in increases.items()}
            statuses.append(diagnostics.status_of(
                f'{title}: {name}',
                '; '.join(f'{cause}: {n}' for cause, n in increases.items()) or 'running',
                diagnostics.WARN if increases else diagnostics.OK, dict(sorted({
                    **stage.counts, **({'queue': queues[name]} if name in queues else {})
                }.items()))))
        statuses += [flow.status(title, partial(
            lambda topics: any(map(self.count_publishers, topics)), flow.topics + flow.batches))
            for flow in self.flows.values()]
        for monitor in self._subscriber_monitors:
            endpoints = self.get_subscriptions_info_by_topic(monitor.topic)
            statuses.append(monitor.status(title, {
                name for name in map(node_of, endpoints) if name}, self._published_types))
        self.diagnostics.publish([*statuses, self._start_status()])
        self.report_state()

    def _start_status(self) -> DiagnosticStatus:
        """Return a status that reports startup faults: a duplicate node name or a missing clock."""
        faults = []
        full_name = self.get_name(), self.get_namespace()
        n_same = self.get_node_names_and_namespaces().count(full_name)
        if n_same > 1:
            faults.append(f'{n_same} nodes are named {self.get_fully_qualified_name()}: stop all '
                          'but one, or rename this one (-r __node:=NAME; if several nodes run in '
                          f'one process, -r {self.get_name()}:__node:=NAME)')
        if self.get_parameter('use_sim_time').value and not self.get_clock().now().nanoseconds:
            faults.append('use_sim_time is set, but no message was received on /clock: start a '
                          'replay, or unset use_sim_time')
        return diagnostics.status_of(
            f'{self.diagnostics.title}: start', '; '.join(faults) or self.state(),
            diagnostics.ERROR if faults else diagnostics.OK)

    def _published_types(self, name: str) -> set[str]:
        """Return the message types that a node publishes; empty if it has not been discovered."""
        namespace, _, leaf = name.rpartition('/')
        try:
            topics = self.get_publisher_names_and_types_by_node(leaf, namespace or '/')
        except NodeNameNonExistentError:
            return set()
        return {kind for _, kinds in topics for kind in kinds}
