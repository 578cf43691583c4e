"""Inspection and control of a ROS graph; a substitute for `ros2`, which is not on PyPI."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rclpy
import yaml
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces import srv
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

from mag_tracking.errors import GraphError
from mag_tracking.nodes.connections import is_latched, subscriber_qos
from mag_tracking.nodes.convert import message_class
from mag_tracking.nodes.middleware import RCLError, init_ros, make_executor, shut_down, spin

DISCOVERY_S = 1.5
"""[s] Time allowed for discovery of the nodes of the graph."""
RESPONSE_TIMEOUT_S = 5.0
"""[s] Maximum time for a response."""
MAX_ATTEMPTS = 3
"""Maximum number of attempts per query."""
CHANGE_TIMEOUT_S = 60.0
"""[s] Maximum time for a request that changes a node; some devices open slowly."""


class Observer:
    """Examines the graph, calls services and receives messages through a node."""

    def __init__(self, node: Node, executor: Executor) -> None:
        self.node, self._executor = node, executor

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Spin until a condition holds or a timeout in s expires; return whether it holds."""
        end = time.monotonic() + seconds
        spin(self._executor, lambda: condition() or time.monotonic() > end)
        return condition()

    def call(self, service_type: Any, name: str, once: bool = False, **fields: Any) -> Any:
        """Call a service, only `once` (after discovery) if it changes the server, because the first
        response may be lost; raises GraphError if the service is missing or does not respond."""
        with valid_names():
            client = self.node.create_client(service_type, name)
        try:
            if not self.wait(client.service_is_ready, RESPONSE_TIMEOUT_S):
                raise GraphError(f'service {name} not found; check the name and that the node is '
                                 'running')
            if once:
                self.wait(lambda: False, DISCOVERY_S)
            futures: list[Any] = []
            for _ in range(1 if once else MAX_ATTEMPTS):
                futures.append(client.call_async(service_type.Request(**fields)))
                if self.wait(lambda: any(f.done() for f in futures),
                             CHANGE_TIMEOUT_S if once else RESPONSE_TIMEOUT_S / MAX_ATTEMPTS):
                    return next(f for f in futures if f.done()).result()
            raise GraphError(f'service {name} does not respond')
        finally:
            self.node.destroy_client(client)


@contextmanager
def valid_names() -> Iterator[None]:
    """Convert the exceptions for invalid ROS names in the context to GraphError."""
    try:
        yield
    except (NameValidationException, RCLError) as error:
        raise GraphError(str(error)) from error


@contextmanager
def observer(ros_arguments: Sequence[str] = ()) -> Iterator[Observer]:
    """Create an `Observer` that is shut down when the context ends."""
    init_ros(list(ros_arguments))
    executor, node = make_executor(), Node('mag_tracking_observer', start_parameter_services=False)
    executor.add_node(node)
    status = 1
    try:
        yield Observer(node, executor)
        status = 0
    finally:
        shut_down([node], executor, status)


def topics(graph: Observer) -> list[tuple[str, str, int, int]]:
    """Topics of the graph: name, type, number of publishers and number of subscribers."""
    graph.wait(lambda: False, DISCOVERY_S)
    node = graph.node
    return [(name, ', '.join(kinds), node.count_publishers(name), node.count_subscribers(name))
            for name, kinds in sorted(node.get_topic_names_and_types())]


def receive_messages(graph: Observer, topic: str, handle: Callable[[Any], bool],
                     stopped: Callable[[], bool]) -> None:
    """Receive messages of a topic, and earlier ones if all publishers are latched, until `handle`
    returns False or `stopped()`; raises GraphError if topic or type are unknown."""
    with valid_names():
        name = graph.node.resolve_topic_name(topic)
        graph.node.count_publishers(name)
    if not graph.wait(lambda: graph.node.count_publishers(name) > 0 or stopped(),
                      RESPONSE_TIMEOUT_S):
        raise GraphError(f'{name} has no publisher; check the name and that the node is running')
    if stopped():
        return
    infos = graph.node.get_publishers_info_by_topic(name)
    cls = message_class(infos[0].topic_type)
    if cls is None:
        raise GraphError(f'{name}: message type {infos[0].topic_type} is not installed')
    latched = all(map(is_latched, infos))
    stops: list[bool] = []

    def handle_one(message: Any) -> None:
        # More messages may be queued after the last one to handle.
        if not stops and not handle(message):
            stops.append(True)

    graph.node.create_subscription(cls, name, handle_one, subscriber_qos(100, latched))
    while rclpy.ok() and not stops and not stopped():
        graph.wait(lambda: bool(stops) or stopped(), 1.0)


def as_dict(message: Any) -> Any:
    """Convert a message to nested dicts and lists."""
    if hasattr(message, 'get_fields_and_field_types'):
        return {name: as_dict(getattr(message, name))
                for name in message.get_fields_and_field_types()}
    if hasattr(message, 'tolist'):
        return message.tolist()
    if isinstance(message, (list, tuple)):
        return [as_dict(v) for v in message]
    # A field of type byte, such as the level of a DiagnosticStatus.
    return int.from_bytes(message, 'big') if isinstance(message, bytes) else message


def as_text(message: Any) -> str:
    """Convert a message to YAML."""
    return str(yaml.safe_dump(as_dict(message), sort_keys=False, default_flow_style=None,
                              width=100, allow_unicode=True))


def parameter_lines(graph: Observer, node: str, name: str | None = None) -> list[str]:
    """Parameters of a node, or one, with descriptions; raises GraphError if missing."""
    names = [name] if name is not None else list(
        graph.call(srv.ListParameters, f'{node}/list_parameters').result.names)
    values = graph.call(srv.GetParameters, f'{node}/get_parameters', names=names).values
    descriptors = graph.call(
        srv.DescribeParameters, f'{node}/describe_parameters', names=names).descriptors
    if name is not None and not (values and values[0].type):
        raise GraphError(f'{node} has no parameter {name}')
    return [f'{n}: {parameter_value_to_python(v)}'
            + ('  (read-only)' if d.read_only else '')
            + (f'  # {d.description}' if d.description else '')
            for n, v, d in sorted(zip(names, values, descriptors, strict=True),
                                  key=lambda entry: entry[0])]


def set_parameter(graph: Observer, node: str, name: str, text: str) -> None:
    """Set a parameter to a value in YAML; raises GraphError if invalid or rejected."""
    try:
        value = yaml.safe_load(text)
        (kind,) = graph.call(
            srv.GetParameterTypes, f'{node}/get_parameter_types', names=[name]).types or (0,)
        if kind == Parameter.Type.DOUBLE.value and isinstance(value, int):
            value = float(value)
        parameter = Parameter(name, value=value)
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise GraphError(f'parameter {name}: {text!r} is not a valid value: {error}') from error
    result = graph.call(srv.SetParameters, f'{node}/set_parameters', once=True,
                        parameters=[parameter.to_parameter_msg()]).results[0]
    if not result.successful:
        raise GraphError(f'{node} rejects parameter {name}: {result.reason}')


def lifecycle_state(graph: Observer, node: str) -> tuple[str, list[str]]:
    """Label of a lifecycle node's state, and labels of the transitions that are now possible."""
    state = graph.call(GetState, f'{node}/get_state').current_state.label
    return state, [t.label for t in _possible_transitions(graph, node)]


def _possible_transitions(graph: Observer, node: str) -> list[Any]:
    """Transitions of a lifecycle node that are now possible."""
    return [t.transition for t in graph.call(
        GetAvailableTransitions, f'{node}/get_available_transitions').available_transitions]


def change_lifecycle_state(graph: Observer, node: str, transition: str) -> None:
    """Request a transition of a node by its label; raises GraphError on failure."""
    possible = _possible_transitions(graph, node)
    matches = [t for t in possible if t.label == transition]
    if not matches:
        names = ', '.join(t.label for t in possible)
        raise GraphError(f'{node}: transition {transition} is not possible in the current state; '
                         f'possible: {names}')
    if not graph.call(ChangeState, f'{node}/change_state', once=True,
                      transition=Transition(id=matches[0].id)).success:
        raise GraphError(f'{node}: transition {transition} failed; see the log of the node')
