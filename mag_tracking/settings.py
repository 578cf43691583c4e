"""Settings, declared once: defaults, documentation, units and ranges in one place.

ROS parameters, the YAML file of defaults and the parameter reference are all
made from these declarations.
"""

import dataclasses
import difflib
import math
import typing
from collections.abc import Iterable, Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, TypeVar

from mag_tracking.errors import SettingsError
from mag_tracking.yaml_file import is_text, read_yaml, shown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Scalar: TypeAlias = bool | int | float | str
Value: TypeAlias = Scalar | tuple[Scalar, ...]
"""What a setting can be."""

REPLACED = {'track.vehicle.soft_iron': 'track.vehicle.induced_share',
            'track.vehicle.soft_iron_std': 'track.vehicle.induced_share_std'}
"""Settings of before, and those that have taken their place."""

_Class: TypeAlias = type[object]
_Default = TypeVar('_Default')
_Settings = TypeVar('_Settings', bound='DataclassInstance')


def param(default: _Default, doc: str, unit: str = '', range: tuple[float, float] | None = None,
          live: bool = False, length: int | None = None, choices: tuple[str, ...] = ()) -> _Default:
    """Declare one setting of a frozen dataclass.

    Parameters
    ----------
    default : float, int, bool, str, or a tuple of float or of str
    doc : str
        One sentence, for the reference and the ROS descriptor.
    unit : str
    range : (low, high), optional
        Inclusive, for numbers and for every element of a tuple.
    live : bool
        May change while running (a ROS parameter that is not read-only).
    length : int, optional
        Required length of a tuple; None = any but zero.
    choices : tuple of str, optional
        The values that a text may have.
    """
    return dataclasses.field(default=default, metadata={
        'doc': doc, 'unit': unit, 'range': range, 'live': live, 'length': length,
        'choices': choices})


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One setting, flattened: its dotted name, its value and its declaration."""

    name: str
    value: Value
    type: _Class
    element: _Class | None
    doc: str
    unit: str
    range: tuple[float, float] | None
    live: bool
    length: int | None
    choices: tuple[str, ...]


def _kind(hint: Any) -> tuple[_Class, _Class | None]:
    """(type, element type) of an annotation such as float or tuple[float, ...]."""
    if typing.get_origin(hint) is tuple:
        return tuple, typing.get_args(hint)[0]
    return hint, None


def _is_group(value: object) -> 'TypeGuard[DataclassInstance]':
    """Whether a field of a settings dataclass holds settings of its own."""
    return dataclasses.is_dataclass(value)


def flatten(settings: 'DataclassInstance', prefix: str = '') -> list[Parameter]:
    """All settings below `settings` as a list of `Parameter`, in the order declared."""
    hints = typing.get_type_hints(type(settings))
    out: list[Parameter] = []
    for f in dataclasses.fields(settings):
        name, value = prefix + f.name, getattr(settings, f.name)
        if _is_group(value):
            out += flatten(value, name + '.')
        else:
            kind, element = _kind(hints[f.name])
            out.append(Parameter(name, value, kind, element, **f.metadata))
    return out


def _scalar(name: str, value: object, kind: _Class) -> Scalar:
    """`value` as `kind`, or a SettingsError that names the setting."""
    if isinstance(value, int) and value.bit_length() > 1000:
        raise SettingsError(f'{name}: an integer of {value.bit_length()} bits is too large')
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind is str and isinstance(value, str) and not is_text(value):
        raise SettingsError(f'{name}: {shown(value)} is not text: it contains a lone surrogate')
    if kind in (bool, str) and isinstance(value, kind):
        return value
    raise SettingsError(f'{name}: expected {kind.__name__}, got {shown(value)}')


def _checked(p: Parameter, value: object) -> Value:
    """`value` in the type of the declaration `p`, within its range and length."""
    if p.element is not None:
        if isinstance(value, (str, bytes)) or not hasattr(value, '__iter__'):
            raise SettingsError(f'{p.name}: expected a list of {p.element.__name__}, '
                                f'got {shown(value)}')
        values = tuple(_scalar(p.name, v, p.element) for v in value)
        if p.length is not None and len(values) != p.length:
            raise SettingsError(f'{p.name}: expected {p.length} values, got {len(values)}')
        if not values:
            raise SettingsError(f'{p.name}: expected at least one value, got none')
    else:
        values = (_scalar(p.name, value, p.type),)
    for v in values:
        if p.choices and v not in p.choices:
            raise SettingsError(f'{p.name}: expected {", ".join(p.choices[:-1])} or '
                                f'{p.choices[-1]}, got {shown(v)}')
        if isinstance(v, float) and math.isnan(v):
            raise SettingsError(f'{p.name}: NaN is not a value')
        if isinstance(v, str) or p.range is None:
            continue
        if not p.range[0] <= v <= p.range[1]:
            raise SettingsError(f'{p.name}: {v} is outside {p.range[0]} .. {p.range[1]}'
                                f'{" " + p.unit if p.unit else ""}')
    return values if p.element is not None else values[0]


def _dotted(mapping: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Nested mappings as one flat dict with dotted names."""
    out: dict[str, Any] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            _join(out, _dotted(value, f'{prefix}{key}.'))
        else:
            _join(out, {f'{prefix}{key}': value})
    return out


def _join(out: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Put `more` into `out`; raises SettingsError where the two disagree."""
    for name, value in more.items():
        if out.setdefault(name, value) is not value and out[name] != value:
            raise SettingsError(f'{name} is there twice, as {shown(out[name])} and as '
                                f'{shown(value)}')


def replace(settings: _Settings, changes: Mapping[str, Any]) -> _Settings:
    """A copy of `settings` with `changes`, a mapping of (dotted or nested) names to values.

    Raises SettingsError for an unknown name (with the nearest known one), a
    wrong type, a wrong length, or a value out of range.
    """
    known = {p.name: p for p in flatten(settings)}
    checked = {}
    for name, value in _dotted(changes).items():
        if name not in known:
            raise SettingsError(f'unknown setting {name}{_hint(name, known)}')
        checked[name] = _checked(known[name], value)
    return _rebuild(settings, checked, '')


def _hint(name: str, known: Iterable[str]) -> str:
    """Suggest a setting of the `known` ones for an unknown `name`; empty if none is near."""
    if name in REPLACED:
        return f'; {REPLACED[name]} has taken its place, in another unit'
    near = difflib.get_close_matches(name, known, n=1)
    return f'; did you mean {near[0]}?' if near else ''


def _rebuild(settings: _Settings, checked: Mapping[str, Value], prefix: str) -> _Settings:
    """Copy of the tree with the checked values put in."""
    changes: dict[str, Any] = {}
    for f in dataclasses.fields(settings):
        name, value = prefix + f.name, getattr(settings, f.name)
        if _is_group(value):
            changes[f.name] = _rebuild(value, checked, name + '.')
        elif name in checked:
            changes[f.name] = checked[name]
    return dataclasses.replace(settings, **changes)


def read_parameter_file(path: str | PathLike[str]) -> dict[str, Any]:
    """The settings in a YAML file, as a flat dict of dotted names.

    Takes a plain mapping, or a ROS parameter file (`node: ros__parameters:`),
    whose sections of all nodes are joined. Raises SettingsError.
    """
    content = read_yaml(path, SettingsError)
    if content is None:
        return {}
    if not isinstance(content, Mapping):
        raise SettingsError(f'{path}: expected a mapping of settings, got {shown(content)}')
    try:
        return _joined_sections(content)
    except SettingsError as error:
        raise SettingsError(f'{path}: {error}') from error


def as_ros_parameters(path: str | PathLike[str]) -> str | None:
    """Plain parameter file converted to a ROS parameter file; None if it already is one.

    Raises SettingsError.
    """
    content = read_yaml(path, SettingsError)
    if not isinstance(content, Mapping) or any(
            isinstance(v, Mapping) and 'ros__parameters' in v for v in content.values()):
        return None
    values = read_parameter_file(path)
    lines = [f'    {name}: {_yaml_value(tuple(v) if isinstance(v, list) else v)}'
             for name, v in values.items()]
    return '\n'.join(['/**:', '  ros__parameters:', *lines, ''])


def _joined_sections(content: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a plain mapping, or of all the nodes of a ROS parameter file."""
    nodes = [k for k, v in content.items() if isinstance(v, Mapping) and 'ros__parameters' in v]
    if not nodes:
        return _dotted(content)
    joined: dict[str, Any] = {}
    for name, node in content.items():
        section = node.get('ros__parameters') if isinstance(node, Mapping) else None
        if name not in nodes or len(node) > 1 or not isinstance(section, Mapping | None):
            raise SettingsError(f'{name}: expected nothing but a mapping under ros__parameters, as '
                                f'for {nodes[0]}, got {shown(node)}')
        _join(joined, _dotted(section or {}))
    return joined


def _yaml_value(value: Value) -> str:
    """One value as YAML that reads back as the same value of the same type."""
    if isinstance(value, tuple):
        return '[' + ', '.join(_yaml_value(v) for v in value) + ']'
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 reads 1e-08 as a string: a mantissa needs its point.
        return text.replace('e', '.0e') if 'e' in text and '.' not in text else text
    return str(value) if isinstance(value, int) else f"'{value}'"


def to_yaml(settings: 'DataclassInstance', node: str = '/**') -> str:
    """The settings as a ROS parameter file with documentation."""
    lines = ['# Generated from the settings by `make config`; do not edit.',
             f'{node}:', '  ros__parameters:']
    group = None
    for p in flatten(settings):
        head, _, leaf = p.name.rpartition('.')
        if head != group:
            lines += [''] if group is not None else []
            lines += [f'    {head}:'] if head else []
            group = head
        pad = '      ' if head else '    '
        notes = [p.unit] if p.unit else []
        notes += [f'{p.range[0]} .. {p.range[1]}'] if p.range else []
        notes += [', '.join(p.choices)] if p.choices else []
        notes += ['live'] if p.live else []
        lines.append(f'{pad}# {p.doc}' + (f' [{"; ".join(notes)}]' if notes else ''))
        lines.append(f'{pad}{leaf}: {_yaml_value(p.value)}')
    return '\n'.join(lines) + '\n'


def to_reference(settings: 'DataclassInstance', live: bool = True) -> str:
    """The parameter reference, as a Markdown table; without the column `live` if it is false."""
    head = ['parameter', 'default', 'unit', 'range', *(['live'] if live else []), 'what']
    lines = [f'| {" | ".join(head)} |', '|' + '---|' * len(head)]
    for p in flatten(settings):
        bounds = f'{p.range[0]} .. {p.range[1]}' if p.range else ', '.join(p.choices)
        row = [f'`{p.name}`', f'`{_yaml_value(p.value)}`', p.unit, bounds,
               *(['yes' if p.live else ''] if live else []), p.doc.replace('|', '\\|')]
        lines.append(f'| {" | ".join(row)} |')
    return '\n'.join(lines) + '\n'
