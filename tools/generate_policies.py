"""Write config/security/policies.xml: what each node may do, as SROS 2 has it.

By what the nodes do: they are created, and the graph is asked. `--check` compares.
"""

import os
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
POLICIES = ROOT / 'config' / 'security' / 'policies.xml'
SENSORS = ('mag_1', 'mag_2')
"""Of the bundled network file: in the policies any sensor takes their place."""
COMMENT = """
Written by tools/generate_policies.py; do not edit. Policies for SROS 2 of a ROS from apt:
  ros2 security create_keystore keys
  ros2 security generate_artifacts -k keys -p policies.xml
Then start each node with
  ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce ROS_SECURITY_KEYSTORE=keys
  ... ros-args -enclave /mag_tracking/NODE (with two dashes each)
In a namespace put it before the names of the nodes (profile ns).
"""


def nodes(folder):
    """The nodes, in this process."""
    from rclpy.parameter import Parameter

    from mag_tracking.nodes.calibration_node import CalibrationNode
    from mag_tracking.nodes.detection_node import DetectionNode
    from mag_tracking.nodes.driver_node import DriverNode
    from mag_tracking.nodes.tracker_node import TrackerNode

    network = Parameter('network', value=str(ROOT / 'config' / 'network.yaml'))
    drivers = folder / 'drivers.yaml'
    drivers.write_text('board: {transport: udp, udp: {port: 47199, address: 127.0.0.1}, framing: '
                       'text, text: {fields: [x, y, z]}, unit: nT, sensor: mag_1}\n')
    yield CalibrationNode(parameter_overrides=[network])
    yield DetectionNode(parameter_overrides=[network])
    yield TrackerNode(parameter_overrides=[network, Parameter('publish_tf', value=True)])
    yield DriverNode(parameter_overrides=[
        network, Parameter('drivers', value=str(drivers)), Parameter('batches', value=True)])


def expression(name):
    """A name in a policy: relative to the root, any sensor in place of one."""
    for sensor in SENSORS:
        name = name.replace(f'/{sensor}/', '/*/')
    return name


def add(profile, kind, what, names):
    """Rules of one kind."""
    if not names:
        return
    group = ElementTree.SubElement(profile, kind, {what: 'ALLOW'})
    for name in sorted(set(map(expression, names))):
        ElementTree.SubElement(group, kind.removesuffix('s')).text = name


def policies():
    """The text of the file."""
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'OFF'
    from mag_tracking.nodes.middleware import begin
    begin()
    root = ElementTree.Element('policy', {'version': '0.2.0'})
    root.append(ElementTree.Comment(COMMENT))
    enclaves = ElementTree.SubElement(root, 'enclaves')
    with tempfile.TemporaryDirectory() as folder:
        os.environ['ROS_HOME'] = folder
        for node in nodes(Path(folder)):
            name = node.get_name()
            enclave = ElementTree.SubElement(enclaves, 'enclave', {'path': f'/mag_tracking/{name}'})
            profile = ElementTree.SubElement(
                ElementTree.SubElement(enclave, 'profiles'), 'profile', {'ns': '/', 'node': name})
            add(profile, 'topics', 'publish', [p.topic_name for p in node.publishers]
                + ['/rosout', '/parameter_events'])
            add(profile, 'topics', 'subscribe', [s.topic_name for s in node.subscriptions]
                + ['/clock'])
            add(profile, 'services', 'reply', [s.service_name for s in node.services])
            node.destroy_node()
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding='unicode') + '\n'


def main():
    """Write the file, or compare it; returns the exit status."""
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
