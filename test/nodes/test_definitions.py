"""Definitions of message types as stored in recordings."""

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from mag_tracking.nodes.convert import message_class
from mag_tracking.nodes.record_node import definition_of
from support.bundled import ROOT


@pytest.mark.parametrize('type_name', [
    'sensor_msgs/msg/Imu', 'diagnostic_msgs/msg/DiagnosticArray', 'nav_msgs/msg/Odometry',
    'sensor_msgs/msg/PointCloud2', 'visualization_msgs/msg/MarkerArray',
    'rcl_interfaces/msg/ParameterEvent', 'nav_msgs/msg/Path', 'rosgraph_msgs/msg/Clock'])
def test_definitions_equal_the_definitions_of_rosbags(type_name):
    """Each type, field and constant is defined as in rosbags."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = get_types_from_msg(definition_of(type_name), type_name)
    expected_names = {type_name}
    while new_names := {n for t in expected_names
                        for n in names_in(store.fielddefs[t])} - expected_names:
        expected_names |= new_names
    assert set(types) == expected_names
    assert types == {name: store.fielddefs[name] for name in expected_names}


def names_in(definition):
    """Message types that a definition of rosbags contains."""
    def walk(node):
        if isinstance(node, str):
            return {node} if '/msg/' in node else set()
        return set().union(*map(walk, node)) if isinstance(node, (tuple, list)) else set()
    return walk(definition[1])


def test_own_types_have_a_definition_and_unknown_types_have_none(monkeypatch, tmp_path):
    definition = definition_of('mag_tracking_msgs/msg/HypothesisArray')
    assert definition.count('MSG: mag_tracking_msgs/Hypothesis\n') == 1
    assert definition.startswith((ROOT / 'msg_defs/msg/HypothesisArray.msg').read_text())
    assert definition_of('odd_msgs/msg/Odd') is None
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    folder = tmp_path / 'share' / 'new_msgs' / 'msg'
    folder.mkdir(parents=True)
    (folder / 'Outer.msg').write_text('int8 N=3 # Inner x\nInner[<=3] inner\nstring<=4 s "a/b c"')
    (folder / 'Inner.msg').write_text('float64[2] v\n# Odd odd\n')
    definition = definition_of('new_msgs/msg/Outer')
    assert definition.count('MSG: ') == 1 and definition.endswith(
        'MSG: new_msgs/Inner\nfloat64[2] v\n# Odd odd\n')
    (folder / 'Inner.msg').unlink()
    definition_of.cache_clear()
    assert definition_of('new_msgs/msg/Outer') is None


@pytest.mark.parametrize('name', ['', 'foxglove.Log', 'no schema (json)', 'a/b', '/msg/X',
                                  'a/b/c/d', 'sensor_msgs/msg/Imu (cbor)', 'odd_msgs/msg/Odd'])
def test_a_recorded_type_that_is_not_installed_has_no_class(name):
    assert message_class(name) is None
    assert message_class('sensor_msgs/msg/Imu').__name__ == 'Imu'
