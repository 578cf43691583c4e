"""Settings as ROS parameters: descriptors, ranges, checks, live changes."""

from collections.abc import Callable, Iterable
from typing import Any

from rcl_interfaces import msg
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from mag_tracking.errors import SettingsError
from mag_tracking.pipeline import Settings
from mag_tracking.settings import Parameter, flatten, replace

NODE_PARAMETERS = frozenset({
    'use_sim_time', 'start_type_description_service', 'network', 'target', 'reliable_input',
    'save_as', 'state_file', 'publish_sensor_tf', 'child_frame', 'publish_tf', 'drivers', 'batches',
    'autostart', 'recording', 'rate', 'loop', 'start_offset', 'topics', 'start_delay', 'paused',
    'wait_for_subscribers'})
"""Node parameters that are not settings. Each node accepts all of them, because the nodes may share
a parameter file and the arguments of a process."""


def fixed_parameter(node: Node, name: str, default: Any, description: str) -> Any:
    """Declare a read-only parameter, one of `NODE_PARAMETERS`; return its value."""
    assert name in NODE_PARAMETERS, name
    return node.declare_parameter(name, default, msg.ParameterDescriptor(
        description=description, read_only=True)).value


def _descriptor(p: Parameter) -> msg.ParameterDescriptor:
    """Create the descriptor of a setting, with its description, unit and range."""
    d = msg.ParameterDescriptor(
        description=p.doc, read_only=not p.live, additional_constraints=f'unit: {p.unit}'
        if p.unit else f'one of {", ".join(p.choices)}' if p.choices else '')
    if p.range and p.type is float:
        d.floating_point_range = [msg.FloatingPointRange(
            from_value=float(p.range[0]), to_value=float(p.range[1]))]
    elif p.range and p.type is int:
        d.integer_range = [msg.IntegerRange(from_value=p.range[0], to_value=p.range[1])]
    return d


def declare_settings(node: Node, settings: Settings, group: str) -> Settings:
    """Declare the settings of a group, and return all settings, with the overrides of a node;
    raises SettingsError if one is invalid."""
    overrides = node._parameter_overrides  # rclpy has no public accessor
    current = replace(settings, {
        name: _without_array(p.value) for name, p in overrides.items()
        if name not in NODE_PARAMETERS and not name.startswith('qos_overrides.')})
    for p in flatten(current):
        if p.name.startswith(f'{group}.'):
            value = list(p.value) if isinstance(p.value, tuple) else p.value
            node.declare_parameter(p.name, value, _descriptor(p))
    return current


def _without_array(value: Any) -> Any:
    """Return the value of a parameter; arrays and tuples are converted to lists."""
    return list(value) if hasattr(value, '__iter__') and not isinstance(value, str) else value


def follow_changes(node: Node, settings: Settings, apply: Callable[[Settings], None]) -> None:
    """Reject invalid parameter changes; call `apply` with the settings after valid ones."""
    names = {p.name for p in flatten(settings)}

    def changes(parameters: Iterable[RosParameter]) -> dict[str, Any]:
        return {p.name: _without_array(p.value) for p in parameters if p.name in names}

    def reject_invalid(parameters: list[RosParameter]) -> msg.SetParametersResult:
        try:
            replace(settings, changes(parameters))
        except SettingsError as error:
            return msg.SetParametersResult(successful=False, reason=str(error))
        return msg.SetParametersResult(successful=True)

    def apply_changes(parameters: list[RosParameter]) -> None:
        nonlocal settings
        if changed := changes(parameters):
            settings = replace(settings, changed)
            apply(settings)

    node.add_on_set_parameters_callback(reject_invalid)
    node.add_post_set_parameters_callback(apply_changes)
