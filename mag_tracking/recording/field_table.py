"""Import of CSV tables of magnetometer readings with user-defined columns and units."""

import csv
import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.files import checked_path
from mag_tracking.messages.schema import magnetic_field_dicts
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import Readings
from mag_tracking.units import LATEST_NS

FIELD_UNITS = {'T': 1.0, 'mT': 1e-3, 'uT': 1e-6, 'nT': 1e-9, 'gauss': 1e-4, 'mgauss': 1e-7}
"""Tesla per unit."""
TIME_UNITS = {'s': 10**9, 'ms': 10**6, 'us': 10**3, 'ns': 1}
"""Nanoseconds per unit."""

_Path: TypeAlias = str | PathLike[str]
_Axes: TypeAlias = dict[str, dict[str, str]]
"""{sensor: {axis: column}}; the sensor is '' if a column contains the sensor names."""


def parse_columns(texts: Sequence[str]) -> tuple[str, str | None, _Axes]:
    """Parse the assignments of table columns.

    Parameters
    ----------
    texts : sequence of str
        `time=COLUMN`, and either `sensor=COLUMN` with `x=COLUMN` and so on (one row per reading),
        or `NAME.x=COLUMN` and so on (one row for all sensors). Omit axes that were not measured.

    Returns
    -------
    time : str
        Column of the time.
    sensor : str or None
        Column of the sensor name. None if each sensor has its own columns.
    axes : dict of str to dict of str to str
        Column by sensor and axis. If `sensor` is a column, the only key is ''.

    Raises
    ------
    RecordingError
        If an assignment is invalid, duplicated or missing.
    """
    found: dict[str, str] = {}
    for text in texts:
        key, equals, column = text.partition('=')
        if not (equals and column) or key in found:
            raise RecordingError(f'columns: {text!r} repeats a key' if key in found else
                                 f'columns: expected KEY=COLUMN such as time=t, got {text!r}')
        found[key] = column
    time, sensor = found.pop('time', None), found.pop('sensor', None)
    axes: _Axes = {}
    for key, column in found.items():
        name, _, axis = key.rpartition('.')
        if axis not in ('x', 'y', 'z') or bool(name) == (sensor is not None):
            raise RecordingError('columns: expected time, sensor, x, y, z (one row per reading) or '
                                 'time, NAME.x, NAME.y, NAME.z (one row for all sensors); '
                                 f'got {key!r}')
        axes.setdefault(_sensor_name(name, 'columns') if name else '', {})[axis] = column
    if time is None or not axes:
        raise RecordingError('columns: time and at least one axis are required, such as time=t '
                             'mag_1.x=bx mag_1.y=by mag_1.z=bz')
    return time, sensor, axes


def import_field_table(table: _Path, columns: Sequence[str], unit: str, out: _Path,
                       time_unit: str = 's') -> tuple[Path, dict[str, int]]:
    """Import a table of readings as a recording.

    Parameters
    ----------
    table : path_like
        CSV file with a header.
    columns : sequence of str
        Assignments as for `parse_columns`. An empty cell is a missing measurement.
    unit : str
        Unit of the field, a key of `FIELD_UNITS`.
    out : path_like
        Folder for `<table>.mcap` and `metadata.yaml`.
    time_unit : str, optional
        Unit of the time, a key of `TIME_UNITS`.

    Returns
    -------
    recording : Path
        Recording with the readings on `/NAME/imu/mag`.
    counts : dict of str to int
        Number of readings by sensor. A row in which no axis was measured is not counted.

    Raises
    ------
    RecordingError
        If a unit is unknown or the table does not match the columns.
    OutputError
        If `out` cannot be written.
    """
    for name, value, units in (('unit', unit, FIELD_UNITS), ('time unit', time_unit, TIME_UNITS)):
        if value not in units:
            raise RecordingError(f'{name}: expected one of {", ".join(units)}, got {value!r}')
    readings = _readings(Path(table), parse_columns(columns), FIELD_UNITS[unit],
                         TIME_UNITS[time_unit])
    recording = Path(out) / f'{Path(table).stem}.mcap'
    counts = dict.fromkeys(readings.names, 0)
    with RecordingWriter(recording) as writer:
        for k, (name, content) in enumerate(magnetic_field_dicts(readings)):
            writer.write(f'/{name}/imu/mag', MAGNETIC_FIELD, content, int(readings.stamp_ns[k]))
            counts[name] += 1
    return recording, counts


def _readings(table: Path, columns: tuple[str, str | None, _Axes], scale: float,
              time_scale: int) -> Readings:
    """Read the readings of a table in chronological order; raises RecordingError."""
    time, sensor, axes = columns
    names: list[str] = []
    stamps: list[int] = []
    fields: list[FloatArray] = []
    column_names = [time, *([sensor] if sensor else []),
                    *(c for a in axes.values() for c in a.values())]
    for number, row in _rows(table, column_names):
        stamp = _stamp(row[time], time_scale, f'{table}: row {number}: {time}')
        for name, axis_columns in axes.items():
            field = np.full(3, np.nan)
            for axis, column in axis_columns.items():
                field['xyz'.index(axis)] = scale * _number(
                    row[column], f'{table}: row {number}: {column}')
            if not np.isnan(field).all():
                names.append(_sensor_name(row[sensor], f'{table}: row {number}: {sensor}')
                             if sensor else name)
                stamps.append(stamp)
                fields.append(field)
    if not names:
        raise RecordingError(f'{table} has no readings')
    order = np.argsort(stamps, kind='stable')
    return Readings.by_name(names, stamps, np.array(fields)).part(order)


def _rows(table: Path, column_names: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """Read [(line number, {column: cell})] from a CSV file; raises RecordingError."""
    table = checked_path(table, RecordingError)
    try:
        with open(table, newline='', encoding='utf-8-sig') as stream:
            reader = csv.DictReader(stream, skipinitialspace=True)
            missing_columns = [c for c in column_names if c not in (reader.fieldnames or ())]
            if missing_columns:
                raise RecordingError(f'{table}: column {missing_columns[0]} is missing; the '
                                     'columns are '
                                     f'{", ".join(reader.fieldnames or ["none"])}')
            rows = [(reader.line_num, row) for row in reader]
    except OSError as error:
        raise RecordingError(f'cannot read {table}: {error.strerror}') from error
    except (csv.Error, UnicodeDecodeError) as error:
        raise RecordingError(f'{table} is not a CSV file: {error}') from error
    for number, row in rows:
        if any(row[c] is None for c in column_names):
            raise RecordingError(f'{table}: row {number} has too few columns')
        if None in row:
            raise RecordingError(f'{table}: row {number} has too many columns; does it contain '
                                 'decimal commas?')
    return rows


def _number(text: str, where: str) -> float:
    """Convert a cell to a number, NaN if empty; raises RecordingError if invalid or infinite."""
    if not text.strip():
        return float('nan')
    try:
        value = float(text)
    except ValueError:
        raise RecordingError(f'{where}: expected a number, got {text!r}') from None
    if np.isinf(value):
        raise RecordingError(f'{where} is infinite')
    return value


def _stamp(text: str, scale: int, where: str) -> int:
    """Convert a cell, in units of `scale` ns, to a time [ns]; raises RecordingError.

    Integer cells are converted exactly.
    """
    text = text.strip()
    is_integer = re.fullmatch(r'[+-]?[0-9]{1,20}', text)
    value = int(text) * scale if is_integer else _number(text, where) * scale
    if not 0 <= value <= LATEST_NS:
        raise RecordingError(f'{where}: {text[:30] or "an empty cell"} is not a valid time since '
                             '1970')
    return round(value)


def _sensor_name(text: str, where: str) -> str:
    """Convert a string to a sensor name for topics (3 becomes `mag_3`); raises RecordingError."""
    name = f'mag_{text.strip()}' if re.fullmatch('[0-9]+', text.strip()) else text.strip()
    if not re.fullmatch('[A-Za-z_][A-Za-z0-9_]*', name):
        raise RecordingError(f'{where}: {text!r} is not a valid sensor name: use only letters, '
                             'digits and _, and do not begin with a digit')
    return name
