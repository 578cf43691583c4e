"""The SROS 2 policies match the nodes and are well-formed."""

import subprocess
import sys
from xml.etree import ElementTree

from support.bundled import ROOT
from support.node_processes import MAX_S

POLICIES = ROOT / 'config' / 'security' / 'policies.xml'


def test_policies_are_up_to_date():
    process = subprocess.run([sys.executable, str(ROOT / 'tools' / 'generate_policies.py'),
                              '--check'], text=True, stdout=subprocess.PIPE,
                             stderr=subprocess.STDOUT, timeout=MAX_S, check=False)
    assert process.returncode == 0, process.stdout


def test_names_in_policies_of_a_namespace_have_its_prefix():
    process = subprocess.run([sys.executable, str(ROOT / 'tools' / 'generate_policies.py'),
                              '--namespace', '/robot1'], text=True, stdout=subprocess.PIPE,
                             stderr=subprocess.DEVNULL, timeout=MAX_S, check=False)
    profiles = list(ElementTree.fromstring(process.stdout).iter('profile'))
    assert {p.get('ns') for p in profiles} == {'/robot1'}
    names = {e.text for p in profiles for rule in p for e in rule}
    common = {'/clock', '/diagnostics', '/rosout', '/parameter_events', '/tf', '/tf_static'}
    assert names & common == common and all(n.startswith('/robot1/') for n in names - common)


def test_policies_allow_only_the_interfaces_of_each_node():
    """The rules are parsed according to the schema of sros2."""
    profiles = {p.get('node'): p for p in ElementTree.parse(POLICIES).iter('profile')}
    assert set(profiles) == {'calibration_node', 'detection_node', 'tracker_node', 'driver_node',
                             'replay_node'}
    rules = {(node, rule.tag, *rule.attrib.items()): [e.text for e in rule]
             for node, profile in profiles.items() for rule in profile}
    assert '/*/imu/mag' in rules['driver_node', 'topics', ('publish', 'ALLOW')]
    assert '/network_frame' in rules['tracker_node', 'topics', ('subscribe', 'ALLOW')]
    assert '/tracker_node/pose' in rules['tracker_node', 'topics', ('publish', 'ALLOW')]
    assert not [r for (node, *_), r in rules.items() if '*' in r]
    assert '/calibration_node/survey' in rules[
        'calibration_node', 'services', ('reply', 'ALLOW')]
