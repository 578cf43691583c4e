"""The generic node: parameters, network, diagnostics and the main loop."""

import signal

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from mag_tracking.errors import MagTrackingError, SettingsError
from mag_tracking.interrupts import noted_signals
from mag_tracking.io.network_file import read_network
from mag_tracking.nodes.ros_params import declare_settings
from mag_tracking.pipeline import settings_for

RESULTS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
"""For what people subscribe to."""
STREAM = QoSProfile(depth=500, reliability=ReliabilityPolicy.RELIABLE)
"""Between the nodes: nothing may be lost while the tracker starts a bank."""
SENSORS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort matches reliable and best-effort drivers alike."""
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)


class StageNode(Node):
    """A node that knows the network and the settings of one group of stages."""

    OWN_PARAMETERS = ('network', 'target', 'reliable_input', 'use_sim_time')

    def __init__(self, name, group, **node_arguments):
        """Raises SettingsError or NetworkError where parameters or network are unusable."""
        super().__init__(name, **node_arguments)
        path = self.declare_parameter('network', '').value
        if not path:
            raise SettingsError(f'{name}: parameter network: the path of a network.yaml is needed')
        target = self.declare_parameter('target', 'vehicle').value
        reliable = self.declare_parameter('reliable_input', False).value
        self.input_qos = STREAM if reliable else SENSORS
        self.network = read_network(path)
        self.settings = declare_settings(self, settings_for(target), group, self.OWN_PARAMETERS)
        if self.settings.track.target != target:
            raise SettingsError(f'{name}: track.target is {self.settings.track.target!r}, but '
                                f'target is {target!r}')
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', RESULTS)
        self._reported = {}
        self.create_timer(1.0, self._publish_diagnostics)

    def stages(self):
        """{name: stage} whose counts are published."""
        raise NotImplementedError

    def statuses(self):
        """More [DiagnosticStatus] than the counts of the stages."""
        return []

    def publisher(self, message_type, topic, qos):
        """A publisher that logs a subscriber with unfit QoS."""
        events = PublisherEventCallbacks(incompatible_qos=lambda e: self.get_logger().warning(
            f'a subscriber of {topic} asks for another QoS (policy {e.last_policy_kind}): '
            'it gets nothing'))
        return self.create_publisher(message_type, topic, qos, event_callbacks=events)

    def subscription(self, message_type, topic, callback, qos):
        """A subscription that logs a publisher with unfit QoS."""
        events = SubscriptionEventCallbacks(incompatible_qos=lambda e: self.get_logger().warning(
            f'the publisher of {topic} offers another QoS (policy {e.last_policy_kind}): '
            'nothing comes from it'))
        return self.create_subscription(message_type, topic, callback, qos,
                                        event_callbacks=events)

    def _publish_diagnostics(self):
        """Counts of the stages; a warning where something was rejected since the last time."""
        array = DiagnosticArray()
        array.header.stamp = self.get_clock().now().to_msg()
        for name, stage in self.stages().items():
            bad = {k: n for k, n in stage.counts.items() if k.startswith('rejected: ')}
            news = {k: n for k, n in bad.items() if n != self._reported.get((name, k), 0)}
            for cause, n in news.items():
                self._reported[name, cause] = n
                self.get_logger().warning(f'{name}: {cause}: {n}')
            array.status.append(DiagnosticStatus(
                level=DiagnosticStatus.WARN if news else DiagnosticStatus.OK,
                name=f'{self.get_name()}: {name}', hardware_id='magnetometer network',
                message='samples were rejected' if news else 'running',
                values=[KeyValue(key=k, value=str(n)) for k, n in sorted(stage.counts.items())]))
        array.status += self.statuses()
        self._diagnostics.publish(array)


def make_executor():
    """The events executor, a tenth of the cost of the others; else the single-threaded one."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def spin(executor, until=lambda: False):
    """Run `executor` until ROS shuts down or `until` is true (asked a few times a second)."""
    try:
        while rclpy.ok() and not until():
            # EventsExecutor.spin() of these wheels hangs (a time-out overflows):
            # a future that never comes, with a finite time-out, does not.
            executor.spin_until_future_complete(Future(), 0.2)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


def main(node_class, arguments=None):
    """Run one node as a process until SIGINT or SIGTERM; returns the exit status."""
    with noted_signals(signal.SIGINT, signal.SIGTERM) as seen:
        return _run_until(seen, node_class, arguments)


def _run_until(seen, node_class, arguments):
    """Run one node until there is something in `seen`."""
    # Its own handlers raise KeyboardInterrupt wherever Python is, in its C++ too.
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    executor, node = make_executor(), None
    try:
        node = node_class()
        executor.add_node(node)
        spin(executor, lambda: bool(seen))
    except (MagTrackingError, ParameterException) as error:
        rclpy.logging.get_logger(node_class.__name__).fatal(str(error))
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            executor.remove_node(node)
            node.destroy_node()
        executor.shutdown()
        rclpy.try_shutdown()
    return 0
