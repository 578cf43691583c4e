"""Detection of faults in the publishers of sensor topics."""

from collections.abc import Mapping

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.sensor_network import absolute
from mag_tracking.stages.health.diagnosis import Cause, Finding

MAX_NAMED = 4
"""Maximum number of names in a message; the remaining names are only counted."""


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
    """Absolute name of the node of an endpoint; None if the node has not yet been announced.

    The middleware announces endpoints and nodes separately. Until the node is announced, its name
    is a placeholder.
    """
    namespace = endpoint.node_namespace
    return absolute(endpoint.node_name, namespace) if namespace.startswith('/') else None


def no_message_finding(node: Node, sensor: str, topic: str, known: Mapping[str, str]) -> Finding:
    """Fault of a sensor from which no message has been received.

    If the topic has no publisher, the advice names other topics with magnetic fields, except those
    of `known`, the topic of each sensor.
    """
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
