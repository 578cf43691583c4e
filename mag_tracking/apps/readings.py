"""Readings as arrays, from a recording, tables or arrays of the user."""

import re
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mag_tracking.analysis.track_errors import Truth
from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.errors import ReadingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.quantities import quantity
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Readings
from mag_tracking.run import ArraySource, RecordingSource, Source
from mag_tracking.units import LATEST_NS, NS

if TYPE_CHECKING:
    import pandas as pd

MAX_DELAY_S = 10.0
"""Delay above which a reading is considered unsorted rather than delayed [s]."""
UNITS_NS = {'s': 1_000_000_000, 'ms': 1_000_000, 'us': 1_000, 'ns': 1}
TIME_COLUMNS = ('stamp_ns', 'time', 'timestamp', 't')
"""Accepted names of the column with the times; without one, the index must contain datetimes."""
AXES = ('x', 'y', 'z')
_AXIS = re.compile(r'[ ._/-]?(?:b|mag)?([xyz])', re.IGNORECASE)
_WIDE = re.compile(r'(.+)[ ._/-](?:b|mag)?([xyz])', re.IGNORECASE)


@dataclass(frozen=True)
class RecordedReadings:
    """Content of a recording as arrays."""

    readings: Readings
    """Readings in the order of logging; `names` are the sensors of the network."""
    truth: dict[str, Truth]
    """{target: (timestamps (n,) ns, positions (n, 3) m, quaternions (n, 4) xyzw)}; empty without
    ground truth."""
    rejected: dict[str, int]
    """Messages without a usable reading: {cause: number}."""
    lost: dict[str, int]
    """Unreadable parts of the recording: {damage: number}."""
    missing_topics: tuple[str, ...]
    """Topics of the network that are not in the recording."""

    def __repr__(self) -> str:
        return (f'RecordedReadings({quantity(len(self.readings), "reading")} of '
                f'{", ".join(self.readings.names)}; truth: {", ".join(self.truth) or "none"})')


UserSource: TypeAlias = ('Readings | RecordedReadings | str | PathLike[str] | pd.DataFrame'
                         ' | Mapping[str, tuple[ArrayLike, ArrayLike]]')
"""A mapping is {sensor: (times, fields)}."""


def network_of(network: SensorNetwork | str | PathLike[str]) -> SensorNetwork:
    """Return a network, or read it from a file; raises NetworkError."""
    return network if isinstance(network, SensorNetwork) else read_network(network)


def read_recording(path: str | PathLike[str],
                   network: SensorNetwork | str | PathLike[str]) -> RecordedReadings:
    """Read the readings of a network and the ground truth from a recording.

    Parameters
    ----------
    path : path
        An .mcap, .db3 or .bag file, or a rosbag2 folder.
    network : SensorNetwork or path of a network file

    Returns
    -------
    RecordedReadings

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is invalid.
    """
    network = network_of(network)
    recording = Recording(path)
    reader = SampleReader(recording, network)
    recorded = Readings.joined(reader.readings())
    sensor = recorded.rows({name: i for i, name in enumerate(network.names)})
    return RecordedReadings(
        Readings(network.names, sensor, recorded.stamp_ns, recorded.field, recorded.covariance),
        reader.truth_arrays(), dict(reader.rejected), dict(recording.losses),
        tuple(reader.missing_topics()))


def source_of(source: UserSource, network: SensorNetwork, time_unit: str | None = None) -> Source:
    """Source for `run`: a recording, which need not fit into memory, or readings."""
    if _is_table(source):
        source = readings_of_table(source, time_unit, network.names)
    elif isinstance(source, Mapping):
        source = readings_of_arrays(source, time_unit)
    elif time_unit is not None:
        raise ReadingsError('time_unit: only for the times of a DataFrame or of arrays')
    if isinstance(source, Readings):
        check_order(source)
        readings = _checked_readings(source, network)
        present = {readings.names[j] for j in np.unique(readings.sensor)}
        return ArraySource(readings, topics=[topic for name, topic in zip(
            network.names, network.absolute_topics, strict=True) if name not in present])
    if isinstance(source, RecordedReadings):
        return ArraySource(_checked_readings(source.readings, network), source.rejected,
                           source.lost, source.missing_topics, source.truth)
    if isinstance(source, str | PathLike):
        return RecordingSource(Recording(source), network)
    raise ReadingsError('source: expected a path, Readings, a DataFrame or {sensor: (times, '
                        f'fields)}}, got {type(source).__name__}')


def readings_from_arrays(sensor: Sequence[str], stamp_ns: ArrayLike, field: ArrayLike,
                         covariance: ArrayLike | None = None,
                         time_unit: str | None = None) -> Readings:
    """Create readings from arrays, for `track`.

    Parameters
    ----------
    sensor : (n,) sequence of str
        Name of the sensor of each reading, as in the network file.
    stamp_ns : (n,) int array, ns, datetime64 array, or float array
        Timestamps in ascending order; sensors may have equal timestamps. Times without a time zone
        are in UTC.
    field : (n, 3) array, T, sensor frame
        Flux density; NaN marks an axis that was not measured.
    covariance : (n, 3, 3) array, T², sensor frame, optional
        Noise covariance; NaN if unknown.
    time_unit : 's', 'ms', 'us' or 'ns', optional
        Unit of `stamp_ns`; required for floats.

    Returns
    -------
    Readings

    Raises
    ------
    ReadingsError
        If shapes or types are wrong, or the timestamps are not sorted.
    """
    if isinstance(sensor, str):
        raise ReadingsError(f'sensor: expected one name per reading, got the string {sensor!r}')
    names, index = _numbered(sensor)
    fields, C = _with_nan(field), None if covariance is None else _with_nan(covariance)
    readings = _to_standard_types(Readings(
        names, index, nanoseconds(stamp_ns, time_unit, 'stamp_ns'),
        fields if fields.size else fields.reshape(0, 3), C))
    check_order(readings, 0.0)
    return readings


def _numbered(sensors: Iterable[object]) -> tuple[tuple[str, ...], IntArray]:
    """Distinct names, and the index of each sensor in them."""
    named = [str(sensor) for sensor in sensors]
    index = {name: i for i, name in enumerate(dict.fromkeys(named))}
    return tuple(index), np.array([index[name] for name in named], dtype=np.int64)


def _with_nan(values: ArrayLike) -> NDArray[Any]:
    """Convert values to an array with NaN for masked elements."""
    if isinstance(values, np.ma.MaskedArray):
        return np.where(values.mask, np.nan, values.data)
    return np.asarray(values)


def _checked_readings(readings: Readings, network: SensorNetwork) -> Readings:
    """Convert readings to the types of the stages; raises ReadingsError if none is usable."""
    readings = _to_standard_types(readings)
    if len(readings) and not set(readings.names) & set(network.names):
        raise ReadingsError(f'no reading is from a sensor of the network: the readings are from '
                            f'{", ".join(readings.names)}, the sensors of the network are '
                            f'{", ".join(network.names)}')
    return readings


def _to_standard_types(readings: Readings) -> Readings:
    """Convert readings to int64 and float64; raises ReadingsError for a wrong shape or type."""
    n = len(readings)
    for name, kinds, expected in (
            ('sensor', 'iu', 'integers, indices into names'),
            ('stamp_ns', 'iu', 'integers, nanoseconds'), ('field', 'iuf', 'floats'),
            ('covariance', 'iuf', 'floats')):
        values = getattr(readings, name)
        if isinstance(values, np.ma.MaskedArray):
            raise ReadingsError(f'{name}: masked arrays are not supported; use NaN for missing '
                                'values')
        # NumPy converts an empty list to float.
        if values is not None and np.size(values) and np.asarray(values).dtype.kind not in kinds:
            raise ReadingsError(f'{name}: expected {expected}, got {np.asarray(values).dtype}')
    stamps = np.asarray(readings.stamp_ns)
    if n and not -LATEST_NS <= int(stamps.min()) <= int(stamps.max()) <= LATEST_NS:
        raise ReadingsError(f'stamp_ns: {stamps.min()} .. {stamps.max()} is outside '
                            f'{-LATEST_NS} .. {LATEST_NS}; expected nanoseconds since 1970')
    sensor = np.asarray(readings.sensor, dtype=np.int64)
    if n and not 0 <= sensor.min() <= sensor.max() < len(readings.names):
        raise ReadingsError('sensor: expected indices into names (0 .. '
                            f'{len(readings.names) - 1}), got {sensor.min()} .. {sensor.max()}')
    C = readings.covariance
    return Readings(tuple(readings.names), sensor, np.asarray(readings.stamp_ns, dtype=np.int64),
                    np.asarray(readings.field, dtype=float),
                    None if C is None else np.asarray(C, dtype=float))


def check_order(readings: Readings, tolerance: float = MAX_DELAY_S) -> None:
    """Raise ReadingsError if a reading is older than a preceding one by more than `tolerance`
    [s]."""
    if not len(readings):
        return
    delay_ns = np.maximum.accumulate(readings.stamp_ns) - readings.stamp_ns
    late: BoolArray = delay_ns > tolerance * NS
    if late.any():
        k = int(np.argmax(late))
        raise ReadingsError(
            f'stamp_ns: reading {k} ({readings.names[readings.sensor[k]]}) is '
            f'{delay_ns[k] / NS:.3g} s older than an earlier reading; sort the readings '
            "(np.argsort(stamp_ns, kind='stable')), and track separate recordings separately")


def _is_table(source: object) -> TypeGuard['pd.DataFrame']:
    """Whether `source` is a pandas DataFrame, which is recognised without importing pandas."""
    return hasattr(source, 'columns') and hasattr(source, 'index')


def nanoseconds(times: ArrayLike, unit: str | None, name: str) -> IntArray:
    """Convert times (n,) to ns since 1970; datetimes without a time zone are in UTC.

    `unit` is required for floats; integers are in ns by default. Raises ReadingsError, which names
    the column or argument `name`, also for times that ROS cannot represent: their unit is wrong.
    """
    if unit is not None and unit not in UNITS_NS:
        raise ReadingsError(f'time_unit: expected {" or ".join(UNITS_NS)}, got {unit!r}')
    # Times of pandas with a time zone have a dtype of this name, too, and become UTC.
    are_dates = str(getattr(times, 'dtype', '')).startswith('datetime64')
    values = np.asarray(times, dtype='datetime64[s]' if are_dates else None)
    if are_dates and unit is not None:
        raise ReadingsError(f'time_unit: {name} contains datetimes, which need no unit')
    if not are_dates and values.dtype.kind not in 'iuf':
        raise ReadingsError(f'{name}: expected datetimes of one time zone, integers or floats, got '
                            f'{values.dtype}; pandas.to_datetime(..., utc=True) converts text')
    if values.dtype.kind == 'f' and unit is None and values.size:
        raise ReadingsError(f'{name}: the unit of floats is unknown; add time_unit, one of '
                            f'{", ".join(UNITS_NS)}')
    # NaT is not finite.
    if not np.isfinite(values).all():
        raise ReadingsError(f'{name}: row {int(np.argmin(np.isfinite(values)))} has no time')
    unit, numbers = ('s', values.astype(np.int64)) if are_dates else (unit or 'ns', values)
    limit = LATEST_NS // UNITS_NS[unit]
    if numbers.size and not -limit <= numbers.min() <= numbers.max() <= limit:
        raise ReadingsError(f'{name}: {numbers.min()} .. {numbers.max()} {unit} is outside '
                            f'{-limit} .. {limit} {unit} since 1970; check the unit of the '
                            'times (time_unit)')
    if are_dates:
        return np.asarray(times, dtype='datetime64[ns]').astype(np.int64)
    if values.dtype.kind == 'f':
        return np.round(values * UNITS_NS[unit]).astype(np.int64)
    return values.astype(np.int64) * UNITS_NS[unit]


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
        return _in_order(*_numbered(table['sensor']), stamp_ns,
                         np.column_stack([_numbers(table, axis) for axis in AXES]))
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
    parts = {}
    for name, axes in found.items():
        _check_axes(axes, f'{name}: ', columns)
        field = np.column_stack([_numbers(table, axes[axis]) for axis in AXES])
        # A row without a value of a sensor is no reading.
        rows = ~np.isnan(field).all(axis=1)
        parts[name] = stamp_ns[rows], field[rows]
    return readings_of_arrays(parts, None)


def _check_axes(present: Container[Any], label: str, columns: Iterable[Any]) -> None:
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
    names = [str(column) for column in columns]
    return ', '.join(names[:20]) + (' ...' if len(names) > 20 else '') or 'none'
