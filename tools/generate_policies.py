"""Generate config/security/policies.xml: the SROS 2 access policies of the nodes.

The program creates the nodes and lists their topics and services. `--check` compares the file with
the result; `--namespace /robot1` prints the policies of nodes in a namespace.
"""

import os
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
POLICIES = ROOT / 'config' / 'security' / 'policies.xml'
SENSORS = ('mag_1', 'mag_2')
"""Sensors of the bundled network file, which a wildcard replaces in the policies."""
COMMENT = ' Written by tools/generate_policies.py; do not edit. How to use it: docs/guides/ros.md. '
RECORDING = ROOT / 'test' / 'data' / 'vehicles' / 'straight_car_right.mcap'


def nodes(folder, namespace):
    """Create the nodes, one after the other, in this process."""
    from rclpy.parameter import Parameter

    from mag_tracking.nodes.calibration_node import CalibrationNode
    from mag_tracking.nodes.detection_node import DetectionNode
    from mag_tracking.nodes.driver_node import DriverNode
    from mag_tracking.nodes.replay_node import ReplayNode
    from mag_tracking.nodes.tracker_node import TrackerNode

    network = Parameter('network', value=str(ROOT / 'config' / 'network.yaml'))
    drivers = folder / 'drivers.yaml'
    drivers.write_text('board: {transport: udp, udp: {port: 47199, address: 127.0.0.1}, framing: '
                       'text, text: {fields: [x, y, z]}, unit: nT, sensor: mag_1}\n')
    for make, more in (
            (CalibrationNode, {}), (DetectionNode, {}), (TrackerNode, {'publish_tf': True}),
            (DriverNode, {'drivers': str(drivers), 'batches': True}),
            (ReplayNode, {'recording': str(RECORDING)})):
        yield make(namespace=namespace, parameter_overrides=[
            network, *(Parameter(name, value=value) for name, value in more.items())])


def policy_expression(name):
    """Absolute name in a policy, with a wildcard instead of the sensor."""
    for sensor in SENSORS:
        name = name.replace(f'/{sensor}/', '/*/')
    return name


def add_rules(profile, kind, access, names):
    """Add the rules of one kind to a profile."""
    if not names:
        return
    group = ElementTree.SubElement(profile, kind, {access: 'ALLOW'})
    for name in sorted(set(map(policy_expression, names))):
        ElementTree.SubElement(group, kind.removesuffix('s')).text = name


def policies(namespace='/'):
    """Create the nodes in a namespace; return the content of the policy file."""
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    from mag_tracking.nodes.middleware import init_ros
    init_ros()
    root = ElementTree.Element('policy', {'version': '0.2.0'})
    root.append(ElementTree.Comment(COMMENT))
    enclaves = ElementTree.SubElement(root, 'enclaves')
    with tempfile.TemporaryDirectory() as folder:
        os.environ['ROS_HOME'] = folder
        for node in nodes(Path(folder), namespace):
            name = node.get_name()
            enclave = ElementTree.SubElement(enclaves, 'enclave', {'path': f'/mag_tracking/{name}'})
            profile = ElementTree.SubElement(
                ElementTree.SubElement(enclave, 'profiles'), 'profile', {
                    'ns': namespace, 'node': name})
            add_rules(profile, 'topics', 'publish', [p.topic_name for p in node.publishers]
                      + ['/rosout', '/parameter_events'])
            add_rules(profile, 'topics', 'subscribe', [s.topic_name for s in node.subscriptions]
                      + ['/clock'])
            add_rules(profile, 'services', 'reply', [s.service_name for s in node.services])
            node.destroy_node()
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding='unicode') + '\n'


def main():
    """Write the file, or compare or print its content; return the exit status."""
    if '--namespace' in sys.argv:
        print(policies(sys.argv[sys.argv.index('--namespace') + 1]), end='')
        return 0
    text = policies()
    if '--check' in sys.argv:
        if text != POLICIES.read_text():
            print(f'{POLICIES} is not up to date: run tools/generate_policies.py')
            return 1
        return 0
    POLICIES.parent.mkdir(exist_ok=True)
    POLICIES.write_text(text)
    print(f'wrote {POLICIES.relative_to(ROOT)}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
