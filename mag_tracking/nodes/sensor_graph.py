"""Publishers of the sensors' topics, and faults in how they are connected."""

from collections.abc import Mapping

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.network.topics import absolute
from mag_tracking.stages.health.sensor_health import Finding

MAX_NAMED = 4
"""Topics that a message names; of more it gives the number."""


def topic_findings(node: Node, sensor: str, topic: str) -> list[Finding]:
    """Faults of a sensor's topic, an absolute name."""
    publishers = node.get_publishers_info_by_topic(topic)
    found = [Finding(True, sensor, f'{p.node_name} publishes {p.topic_type} on {topic}',
                     f'it has to be {MAGNETIC_FIELD}')
             for p in publishers if p.topic_type != MAGNETIC_FIELD]
    if len(publishers) > 1:
        names = ', '.join(sorted(name for name in map(node_of, publishers) if name)) or 'unknown'
        found.append(Finding(True, sensor, f'{len(publishers)} publishers of {topic}: {names}',
                             'stop all but one'))
    return found


def node_of(endpoint: TopicEndpointInfo) -> str | None:
    """Absolute name of the node of an endpoint; None where it is not discovered yet.

    The middleware announces endpoints and nodes separately, and has a placeholder in between.
    """
    namespace = endpoint.node_namespace
    return absolute(endpoint.node_name, namespace) if namespace.startswith('/') else None


def missing_publisher(node: Node, sensor: str, topic: str, known: Mapping[str, str]) -> Finding:
    """Fault of a sensor whose `topic` is silent, with the fields that are published instead.

    `known` is {sensor: topic} of the whole network.
    """
    if node.count_publishers(topic):
        return Finding(True, sensor, f'nothing has come on {topic}, which is published',
                       'look at the sensor and its driver')
    own = node.get_namespace().rstrip('/')
    others = sorted((name for name, kinds in node.get_topic_names_and_types()
                     if MAGNETIC_FIELD in kinds and name not in known.values()
                     and not name.endswith('_calibrated') and node.count_publishers(name)),
                    key=lambda name: (not name.startswith(f'{own}/'), name))
    advice = 'start its driver, or remap its topic'
    if others:
        advice += f'; magnetic fields are published on {shortened(others)}'
    return Finding(True, sensor, f'nothing has come: {topic} is not published', advice)


def shortened(names: list[str]) -> str:
    """The first of many names, and how many more there are."""
    more = len(names) - MAX_NAMED
    return ', '.join(names[:MAX_NAMED]) + (f' and {more} more' if more > 0 else '')
