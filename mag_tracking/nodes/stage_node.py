"""The generic node: parameters, network, diagnostics and the main loop."""

import gc
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from mag_tracking_msgs.msg import FieldReadings
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.task import Future

from mag_tracking.errors import MagTrackingError, RecordingError, SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.messages.schema import readings_of, stamp_ns
from mag_tracking.network.file import read_network
from mag_tracking.nodes.flow import Flow, Listener
from mag_tracking.nodes.middleware import begin
from mag_tracking.nodes.ros_params import declare_settings, fixed_parameter
from mag_tracking.nodes.sensor_graph import node_of, shortened
from mag_tracking.nodes.shutdown import limit_exit_time, shut_down
from mag_tracking.nodes.status_log import StatusLog
from mag_tracking.nodes.steady_timer import steady_timer
from mag_tracking.pipeline import settings_for
from mag_tracking.records import Readings
from mag_tracking.stages.stage import Stage

RESULTS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
"""For what people subscribe to."""
STREAM = QoSProfile(depth=500, reliability=ReliabilityPolicy.RELIABLE)
"""Between the nodes, for who hears, and for a replay, which may be fast: nothing may be lost while
the tracker starts a bank."""
SENT = QoSProfile(depth=250, reliability=ReliabilityPolicy.RELIABLE)
"""Between the nodes, for who sends. So much is kept for a node that was killed; the one that comes
after it has to be told that this is not for it, and can ask of 256 messages at once (RTPS 2.3,
8.3.5.5). Of a longer past it asks for the rest only seconds later, and hears nothing till then."""
SENSORS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort matches reliable and best-effort drivers alike."""
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)


TRANSFORMS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of /tf, that of tf2."""
READY = 'ready'

_Record = TypeVar('_Record')


class StageNode(Node):
    """A node that knows the network and the settings of one group of stages."""

    def __init__(self, name: str, group: str, **node_arguments: Any) -> None:
        """Raises SettingsError or NetworkError where parameters or network are unusable."""
        super().__init__(name, **node_arguments)
        path = fixed_parameter(self, 'network', '', 'Path of the network file.')
        if not path:
            raise SettingsError(f'{name}: parameter network: the path of a network.yaml is needed')
        target = fixed_parameter(self, 'target', 'vehicle', 'What moves: vehicle or magnet.')
        reliable = fixed_parameter(self, 'reliable_input', False, 'The sensors\' topics are '
                                   'reliable, as those of a replay are.')
        self.network_path = Path(path).resolve()
        self.title = title_of(self)
        self.input_qos = STREAM if reliable else SENSORS
        self.is_replayed = reliable or self.get_parameter('use_sim_time').value
        self.network = read_network(self.network_path)
        self.settings = declare_settings(self, settings_for(target), group)
        if self.settings.track.target != target:
            raise SettingsError(f'{name}: track.target is {self.settings.track.target!r}, but '
                                f'target is {target!r}')
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', RESULTS)
        self._reported: dict[tuple[str, str], int] = {}
        self.flows: dict[str, Flow] = {}
        self._listeners: list[Listener] = []
        # When the message came that is worked on, by the clock of ROS.
        self.now_ns = 0
        self._log, self._reported_state = StatusLog(self.get_logger()), ''
        steady_timer(self, 1.0, self._publish_diagnostics)

    def state(self) -> str:
        """State of the node: waiting for its input, or ready."""
        silent = [topic for flow in self.flows.values() if flow.heard is None
                  for topic in flow.topics]
        return f'waiting for {shortened(silent)}' if silent else READY

    def report_state(self) -> None:
        """Log the state where it has changed."""
        state = self.state()
        if state != self._reported_state:
            self._reported_state = state
            self._log.tell(state)

    @property
    def sensor_topics(self) -> tuple[str, ...]:
        """The sensors' topics: absolute names, as remapped."""
        return tuple(map(self.resolve_topic_name, self.network.topics))

    def stages(self) -> dict[str, Stage[Any, Any]]:
        """{name: stage} whose counts are published."""
        raise NotImplementedError

    def queues(self) -> dict[str, int]:
        """{name of a stage: how many records it holds}."""
        return {}

    def expect(self, role: str, topic: str, publishes: str) -> None:
        """Report in diagnostics when the node of the next step no longer subscribes to `topic`.

        `publishes` is a type of message, by which it is known.
        """
        self._listeners.append(Listener(role, self.resolve_topic_name(topic), publishes))

    def publisher(self, message_type: Any, topic: str, qos: QoSProfile) -> Publisher:
        """A publisher that logs a subscriber with unfit QoS."""
        def unfit(event: Any) -> None:
            self.get_logger().warning(
                f'a subscriber of {topic} asks for another QoS (policy '
                f'{event.last_policy_kind}): it gets nothing')

        events = PublisherEventCallbacks(incompatible_qos=unfit)
        return self.create_publisher(message_type, topic, qos, event_callbacks=events)

    def subscription(self, message_type: Any, topic: str, callback: Callable[[Any], None],
                     qos: QoSProfile, source: str = '', batches: bool = False) -> Subscription:
        """A subscription that logs a publisher with unfit QoS.

        With a `source`, the step that sends, diagnostics tell of what comes and how
        late; `batches` may come in place of the other topics.
        """
        flow = self.flows.setdefault(source, Flow(source)) if source else None
        if flow is not None:
            (flow.batches if batches else flow.topics).append(self.resolve_topic_name(topic))

        def unfit(event: Any) -> None:
            self.get_logger().warning(
                f'the publisher of {topic} offers another QoS (policy {event.last_policy_kind}): '
                'nothing comes from it')

        def lost(event: Any) -> None:
            if flow is not None:
                flow.n_lost += event.total_count_change

        def take(message: Any) -> None:
            assert flow is not None
            began = time.monotonic()
            self.now_ns = self.get_clock().now().nanoseconds
            callback(message)
            flow.note(stamp_ns(message.header.stamp), self.now_ns, began)

        return self.create_subscription(
            message_type, topic, callback if flow is None else take, qos,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=unfit, message_lost=lost))

    def direct(self, source: str, topics: Sequence[str], callback: Callable[[_Record], None],
               stamp_of: Callable[[_Record], int]) -> Callable[[_Record], None]:
        """A function that takes records of the step before, in place of subscriptions.

        Diagnostics tell the same of them: `source` is that step, which publishes on the `topics`;
        `stamp_of` gives the timestamp [ns] of a record.
        """
        flow = self.flows.setdefault(source, Flow(source))
        flow.topics += map(self.resolve_topic_name, topics)

        def take(record: _Record) -> None:
            began = time.monotonic()
            self.now_ns = self.get_clock().now().nanoseconds
            callback(record)
            flow.note(stamp_of(record), self.now_ns, began)

        return take

    def readings_of(self, message: FieldReadings, stage: Stage[Any, Any]) -> Readings | None:
        """`Readings` of a FieldReadings; one that is none is a rejection of `stage`, and None."""
        try:
            return readings_of(message)
        except RecordingError as error:
            stage.counts['rejected: bad readings'] += 1
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return None

    def _publish_diagnostics(self) -> None:
        """Counts of the stages; a warning where something was rejected since the last time."""
        statuses, queues = [], self.queues()
        for name, stage in self.stages().items():
            bad = {k: n for k, n in stage.counts.items() if k.startswith('rejected: ')}
            news = {k: n for k, n in bad.items() if n != self._reported.get((name, k), 0)}
            self._reported |= {(name, cause): n for cause, n in news.items()}
            statuses.append(DiagnosticStatus(
                level=DiagnosticStatus.WARN if news else DiagnosticStatus.OK,
                name=f'{self.title}: {name}', hardware_id='magnetometer network',
                message='; '.join(f'{cause}: {n}' for cause, n in news.items()) or 'running',
                values=[KeyValue(key=k, value=str(n)) for k, n in sorted(
                    {**stage.counts, **({'queue': queues[name]} if name in queues else {})}.items()
                )]))
        statuses += [flow.status(self.title, partial(self._has_publisher, flow))
                     for flow in self.flows.values()]
        for listener in self._listeners:
            ends = self.get_subscriptions_info_by_topic(listener.topic)
            statuses.append(listener.status(self.title, {
                name for name in map(node_of, ends) if name}, self._published_types))
        self.publish_statuses([*statuses, *self._own_statuses()])
        self.report_state()

    def _own_statuses(self) -> list[DiagnosticStatus]:
        """Faults of how the node was started."""
        faults = []
        own = self.get_name(), self.get_namespace()
        n_same = self.get_node_names_and_namespaces().count(own)
        if n_same > 1:
            faults.append(f'{n_same} nodes are named {self.get_fully_qualified_name()}: stop all '
                          'but one, or rename it (-r __node:=NAME; where several run in one '
                          f'process, -r {self.get_name()}:__node:=NAME)')
        if self.get_parameter('use_sim_time').value and not self.get_clock().now().nanoseconds:
            faults.append('use_sim_time is set, and nothing has come on /clock')
        return [DiagnosticStatus(
            level=DiagnosticStatus.ERROR if faults else DiagnosticStatus.OK,
            name=f'{self.title}: start', hardware_id='magnetometer network',
            message='; '.join(faults) or self.state())]

    def _published_types(self, name: str) -> set[str]:
        """Types of the messages that a node publishes, as far as it is discovered."""
        namespace, _, leaf = name.rpartition('/')
        try:
            found = self.get_publisher_names_and_types_by_node(leaf, namespace or '/')
        except NodeNameNonExistentError:
            return set()
        return {kind for _, kinds in found for kind in kinds}

    def _has_publisher(self, flow: Flow) -> bool:
        """Whether somebody would still publish what the flow is of."""
        return any(map(self.count_publishers, (*flow.topics, *flow.batches)))

    def publish_statuses(self, statuses: list[DiagnosticStatus]) -> None:
        """Publish [DiagnosticStatus], if there are any, and log faults."""
        for status in statuses:
            self._log.note(status)
        if statuses:
            array = DiagnosticArray(status=statuses)
            array.header.stamp = self.get_clock().now().to_msg()
            self._diagnostics.publish(array)


def has_subscribers(publisher: Publisher) -> bool:
    """Whether somebody listens: what is large is made for nobody else."""
    return publisher.get_subscription_count() > 0


def title_of(node: Node) -> str:
    """The name of a node in diagnostics: with its namespace, where it has one."""
    return node.get_fully_qualified_name().removeprefix('/')


def make_executor() -> Executor:
    """The events executor, a tenth of the cost of the others; else the single-threaded one."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def freeze() -> None:
    """Keep what was loaded for good: to look through it again and again for garbage takes longer
    than a reading may be late.
    """
    gc.collect()
    gc.freeze()


def spin(executor: Executor, until: Callable[[], bool] = lambda: False) -> None:
    """Run `executor` until ROS shuts down or `until` is true (asked a few times a second)."""
    try:
        while rclpy.ok() and not until():
            # EventsExecutor.spin() of these wheels hangs (a time-out overflows):
            # a future that never comes, with a finite time-out, does not.
            executor.spin_until_future_complete(Future(), 0.2)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


def main(node_class: Callable[[], Node], arguments: list[str] | None = None) -> int:
    """Run one node as a process until SIGINT or SIGTERM; returns the exit status."""
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as seen:
        return _run_until(seen, node_class, arguments)


def _run_until(seen: list[int], node_class: Callable[[], Node],
               arguments: list[str] | None) -> int:
    """Run one node until there is something in `seen`."""
    try:
        begin(arguments)
    except SettingsError as error:
        rclpy.logging.get_logger(node_class.__name__).fatal(str(error))
        return 1
    executor, node, status = make_executor(), None, 1
    try:
        node = node_class()
        executor.add_node(node)
        freeze()
        spin(executor, lambda: bool(seen))
        status = 0
    except (MagTrackingError, ParameterException) as error:
        rclpy.logging.get_logger(node_class.__name__).fatal(str(error))
        # A node that is only half built leaves the middleware when the error is deleted.
        limit_exit_time(status)
    except (KeyboardInterrupt, ExternalShutdownException):
        status = 0
    finally:
        shut_down([] if node is None else [node], executor, status)
    return status
