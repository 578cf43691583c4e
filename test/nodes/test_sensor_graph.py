"""Names of nodes and topics in the graph, including during discovery."""

from types import SimpleNamespace

import pytest

from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.nodes.connections import node_of, shortened, topic_findings


def endpoint(name, namespace='/', kind=MAGNETIC_FIELD):
    """Endpoint as described by rclpy."""
    return SimpleNamespace(node_name=name, node_namespace=namespace, topic_type=kind)


UNKNOWN_ENDPOINT = endpoint('_NODE_NAME_UNKNOWN_', '_NODE_NAMESPACE_UNKNOWN_')
"""An endpoint that was announced before its node."""


@pytest.mark.parametrize('info, name', [
    (endpoint('a'), '/a'), (endpoint('a', '/n/m'), '/n/m/a'), (UNKNOWN_ENDPOINT, None)])
def test_the_node_of_an_endpoint_has_its_namespace(info, name):
    assert node_of(info) == name


def test_several_publishers_are_a_fault_even_if_their_nodes_are_unknown():
    for publishers, nodes in (
            ([UNKNOWN_ENDPOINT, UNKNOWN_ENDPOINT], 'unknown'),
            ([endpoint('b', '/n'), UNKNOWN_ENDPOINT, endpoint('a')], '/a, /n/b')):
        graph = SimpleNamespace(get_publishers_info_by_topic=lambda _, found=publishers: found)
        (finding,) = topic_findings(graph, 'mag_1', '/mag_1/imu/mag')
        assert finding.fault == f'{len(publishers)} publishers of /mag_1/imu/mag: {nodes}'


def test_many_names_are_shortened():
    assert shortened(['a', 'b']) == 'a, b'
    assert shortened(list('abcdefg')) == 'a, b, c, d and 3 more'
