"""Print topics, services and parameters of all nodes as JSON: `python -m generator.node_graph`.

Runs in a process of its own, because ROS changes the environment, the signal handlers and the
threads of its process.
"""

import json
import os
import re
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
STANDARD = re.compile(
    'describe_parameters|get_parameter|list_parameters|set_parameters|change_state|get_state|'
    'get_available|get_transition|type_description')
"""Services that every ROS node has."""
STANDARD_PARAMETERS = ('use_sim_time', 'start_type_description_service')
DEFAULTS = {'network': '', 'drivers': '', 'recording': '', 'batches': False, 'publish_tf': False}
"""Defaults of the parameters that `generate_policies.nodes` sets."""


def node_graph():
    """Create the nodes; return [(name, publishers, services, parameters)]."""
    from generate_policies import SENSORS, nodes

    graph = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ['ROS_HOME'] = folder
        for node in nodes(Path(folder), '/'):
            graph.append((node.get_name(), publishers_of(node, SENSORS), services_of(node),
                          parameters_of(node)))
            node.destroy_node()
    return graph


def publishers_of(node, sensors):
    """[(topic, type, QoS)] without the topics of a recording; `<sensor>` replaces sensor names."""
    rows = {}
    for publisher in node.publishers:
        topic = publisher.topic_name
        for sensor in sensors:
            topic = topic.replace(f'/{sensor}/', '/<sensor>/')
        topic = topic if topic in ('/tf', '/tf_static', '/diagnostics', '/clock') \
            else topic.removeprefix('/')
        if topic in ('rosout', 'parameter_events') or topic.endswith('/transition_event') \
                or node.get_name() == 'replay_node' and topic not in ('/clock', '/diagnostics'):
            continue
        qos = publisher.qos_profile
        assert qos.reliability.name == 'RELIABLE'
        latched = 'latched, ' if qos.durability.name == 'TRANSIENT_LOCAL' else ''
        rows[topic] = (topic, type_of(publisher.msg_type), f'{latched}depth {qos.depth}')
    return sorted(rows.values())


def services_of(node):
    """[(name, type)] of the services that only nodes of this package have."""
    names = [(s.service_name.rpartition('/')[2], type_of(s.srv_type)) for s in node.services]
    return sorted((n, kind) for n, kind in names if not STANDARD.search(n))


def parameters_of(node):
    """[(name, default, description)] of the parameters that are not settings of a stage."""
    created = node.get_parameters_by_prefix('')
    return [(name, DEFAULTS.get(name, parameter.value), node.describe_parameter(name).description)
            for name, parameter in sorted(created.items())
            if '.' not in name and name not in STANDARD_PARAMETERS]


def type_of(message):
    """Return the ROS name of a message or service class."""
    package, *_ = message.__module__.split('.')
    return f'{package}/{message.__name__}'


def main():
    """Create the nodes without discovery and print their graph."""
    import rclpy

    from mag_tracking.nodes.middleware import init_ros

    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    init_ros()
    sys.path.insert(0, str(ROOT / 'tools'))
    graph = node_graph()
    print(json.dumps(graph))
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
