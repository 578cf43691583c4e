"""Readings from DataFrames and arrays of users."""

import re
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.errors import ReadingsError
from mag_tracking.records import Readings
from mag_tracking.units import LATEST_NS

if TYPE_CHECKING:
    import pandas as pd

UNITS_NS = {'s': 1_000_000_000, 'ms': 1_000_000, 'us': 1_000, 'ns': 1}
"""Nanoseconds per unit of time."""
TIME_COLUMNS = ('stamp_ns', 'time', 'timestamp', 't')
"""Accepted names of the column with the times; without one, the index must contain datetimes."""
AXES = ('x', 'y', 'z')
_AXIS = re.compile(r'[ ._/-]?(?:b|mag)?([xyz])', re.IGNORECASE)
_WIDE = re.compile(r'(.+)[ ._/-](?:b|mag)?([xyz])', re.IGNORECASE)


def is_table(source: object) -> bool:
    """Whether `source` is a pandas DataFrame, which is recognised without importing pandas."""
    return hasattr(source, 'columns') and hasattr(source, 'index')


def nanoseconds(times: ArrayLike, unit: str | None, name: str) -> IntArray:
    """Convert times (n,) to ns since 1970; datetimes without a time zone are in UTC.

    `unit` is required for floats; integers are in ns by default. Raises ReadingsError, which names
    the column or argument `name`.
    """
    if unit is not None and unit not in UNITS_NS:
        raise ReadingsError(f'time_unit: expected {" or ".join(UNITS_NS)}, got {unit!r}')
    # Times of pandas with a time zone have a dtype of this name, too, and become UTC.
    if str(getattr(times, 'dtype', '')).startswith('datetime64'):
        if unit is not None:
            raise ReadingsError(f'time_unit: {name} contains datetimes, which need no unit')
        seconds = np.asarray(times, dtype='datetime64[s]')
        if np.isnat(seconds).any():
            raise ReadingsError(f'{name}: row {int(np.argmax(np.isnat(seconds)))} has no time')
        _check_range(seconds.astype(np.int64), 's', name)
        return np.asarray(times, dtype='datetime64[ns]').astype(np.int64)
    values = np.asarray(times)
    if values.dtype.kind in 'iu':
        _check_range(values, unit or 'ns', name)
        return values.astype(np.int64) * UNITS_NS[unit or 'ns']
    if values.dtype.kind != 'f':
        raise ReadingsError(f'{name}: expected datetimes of one time zone, integers or floats, got '
                            f'{values.dtype}; pandas.to_datetime(..., utc=True) converts text')
    if unit is None and values.size:
        raise ReadingsError(f'{name}: the unit of floats is unknown; add time_unit, one of '
                            f'{", ".join(UNITS_NS)}')
    if not np.isfinite(values).all():
        raise ReadingsError(f'{name}: row {int(np.argmin(np.isfinite(values)))} has no time')
    _check_range(values, unit or 'ns', name)
    return np.round(values * UNITS_NS[unit or 'ns']).astype(np.int64)


def _check_range(values: NDArray[Any], unit: str, name: str) -> None:
    """Raise ReadingsError for times that ROS cannot represent, which a wrong unit produces."""
    limit = LATEST_NS // UNITS_NS[unit]
    if values.size and not -limit <= values.min() <= values.max() <= limit:
        raise ReadingsError(f'{name}: {values.min()} .. {values.max()} {unit} is outside '
                            f'{-limit} .. {limit} {unit} since 1970; check the unit of the '
                            'times (time_unit)')


def readings_of_arrays(arrays: Mapping[str, tuple[ArrayLike, ArrayLike]],
                       time_unit: str | None) -> Readings:
    """Readings of {sensor: (times (n,), fields (n, 3) [T])}, each sensor in chronological order."""
    stamps, fields, counts = [], [], []
    for name, pair in arrays.items():
        if not isinstance(name, str) or not isinstance(pair, tuple | list) or len(pair) != 2 \
                or np.ndim(pair[0]) != 1:
            raise ReadingsError(f'{name}: expected {{sensor: (times (n,), fields (n, 3))}}')
        stamp_ns, field = nanoseconds(pair[0], time_unit, name), np.asarray(pair[1])
        if field.dtype.kind not in 'iuf' or field.shape != (len(stamp_ns), 3):
            raise ReadingsError(f'{name}: expected numbers of shape ({len(stamp_ns)}, 3), got '
                                f'{field.dtype} of shape {field.shape}')
        stamps.append(stamp_ns)
        fields.append(field.astype(float))
        counts.append(len(stamp_ns))
    if not arrays:
        raise ReadingsError('no sensors: expected {sensor: (times, fields)}')
    sensor = np.repeat(np.arange(len(arrays)), counts)
    return _in_order(tuple(arrays), sensor, np.concatenate(stamps), np.concatenate(fields))


def readings_of_table(table: 'pd.DataFrame', time_unit: str | None,
                      sensors: Sequence[str]) -> Readings:
    """Readings of a long or wide DataFrame, in tesla and chronological order of each sensor.

    A long table has a row per reading with the columns `sensor`, x, y and z. A wide table has a row
    per time, with columns such as `mag_1_x` or (`mag_1`, `x`); `sensors` are the names of the
    network. NaN marks an axis that was not measured. The times are in a column of `TIME_COLUMNS` or
    in the index.
    """
    repeated = table.columns[table.columns.duplicated()]
    if len(repeated):
        raise ReadingsError(f'column {repeated[0]!r} occurs several times')
    time_column, times = _times(table)
    stamp_ns = nanoseconds(times, time_unit, str(time_column))
    columns = [c for c in table.columns if c != time_column]
    if 'sensor' in columns:
        _check_axes(columns, '', columns)
        names = [str(name) for name in table['sensor']]
        unique = tuple(dict.fromkeys(names))
        index = {name: j for j, name in enumerate(unique)}
        field = np.column_stack([_numbers(table, axis) for axis in AXES])
        return _in_order(unique, np.array([index[name] for name in names], dtype=np.int64),
                         stamp_ns, field)
    found: dict[str, dict[str, Any]] = {}
    for column in columns:
        name, axis = _sensor_axis(column, columns, sensors)
        if axis in found.setdefault(name, {}):
            raise ReadingsError(f'{name}: the columns {found[name][axis]!r} and {column!r} contain '
                                'the same axis')
        found[name][axis] = column
    if not found:
        raise ReadingsError('no columns of sensors: expected columns such as mag_1_x, or a column '
                            'sensor with x, y and z')
    for name, axes in found.items():
        _check_axes(axes, f'{name}: ', columns)
    fields = {name: np.column_stack([_numbers(table, axes[axis]) for axis in AXES])
              for name, axes in found.items()}
    # A row without a value of a sensor is no reading.
    rows = [np.flatnonzero(~np.isnan(field).all(axis=1)) for field in fields.values()]
    return _in_order(tuple(fields), np.repeat(np.arange(len(fields)), [len(r) for r in rows]),
                     np.concatenate([stamp_ns[r] for r in rows]),
                     np.concatenate([f[r] for f, r in zip(fields.values(), rows, strict=True)]))


def _check_axes(present: Container[Any], label: str, columns: Iterable[Any]) -> None:
    """Raise ReadingsError unless all axes are present."""
    missing = [axis for axis in AXES if axis not in present]
    if missing:
        raise ReadingsError(f'{label}no column for {", ".join(missing)}: add one with NaN for an '
                            f'axis that is not measured; columns: {_listed(columns)}')


def _times(table: 'pd.DataFrame') -> tuple[Any, Any]:
    """Return (name, values) of the times of a table."""
    found = [name for name in TIME_COLUMNS if name in table.columns]
    if len(found) > 1:
        raise ReadingsError(f'several columns with times: {", ".join(found)}; drop all but one')
    if found:
        return found[0], table[found[0]]
    if str(table.index.dtype).startswith('datetime64') or table.index.name in TIME_COLUMNS:
        return table.index.name or 'index', table.index
    raise ReadingsError(f'no times: expected a column {", ".join(TIME_COLUMNS)} or an index of '
                        f'datetimes; columns: {_listed(table.columns)}')


def _sensor_axis(column: Any, columns: Iterable[Any], sensors: Sequence[str]) -> tuple[str, str]:
    """Return (sensor, axis) of a column of a wide table."""
    if isinstance(column, tuple):
        parts = [str(part) for part in column if part != '']
        name, axis = '/'.join(parts[:-1]), parts[-1].lower()
        if name and axis in AXES:
            return name, axis
    for sensor in sensors:
        match = _AXIS.fullmatch(str(column).removeprefix(sensor))
        if str(column).startswith(sensor) and match:
            return sensor, match[1].lower()
    if match := _WIDE.fullmatch(str(column)):
        return match[1], match[2].lower()
    raise ReadingsError(f'column {column!r} belongs to no sensor: name it like mag_1_x or drop it; '
                        f'a table with one row per reading needs a column sensor; columns: '
                        f'{_listed(columns)}')


def _numbers(table: 'pd.DataFrame', column: Any) -> FloatArray:
    """Values (n,) of a column as floats; missing values become NaN."""
    values = table[column]
    if values.dtype.kind not in 'iuf':
        raise ReadingsError(f'column {column!r}: expected numbers, got {values.dtype}; '
                            'pandas.to_numeric converts text')
    numbers: NDArray[Any] = values.to_numpy(dtype=float, na_value=np.nan)
    return numbers


def _in_order(names: tuple[str, ...], sensor: IntArray, stamp_ns: IntArray,
              field: FloatArray) -> Readings:
    """Merge the readings of the sensors by time; raise ReadingsError if one is not in order."""
    for j, name in enumerate(names):
        steps = np.diff(stamp_ns[sensor == j])
        if (steps <= 0).any():
            k = int(np.argmax(steps <= 0)) + 1
            fault = 'has the same time as' if steps[k - 1] == 0 else 'is older than'
            raise ReadingsError(f'{name}: its reading {k} {fault} the one before it; sort the '
                                'readings and remove repetitions')
    order = np.argsort(stamp_ns, kind='stable')
    return Readings(names, sensor[order], stamp_ns[order], field[order])


def _listed(columns: Iterable[Any]) -> str:
    """Names of columns for a message."""
    names = [str(column) for column in columns]
    return ', '.join(names[:20]) + (' ...' if len(names) > 20 else '') or 'none'
