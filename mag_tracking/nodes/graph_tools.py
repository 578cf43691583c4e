"""Small substitutes for the command `ros2`, which ROS from PyPI lacks."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rclpy
import yaml
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
)
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from mag_tracking.errors import GraphError
from mag_tracking.nodes.convert import message_class
from mag_tracking.nodes.middleware import RCLError, begin
from mag_tracking.nodes.shutdown import shut_down
from mag_tracking.nodes.stage_node import make_executor, spin

DISCOVERY_S = 1.5
"""[s] Time for the nodes of the graph to be found."""
ANSWER_S = 5.0
"""[s] Longest wait for an answer."""
TRIES = 3
CHANGE_S = 60.0
"""[s] Longest wait for a change: a device may take long to open."""


class Observer:
    """A node that looks at the graph, asks, and listens.

    Attributes
    ----------
    node : Node
    """

    def __init__(self, node: Node, executor: Executor) -> None:
        self.node, self._executor = node, executor

    def wait(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Spin until the condition holds or the time is over; whether it holds."""
        end = time.monotonic() + seconds
        spin(self._executor, lambda: condition() or time.monotonic() > end)
        return condition()

    def ask(self, service_type: Any, name: str, request: Any, once: bool = False) -> Any:
        """Response of a service; raises GraphError where none comes.

        A query is repeated: the answer of a server that has not discovered the client is lost. A
        change is requested `once`, after a wait for the discovery.
        """
        with valid_names():
            client = self.node.create_client(service_type, name)
        try:
            if not self.wait(client.service_is_ready, ANSWER_S):
                raise GraphError(f'there is no service {name}')
            if once:
                self.wait(lambda: False, DISCOVERY_S)
            futures: list[Any] = []
            for _ in range(1 if once else TRIES):
                futures.append(client.call_async(request))
                if self.wait(lambda: any(f.done() for f in futures),
                             CHANGE_S if once else ANSWER_S / TRIES):
                    return next(f for f in futures if f.done()).result()
            raise GraphError(f'{name} does not answer')
        finally:
            self.node.destroy_client(client)


@contextmanager
def valid_names() -> Iterator[None]:
    """Names that ROS does not allow are a GraphError."""
    try:
        yield
    except (NameValidationException, RCLError) as error:
        raise GraphError(str(error)) from error


@contextmanager
def observer(ros_arguments: Sequence[str] = ()) -> Iterator[Observer]:
    """An `Observer` while the context lasts; if the middleware hangs then, see `leave`."""
    begin(list(ros_arguments))
    executor, node = make_executor(), Node('mag_tracking_observer', start_parameter_services=False)
    executor.add_node(node)
    status = 1
    try:
        yield Observer(node, executor)
        status = 0
    finally:
        shut_down([node], executor, status)


def topics(graph: Observer) -> list[tuple[str, str, int, int]]:
    """[(topic, type, publishers, subscribers)] of the graph."""
    graph.wait(lambda: False, DISCOVERY_S)
    node = graph.node
    return [(name, ', '.join(kinds), node.count_publishers(name), node.count_subscribers(name))
            for name, kinds in sorted(node.get_topic_names_and_types())]


def listen(graph: Observer, topic: str, take: Callable[[Any], bool],
           stopped: Callable[[], bool]) -> None:
    """Hand the messages of a topic to `take` until it returns False, or until `stopped()`.

    The quality of service is that of the publishers: latched messages come, too. Raises
    GraphError where nobody publishes the topic, or its type is not installed.
    """
    with valid_names():
        name = graph.node.resolve_topic_name(topic)
        graph.node.count_publishers(name)
    if not graph.wait(lambda: graph.node.count_publishers(name) > 0 or stopped(), ANSWER_S):
        raise GraphError(f'nobody publishes {name}')
    if stopped():
        return
    infos = graph.node.get_publishers_info_by_topic(name)
    cls = message_class(infos[0].topic_type)
    if cls is None:
        raise GraphError(f'{name}: {infos[0].topic_type} is not installed')
    latched = all(i.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for i in infos)
    done: list[bool] = []

    def take_one(message: Any) -> None:
        # Several may wait when the last one that is wanted comes.
        if not done and not take(message):
            done.append(True)

    graph.node.create_subscription(
        cls, name, take_one, QoSProfile(
            depth=100, reliability=ReliabilityPolicy.RELIABLE if latched
            else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE))
    while rclpy.ok() and not done and not stopped():
        graph.wait(lambda: bool(done) or stopped(), 1.0)


def as_dict(message: Any) -> Any:
    """A message as nested dicts and lists."""
    if hasattr(message, 'get_fields_and_field_types'):
        return {name: as_dict(getattr(message, name))
                for name in message.get_fields_and_field_types()}
    if hasattr(message, 'tolist'):
        return message.tolist()
    if isinstance(message, (list, tuple)):
        return [as_dict(v) for v in message]
    # A byte, as the level of a diagnostic status is.
    return int.from_bytes(message, 'big') if isinstance(message, bytes) else message


def as_text(message: Any) -> str:
    """A message as YAML."""
    return str(yaml.safe_dump(as_dict(message), sort_keys=False, default_flow_style=None,
                              width=100, allow_unicode=True))


def parameter_lines(graph: Observer, node: str, name: str | None = None) -> list[str]:
    """The parameters of a node with their values and meanings, or one of them."""
    names = [name] if name is not None else list(graph.ask(
        ListParameters, f'{node}/list_parameters', ListParameters.Request()).result.names)
    values = graph.ask(GetParameters, f'{node}/get_parameters',
                       GetParameters.Request(names=names)).values
    about = graph.ask(DescribeParameters, f'{node}/describe_parameters',
                      DescribeParameters.Request(names=names)).descriptors
    if name is not None and not (values and values[0].type):
        raise GraphError(f'{node} has no parameter {name}')
    return [f'{n}: {parameter_value_to_python(v)}'
            + ('  (read-only)' if d.read_only else '')
            + (f'  # {d.description}' if d.description else '')
            for n, v, d in sorted(zip(names, values, about, strict=True), key=lambda row: row[0])]


def set_parameter(graph: Observer, node: str, name: str, text: str) -> None:
    """Set a parameter to a YAML value; raises GraphError where the node refuses."""
    try:
        value = yaml.safe_load(text)
        (kind,) = graph.ask(GetParameterTypes, f'{node}/get_parameter_types',
                            GetParameterTypes.Request(names=[name])).types or (0,)
        if kind == Parameter.Type.DOUBLE.value and isinstance(value, int):
            value = float(value)
        parameter = Parameter(name, value=value)
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise GraphError(f'{name}: {text!r} is not a value: {error}') from error
    result = graph.ask(SetParameters, f'{node}/set_parameters', SetParameters.Request(
        parameters=[parameter.to_parameter_msg()]), once=True).results[0]
    if not result.successful:
        raise GraphError(f'{node} refuses {name}: {result.reason}')


def lifecycle_state(graph: Observer, node: str) -> tuple[str, list[str]]:
    """(state, transitions that are possible) of a lifecycle node."""
    state = graph.ask(GetState, f'{node}/get_state', GetState.Request()).current_state.label
    possible = graph.ask(GetAvailableTransitions, f'{node}/get_available_transitions',
                         GetAvailableTransitions.Request()).available_transitions
    return state, [t.transition.label for t in possible]


def change_lifecycle_state(graph: Observer, node: str, transition: str) -> None:
    """Make a transition; raises GraphError where it is not possible or fails."""
    possible = graph.ask(GetAvailableTransitions, f'{node}/get_available_transitions',
                         GetAvailableTransitions.Request()).available_transitions
    found = [t.transition for t in possible if t.transition.label == transition]
    if not found:
        names = ', '.join(t.transition.label for t in possible)
        raise GraphError(f'{node}: {transition} is not possible now, but {names}')
    request = ChangeState.Request()
    request.transition.id = found[0].id
    if not graph.ask(ChangeState, f'{node}/change_state', request, once=True).success:
        raise GraphError(f'{node}: {transition} has failed')
