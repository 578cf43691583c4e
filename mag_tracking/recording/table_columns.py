"""Columns of a table of readings: time, sensor and axes, named by the user or by the header."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

from mag_tracking.errors import RecordingError
from mag_tracking.recording.table_layout import Table
from mag_tracking.settings import closest_name
from mag_tracking.units import FIELD_UNITS, field_scale, field_unit, time_unit

MAX_NAME = 200
"""Length of a column name above which no unit is looked for."""
_HEADER_HINT = '; if this is not the header, give --header with the number of its line'
DEFAULT_SENSOR = 'mag_1'
"""Name of the only sensor of a table that does not name it."""
IGNORED = '-'
"""Name assigned to a sensor whose readings are discarded."""
_Assigned: TypeAlias = tuple[str, str | None, dict[str, dict[str, str]]]
"""Column of the time ('' without one), column of the sensor, and {sensor: {axis: column}}."""
_TIME_WORDS = frozenset('t time timestamp ts stamp datetime timestamps epoch elapsed unixtime '
                        'millis micros nanos sec secs seconds ms us ns utc localtime '
                        'zeit uhrzeit zeitstempel temps heure tiempo hora tempo ora'.split())
_DATE_WORDS = frozenset('date datum fecha'.split())
_SENSOR_WORDS = frozenset('id sensor device node name board channel sensorid deviceid'.split())
_FIELD_WORDS = frozenset('magnetic magnetometer magnetometers mag magn magneto field flux '
                         'density b h m raw compass axis component data value sensor '
                         'magnetfeld champ magnetique campo magnetico'.split())
_OTHER_WORDS = frozenset(
    'acc accel acceleration accelerometer linear gyro gyroscope gravity angular rate velocity '
    'orientation quaternion position pos roll pitch yaw covariance rotation temperature true truth '
    'gps offset scale bias'.split())
_AXIS = re.compile(r'(?P<rest>.*?)(?P<prefix>magnetometer|magnetic|mag|field|compass|[bhm])?'
                   r'(?P<axis>[xyz])(?P<number>[0-9]*)').fullmatch
_UNIT_AT_END = re.compile(r'(.*\S)\s*[(\[](.*)[)\]]\s*|(.*[^\s_,/])\s*[\s_,/]+(\S+)').fullmatch


class Axis(NamedTuple):
    """Column of one axis of one sensor."""

    sensor: str
    """Name of the sensor; empty if a column contains the names."""
    axis: int
    column: int
    scale: float
    """Tesla per unit."""


class Columns(NamedTuple):
    """Columns of a table of readings."""

    time: tuple[int, ...]
    """Columns whose cells form the time, such as date and time of day."""
    sensor: int | None
    axes: tuple[Axis, ...]
    time_name: str
    time_unit: str
    """Unit of the time in the header; empty if it states none."""
    notes: tuple[str, ...]


def parse_columns(texts: Sequence[str]) -> _Assigned:
    """Parse assignments; raises RecordingError if one is invalid, duplicated or missing.

    `time=COLUMN`, or `time=DATE+TIME` for two columns, and either `x=COLUMN` and so on (one row per
    reading; the sensor is ''), with `sensor=COLUMN` if there are several sensors, or
    `NAME.x=COLUMN` and so on (one row for all sensors). Axes that were not measured are omitted.
    """
    found: dict[str, str] = {}
    for text in texts:
        key, equals, column = text.partition('=')
        if not (equals and column) or key in found:
            raise RecordingError(f'columns: {text!r} repeats a key' if key in found else
                                 f'columns: expected KEY=COLUMN such as time=t, got {text!r}')
        found[key] = column
    time, sensor = found.pop('time', ''), found.pop('sensor', None)
    axes: dict[str, dict[str, str]] = {}
    for key, column in found.items():
        name, _, axis = key.rpartition('.')
        if axis not in ('x', 'y', 'z') or name and sensor is not None:
            raise RecordingError('columns: expected time, sensor, x, y, z (one row per reading) or '
                                 'time, NAME.x, NAME.y, NAME.z (one row for all sensors); '
                                 f'got {key!r}')
        axes.setdefault(sensor_name(name, 'columns') if name else '', {})[axis] = column
    if not axes or '' in axes and len(axes) > 1:
        raise RecordingError('columns: at least one axis is required, and either all axes or none '
                             'name a sensor, such as time=t mag_1.x=bx mag_1.y=by mag_1.z=bz')
    return time, sensor, axes


def sensor_name(text: str, where: str, names: Mapping[str, str] | None = None) -> str:
    """Sensor name of a text at `where`, by `names` or as `mag_3` for 3; raises RecordingError."""
    text = text.strip()
    if names and text in names:
        return names[text]
    name = f'mag_{text}' if re.fullmatch('[0-9]+', text) else text
    if not re.fullmatch('[A-Za-z_][A-Za-z0-9_]*', name):
        raise RecordingError(f'{where}: {text!r} is not a valid sensor name, which has only '
                             'letters, digits and _, and does not begin with a digit; assign one '
                             f"with --sensors '{text or 'TEXT'}=mag_1'")
    return name


def find_columns(table: Table, assigned: Sequence[str], unit: str, sensor: str) -> Columns:
    """Find the columns of a table by assignments (`parse_columns`), or else by their names.

    An empty `unit` is that of the header; `sensor` names the only sensor if the columns name none.
    Raises RecordingError if a column is missing or ambiguous, or the unit is unknown.
    """
    time, sensor_column, axes = parse_columns(assigned) if assigned else _by_header(table)
    notes = [] if assigned else [_assignment_note(time, sensor_column, axes)]
    # A name may itself contain a plus sign.
    parts = [time] if not time or time in (table.header or ()) else time.split('+')
    times = tuple(_index(table, name) for name in parts if time)
    stated_scale = field_scale(unit, '--unit') if unit else 0.0
    found, units = [], set()
    for name, columns in axes.items():
        if not name and sensor_column is None:
            name = sensor or DEFAULT_SENSOR
            notes += [] if sensor else [f'sensor {name} (--sensor states another name)']
        for axis, column in columns.items():
            j = _index(table, column)
            stated = _unit_of(table, j)
            units.add(stated)
            if not unit and not stated:
                raise RecordingError(
                    f'{table.path}: --unit is missing: column {column} states no unit of the '
                    f'field; give {", ".join(FIELD_UNITS)}, or counts per unit such as 1090/G')
            found.append(Axis(name, 'xyz'.index(axis), j, stated_scale or FIELD_UNITS[stated]))
    if unit and any(u and abs(FIELD_UNITS[u] / stated_scale - 1.0) > 1e-9 for u in units):
        notes.append(f'warning: --unit {unit} differs from {" ".join(sorted(units - {""}))} in '
                     'the header')
    elif not unit:
        notes.append(f'unit {" ".join(sorted(units))}')
    names_column = None if sensor_column is None else _index(table, sensor_column)
    return Columns(times, names_column, tuple(found), time,
                   _time_unit_of(table, times[0]) if len(times) == 1 else '', tuple(notes))


def _index(table: Table, column: str) -> int:
    """Index of a column by its name, its name without unit, or its number (from 1)."""
    header, column = table.header or [], column.strip().lstrip('#%/ ')
    for names in (header, [name.lower() for name in header],
                  [split_unit(name)[0].lower() for name in header]):
        wanted = column if names is header else column.lower()
        if names.count(wanted) == 1:
            return names.index(wanted)
        if names.count(wanted) > 1:
            numbers = [str(k + 1) for k, name in enumerate(names) if name == wanted]
            raise RecordingError(f'{table.path}: the columns {", ".join(numbers)} are all named '
                                 f'{column}; give the number instead of the name')
    n_columns = len(table.rows[0][1]) if table.rows else len(header)
    if column.isdecimal() and 1 <= int(column) <= n_columns:
        return int(column) - 1
    if table.header is None:
        raise RecordingError(f'{table.path} has no header line, so column {column} is missing; '
                             f'give the numbers of its {n_columns} columns, such as time=1 '
                             'sensor=2 x=3 y=4 z=5, or --header with the number of the header line')
    similar = closest_name(column, header)
    hint = f'; did you mean {similar}?' if similar else ''
    raise RecordingError(f'{table.path}: column {column} is missing; the columns in line '
                         f'{table.header_line} are {", ".join(header)}{hint or _HEADER_HINT}')


def split_unit(name: str) -> tuple[str, str]:
    """Split names such as 'Bx (µT)', 'Bx_uT' or 'time [ms]' into name and unit ('' if none)."""
    match = _UNIT_AT_END(name) if len(name) < MAX_NAME else None
    if match and match[1]:
        return match[1], match[2]
    # A single letter without brackets is rather a part of the name.
    if match and len(match[4]) > 1 and (field_unit(match[4]) or time_unit(match[4])):
        return match[3], match[4]
    return name, ''


def _unit_of(table: Table, j: int) -> str:
    """Unit of the field of a column in the header or the line of units; '' if none is stated."""
    texts = [split_unit(table.header[j])[1]] if table.header else []
    return next(filter(None, map(field_unit, [*texts, *table.units[j:j + 1]])), '')


def _time_unit_of(table: Table, j: int) -> str:
    """Unit of the time of a column in the header or the line of units; '' if none is stated."""
    texts = [split_unit(table.header[j])[1], table.header[j]] if table.header else []
    if table.header and table.header[j].strip() in ('s', 't', 'h', 'd', 'min'):
        texts.pop()
    return next(filter(None, map(time_unit, [*texts, *table.units[j:j + 1]])), '')


def _by_header(table: Table) -> _Assigned:
    if table.header is None:
        n = len(table.rows[0][1])
        raise RecordingError(f'{table.path} has no header line; give the numbers of its {n} '
                             'columns with --columns, such as --columns time=1 sensor=2 x=3 y=4 '
                             'z=5, or --header with the number of the header line')
    times: list[str] = []
    sensors: list[str] = []
    axes: dict[str, dict[str, str]] = {}
    of_unknown_unit = ''
    for name in filter(None, table.header):
        base, unit = split_unit(name)
        words = _words(base)
        if set(words) & _OTHER_WORDS:
            continue
        if unit and not field_unit(unit) and not time_unit(unit):
            of_unknown_unit = of_unknown_unit or name * bool(_axis_of(words))
            continue
        if set(words[-1:]) & _DATE_WORDS or set(words) & _TIME_WORDS and not field_unit(unit):
            times.append(name)
        elif axis := _axis_of(words):
            if axes.setdefault(axis[0], {}).setdefault(axis[1], name) != name:
                _refuse(table, f'both {axes[axis[0]][axis[1]]} and {name} may be the axis '
                        f'{axis[1]}')
        elif set(words) & _SENSOR_WORDS:
            sensors.append(name)
    if len(times) == 2 and any(_DATE_WORDS & set(_words(t)) for t in times):
        times = ['+'.join(sorted(times, key=lambda t: not _DATE_WORDS & set(_words(t))))]
    if len(times) > 1 or len(sensors) > 1:
        several = times if len(times) > 1 else sensors
        _refuse(table, f'{" and ".join(several)} may be the '
                f'{"time" if several is times else "sensor"}')
    if not axes or '' in axes and len(axes) > 1 or sensors and '' not in axes:
        _refuse(table, f'the unit of {of_unknown_unit} is not one of {", ".join(FIELD_UNITS)}; '
                'give --unit' if of_unknown_unit and not axes else
                'the axes of the field are not clear')
    return times[0] if times else '', sensors[0] if sensors else None, axes


def _refuse(table: Table, cause: str) -> None:
    """Raise RecordingError because the names of the columns are not clear."""
    raise RecordingError(f'{table.path}: {cause}; assign the columns with --columns, such as '
                         '--columns time=t x=bx y=by z=bz; the columns are '
                         f'{", ".join(table.header or ())}')


def _words(name: str) -> list[str]:
    """Words of a name in lower case without accents, split at capitals and other characters."""
    name = ''.join(c for c in unicodedata.normalize('NFKD', name) if not unicodedata.combining(c))
    name = re.sub(r'([a-z0-9])([A-Z])', r'\1 \2', name)
    return re.findall('[a-z0-9]+', name.lower())


def _axis_of(words: Sequence[str]) -> tuple[str, str] | None:
    """Return (sensor, axis) that the words of a name stand for; the sensor may be ''."""
    # The axis may also come first: 'x1', 'X magnetic field'.
    order = list(words) if not words or words[-1].isdecimal() or _AXIS(words[-1]) else [
        *words[1:], words[0]]
    number = order.pop() if order and order[-1].isdecimal() else ''
    match = _AXIS(order[-1]) if order else None
    if match is None:
        return None
    rest = [word for word in (*order[:-1], match['rest']) if word and word not in _FIELD_WORDS]
    number = match['number'] or number
    glued = re.fullmatch('(?:mag|magnetometer|sensor|s|m|b|imu)([0-9]+)', rest[0]) if len(
        rest) == 1 else None
    if glued and not number:
        rest, number = [], glued[1]
    if match['rest'] and not glued:
        return None
    name = '_'.join([*rest, *([number] if number else [])])
    return (f'mag_{name}' if name[:1].isdecimal() else name), match['axis']


def _assignment_note(time: str, sensor: str | None, axes: Mapping[str, Mapping[str, str]]) -> str:
    parts = [f'time={time}'] if time else []
    parts += [f'sensor={sensor}'] if sensor else []
    parts += [f'{name}.{axis}={column}' if name else f'{axis}={column}'
              for name, columns in axes.items() for axis, column in columns.items()]
    return f'columns {", ".join(parts[:8])}{", ..." if len(parts) > 8 else ""}'
