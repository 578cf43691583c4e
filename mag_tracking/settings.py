"""Declaration and validation of settings, from which ROS parameters, the YAML file of defaults and
the parameter reference are generated."""

import dataclasses
import difflib
import math
import re
import typing
from collections.abc import Iterable, Mapping
from itertools import groupby
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard, TypeVar

from mag_tracking.errors import SettingsError
from mag_tracking.files import is_utf8_encodable, read_yaml, short_repr

_CONSTANTS = {
    'calibrate': 'look_ahead_s memory_s guard_s block_s freeze_std max_forward_jump_s '
                 'max_backward_jump_s',
    'align': 'max_backward_jump_s',
    'detect': 'release_probability',
    'events': 'max_sensors',
    'track': 'prune_ratio max_initial_hypotheses relinearise_interval_s relinearise_max_hypotheses',
    'track.vehicle': 'lateral_std along_std max_start_distance speed_std cross_speed_std climb_std '
                     'turn_share',
    'track.magnet': 'start_margin grid_points starts near_field_length',
    'survey': 'compass_bias_std accelerometer_bias max_clock_offset_s max_accelerations'}
"""{group: settings that are constants now}."""
_COLUMNS = {
    ('track.vehicle.', 'track.vehicle.kinds.car.'): 'length length_std moment moment_std '
    'difference_std height height_std near_field_length',
    ('traffic.line_', 'traffic.lines.road.'): 'offset half_width',
    ('traffic.class_', 'traffic.classes.car.'): 'share moment moment_spread length length_spread'}
"""{(prefix of lists, prefix in a table): names, which had an s as lists}."""
FORMER_SETTINGS = {
    **{f'{group}.{name}': '' for group, names in _CONSTANTS.items() for name in names.split()},
    **{f'{old}{name}s': new + name for (old, new), names in _COLUMNS.items()
       for name in names.split()},
    'traffic.line_headings_deg': 'traffic.lines.road.heading_deg',
    'traffic.line_names': 'traffic.lines.names', 'traffic.class_names': 'traffic.classes.names'}
"""{former setting: its current name, for one row of a table; empty if it is a constant}."""
TARGETS = 'vehicle', 'magnet', 'bench'
"""Types of targets, for each of which the pipeline has default settings."""

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Scalar: TypeAlias = bool | int | float | str
Value: TypeAlias = Scalar | tuple[Scalar, ...]
USER, EXPERT = 'user', 'expert'
"""Levels: settings of the site, the targets and the wanted results, and of the methods."""
_ROW_NAME = re.compile(r'(?!names$)\w[\w -]*')
"""Permitted names of the rows of a table."""
_Class: TypeAlias = type[object]
_Default = TypeVar('_Default')
_Settings = TypeVar('_Settings', bound='DataclassInstance')


def param(default: _Default, doc: str, unit: str = '', range: tuple[float, float] | None = None,
          live: bool = False, length: int | None = None, choices: tuple[str, ...] = (),
          level: str = EXPERT) -> _Default:
    """Declare one setting of a frozen dataclass, or a table; see `Parameter`.

    A table is a tuple of dataclass instances, its rows, with a `name` and settings as columns. Its
    settings are `<table>.names` and `<table>.<name>.<column>`; a row that is added to the names has
    the defaults of the columns.
    """
    return dataclasses.field(default=default, metadata={
        'doc': doc, 'unit': unit, 'range': range, 'live': live, 'length': length,
        'choices': choices, 'level': level})


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One setting with its value and its declaration."""

    name: str
    """Dotted name."""
    value: Value
    type: _Class
    element: _Class | None
    """Type of the elements of a tuple, otherwise None."""
    doc: str
    """Description for the reference and the ROS descriptor."""
    unit: str
    range: tuple[float, float] | None
    """Inclusive bounds of a number, or of every element of a tuple."""
    live: bool
    """Whether the setting may change at run time (its ROS parameter is not read-only)."""
    length: int | None
    """Required length of a tuple. None allows any length except zero."""
    choices: tuple[str, ...]
    """Permitted values of a string. Empty if any string is allowed."""
    level: str
    """USER or EXPERT."""
    row: str = ''
    """Name of the row, if the setting is a column of a table."""


def _is_group(value: object) -> 'TypeGuard[DataclassInstance]':
    return dataclasses.is_dataclass(value)


def _is_table(value: object) -> 'TypeGuard[tuple[Any, ...]]':
    return isinstance(value, tuple) and any(map(_is_group, value))


def flatten(settings: 'DataclassInstance', prefix: str = '', row: str = '') -> list[Parameter]:
    """List all settings of a tree, or of the row named `row` of a table, with prefixed names."""
    hints = typing.get_type_hints(type(settings))
    out: list[Parameter] = []
    for f in dataclasses.fields(settings):
        name, value = prefix + f.name, getattr(settings, f.name)
        if _is_group(value):
            out += flatten(value, name + '.')
        elif _is_table(value):
            out.append(Parameter(f'{name}.names', tuple(r.name for r in value), tuple, str,
                                 **f.metadata))
            for r in value:
                out += flatten(r, f'{name}.{r.name}.', r.name)
        elif f.metadata:
            hint, args = hints[f.name], typing.get_args(hints[f.name])
            kind, element = (tuple, args[0]) if typing.get_origin(hint) is tuple else (hint, None)
            out.append(Parameter(name, value, kind, element, **f.metadata, row=row))
    return out


def _scalar(name: str, value: object, kind: _Class) -> Scalar:
    if isinstance(value, int) and value.bit_length() > 1000:
        raise SettingsError(f'{name}: an integer of {value.bit_length()} bits is too large; the '
                            'maximum is 1000 bits')
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind is str and isinstance(value, str) and not is_utf8_encodable(value):
        raise SettingsError(f'{name}: {short_repr(value)} is not text: it contains an unpaired '
                            'surrogate')
    if kind in (bool, str) and isinstance(value, kind):
        return value
    raise SettingsError(f'{name}: expected {kind.__name__}, got {short_repr(value)}')


def _validated(p: Parameter, value: object) -> Value:
    if p.element is not None:
        if isinstance(value, (str, bytes)) or not hasattr(value, '__iter__'):
            raise SettingsError(f'{p.name}: expected a list of {p.element.__name__}, '
                                f'got {short_repr(value)}')
        values = tuple(_scalar(p.name, v, p.element) for v in value)
        if p.length is not None and len(values) != p.length:
            raise SettingsError(f'{p.name}: expected {p.length} values, got {len(values)}')
        if not values:
            raise SettingsError(f'{p.name}: expected at least one value, got none')
    else:
        values = (_scalar(p.name, value, p.type),)
    for v in values:
        if p.name.endswith('.names') and not _ROW_NAME.fullmatch(str(v)):
            raise SettingsError(f'{p.name}: {short_repr(v)} is not a valid name: use letters, '
                                'digits, _, - and spaces')
        if p.choices and v not in p.choices:
            raise SettingsError(f'{p.name}: expected {", ".join(p.choices[:-1])} or '
                                f'{p.choices[-1]}, got {short_repr(v)}')
        if isinstance(v, float) and math.isnan(v):
            raise SettingsError(f'{p.name}: NaN is not a valid value')
        if not isinstance(v, str) and p.range is not None and not p.range[0] <= v <= p.range[1]:
            raise SettingsError(f'{p.name}: {v} is outside {p.range[0]} .. {p.range[1]}'
                                f'{" " + p.unit if p.unit else ""}')
    if p.name.endswith('.names') and len(set(values)) < len(values):
        raise SettingsError(f'{p.name}: a name is duplicated in {values}')
    return values if p.element is not None else values[0]


def _flattened(mapping: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Flatten nested mappings to one dict with dotted names; empty mappings remain values."""
    out: dict[str, Any] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping) and value:
            _merge(out, _flattened(value, f'{prefix}{key}.'))
        else:
            _merge(out, {f'{prefix}{key}': value})
    return out


def _merge(out: dict[str, Any], more: Mapping[str, Any]) -> None:
    for name, value in more.items():
        if out.setdefault(name, value) is not value and out[name] != value:
            raise SettingsError(f'{name} is given twice, as {short_repr(out[name])} and as '
                                f'{short_repr(value)}')


def replace(settings: _Settings, changes: Mapping[str, Any]) -> _Settings:
    """Copy settings with changes: values by dotted name, or nested mappings of them.

    Raises SettingsError if a name is unknown (the message suggests the closest known name), or a
    value has a wrong type, a wrong length, or is out of range.
    """
    flat = _flattened(changes)
    # The names of rows come first, because they determine which other settings exist.
    names_of_rows = {k: v for k, v in flat.items() if k.endswith('.names')}
    for part in (names_of_rows, {k: v for k, v in flat.items() if k not in names_of_rows}):
        parameters = {p.name: p for p in flatten(settings)}
        checked = {}
        for name, value in part.items():
            if value == {} and any(k.startswith(f'{name}.') for k in parameters):
                continue
            if name not in parameters:
                raise SettingsError(_unknown_message(name, value, parameters))
            checked[name] = _validated(parameters[name], value)
        settings = _rebuild(settings, checked, '')
    return settings


def _unknown_message(name: str, value: object, names: Iterable[str]) -> str:
    """Error message if `name` is a group of settings, or is unknown (then with a suggestion)."""
    members = [k for k in names if k.startswith(f'{name}.')]
    if members:
        return (f'{name} is a group of settings, such as {members[0]}; expected a mapping, got '
                f'{"nothing" if value is None else short_repr(value)}')
    return f'unknown setting {name}{_suggestion(name, names)}'


def _suggestion(name: str, names: Iterable[str]) -> str:
    """Suggestion for an unknown setting, its current or the closest known name; may be empty."""
    names = list(names)
    group, _, leaf = name.rpartition('.')
    if name in FORMER_SETTINGS:
        current = FORMER_SETTINGS[name]
        return f'; it is now {current}' if current else '; it is now a constant'
    if group in names:
        return f'; {group} is a single setting'
    table, _, row = group.rpartition('.')
    if f'{table}.names' in names and not any(k.startswith(f'{group}.') for k in names):
        return f'; {row} is not in {table}.names'
    if group and not any(k.startswith(f'{group}.') for k in names):
        return _group_suggestion(group, leaf, names)
    if not group:
        # A setting without its group.
        leaves = [k for k in names if k.rpartition('.')[2] == leaf]
        if leaves:
            return f'; did you mean {" or ".join(leaves)}?'
    closest = closest_name(name, [*names, *dict.fromkeys(k.partition('.')[0] for k in names)])
    return f'; did you mean {closest}?' if closest else ''


def _group_suggestion(group: str, leaf: str, names: Iterable[str]) -> str:
    groups = list(dict.fromkeys(k[:i] for k in names for i, c in enumerate(k) if c == '.'))
    closest_group = closest_name(group, groups)
    if closest_group:
        closest = closest_name(leaf, [k.removeprefix(f'{closest_group}.') for k in names
                                      if k.startswith(f'{closest_group}.')])
        return (f'; there is no group {group}; did you mean {closest_group}'
                f'{"." + closest if closest else ""}?')
    top_groups = [g for g in groups if '.' not in g]
    return (f'; there is no group {group}; the groups are {", ".join(top_groups)}'
            if top_groups else '')


def closest_name(name: str, candidates: Iterable[str]) -> str:
    """Candidate that is most similar to a name; empty if none is similar."""
    return next(iter(difflib.get_close_matches(name, list(candidates), n=1, cutoff=0.75)), '')


def _rebuild(settings: _Settings, checked: Mapping[str, Value], prefix: str) -> _Settings:
    changes: dict[str, Any] = {}
    for f in dataclasses.fields(settings):
        name, value = prefix + f.name, getattr(settings, f.name)
        if _is_group(value):
            changes[f.name] = _rebuild(value, checked, name + '.')
        elif _is_table(value):
            rows = {row.name: row for row in value}
            changes[f.name] = tuple(
                _rebuild(rows.get(row) or type(value[0])(row), checked, f'{name}.{row}.')
                for row in map(str, typing.cast('tuple[str, ...]', checked.get(
                    f'{name}.names', tuple(rows)))))
        elif name in checked:
            changes[f.name] = checked[name]
    return dataclasses.replace(settings, **changes)


def read_parameter_file(path: str | PathLike[str]) -> dict[str, Any]:
    """Read settings from a YAML file.

    Parameters
    ----------
    path : path_like
        A plain mapping, or a ROS parameter file (`node: ros__parameters:`). The sections of all
        nodes are merged.

    Returns
    -------
    dict of str to setting
        Values by dotted name.

    Raises
    ------
    SettingsError
        If the file cannot be read, is not a mapping of settings, or contains different values for
        one setting.
    """
    content = read_yaml(path, SettingsError)
    if content is None:
        return {}
    if not isinstance(content, Mapping):
        raise SettingsError(f'{path}: expected a mapping of settings, got {short_repr(content)}')
    try:
        return _merged_sections(content)
    except SettingsError as error:
        raise SettingsError(f'{path}: {error}') from error


def as_ros_parameters(path: str | PathLike[str]) -> str | None:
    """Convert a plain parameter file to YAML text with the format of ROS.

    None if the file already has this format or is not a mapping. Raises SettingsError if it cannot
    be read, or contains different values for one setting.
    """
    content = read_yaml(path, SettingsError)
    if not isinstance(content, Mapping) or any(
            isinstance(v, Mapping) and 'ros__parameters' in v for v in content.values()):
        return None
    lines = [f'    {name}: {yaml_value(tuple(v) if isinstance(v, list) else v)}'
             for name, v in read_parameter_file(path).items() if v != {}]
    return '\n'.join(['/**:', '  ros__parameters:', *lines, ''])


def _merged_sections(content: Mapping[str, Any]) -> dict[str, Any]:
    """Read the settings of a plain mapping, or of all nodes of a ROS parameter file."""
    nodes = [k for k, v in content.items() if isinstance(v, Mapping) and 'ros__parameters' in v]
    if not nodes:
        return _flattened(content)
    merged: dict[str, Any] = {}
    for name, node in content.items():
        section = node.get('ros__parameters') if isinstance(node, Mapping) else None
        if name not in nodes or len(node) > 1 or not isinstance(section, Mapping | None):
            raise SettingsError(f'{name}: expected only a mapping under ros__parameters, as for '
                                f'{nodes[0]}, got {short_repr(node)}')
        _merge(merged, _flattened(section or {}))
    return merged


def yaml_value(value: Value) -> str:
    """Format a value as YAML that is read back with the same type."""
    if isinstance(value, tuple):
        return '[' + ', '.join(yaml_value(v) for v in value) + ']'
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 reads 1e-08 as a string: the mantissa needs a decimal point.
        return text.replace('e', '.0e') if 'e' in text and '.' not in text else text
    return str(value) if isinstance(value, int) else f"'{value}'"


def to_yaml(settings: 'DataclassInstance', level: str = '') -> str:
    """Format settings, or those of one level, as a ROS parameter file with comments."""
    lines = ['# Generated from the settings by `make config`; do not edit.',
             *[f'# The {level} settings; the reference lists all.'] * bool(level),
             '/**:', '  ros__parameters:']
    previous_group = previous_row = ''
    chosen = (p for p in flatten(settings) if level in ('', p.level))
    for (group, row), grouped in groupby(chosen, lambda p: (p.name.rpartition('.')[0], p.row)):
        members = {p.name.rpartition('.')[2]: p for p in grouped}
        group = group.removesuffix(f'.{row}')
        if group != previous_group:
            lines += [''] if previous_group else []
            lines += [f'    {group}:'] if group else []
        indent = '      ' if group else '    '
        if not row:
            for leaf, p in members.items():
                lines += [f'{indent}# {_comment(p)}', f'{indent}{leaf}: {yaml_value(p.value)}']
        else:
            if not previous_row:
                lines += [f'{indent}# {leaf}: {_comment(p)}' for leaf, p in members.items()]
            lines.append(f'{indent}{row}: {{' + ', '.join(
                f'{leaf}: {yaml_value(p.value)}' for leaf, p in members.items()) + '}')
        previous_group, previous_row = group, row
    return '\n'.join(lines) + '\n'


def _comment(p: Parameter) -> str:
    notes = [p.unit, f'{p.range[0]} .. {p.range[1]}' if p.range else '', ', '.join(p.choices),
             'live' if p.live else '']
    return p.doc + (f' [{"; ".join(filter(None, notes))}]' if any(notes) else '')
