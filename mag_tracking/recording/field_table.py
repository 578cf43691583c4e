"""Import of tables of magnetometer readings with any usual layout, columns and units."""

import math
import re
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mag_tracking.errors import RecordingError
from mag_tracking.files import checked_path
from mag_tracking.messages.schema import magnetic_field_dicts
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.quantities import quantity
from mag_tracking.recording import table_times
from mag_tracking.recording.table_columns import IGNORED, Columns, find_columns, sensor_name
from mag_tracking.recording.table_layout import Table, read_table
from mag_tracking.recording.table_text import FilePath, find_decimal, parse_number
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import Readings
from mag_tracking.units import DAY_NS, NS, time_unit

SUFFIXES = ('.csv', '.tsv', '.txt')
USUAL_FIELD_T = (1e-5, 2e-4)
"""Range of the median magnitude of a field that is not influenced by magnets [T]."""
MAX_RELATIVE_NS = 10 * 365 * DAY_NS
"""Maximum span of times that are not since 1970 [ns]."""
_DECIMALS = {'ms': 3, 'us': 6, 'ns': 9}
"""Number of decimals of a second in a column of this unit."""


@dataclass(frozen=True)
class TableOptions:
    """Options of `mag-tracking import`; empty ones are found from the table."""

    columns: Sequence[str] = ()
    unit: str = ''
    time_unit: str = ''
    sensor: str = ''
    sensors: Mapping[str, str] = field(default_factory=dict)
    separator: str = ''
    decimal: str = ''
    header: int | None = None
    encoding: str = ''
    date_order: str = ''
    rate: float | None = None
    """Rate of the readings of a sensor [Hz], which replaces the times after the first."""
    wrap: int = 0
    jumps: str = ''


class FieldTable(NamedTuple):
    """Readings of a table."""

    sessions: list[Readings]
    """Readings between restarts of the clock, in chronological order."""
    notes: list[str]
    """What was found out about the layout, and numbers of ignored and unusable rows."""


def read_field_table(path: FilePath, options: TableOptions, with_times: bool = True) -> FieldTable:
    """Read a table of readings; without `with_times`, the timestamps count the rows; if the table
    is ambiguous, RecordingError names the option that states the property."""
    table = read_table(checked_path(path, RecordingError), options.separator, options.header,
                       options.encoding)
    columns = find_columns(table, options.columns, options.unit, options.sensor)
    if not with_times:
        columns, options = columns._replace(time=()), replace(options, rate=1.0)
    decimal = _decimal(table, options)
    rows = _Rows(table, columns, decimal, options)
    table.check_bad_rows(len(rows.lines))
    if not rows.names:
        raise RecordingError(f'{table.path} has no readings')
    stamps, session, order, notes = _stamps(rows, decimal, options)
    notes = [', '.join([*table.notes, *(['decimal comma'] if decimal == ',' else [])]),
             *columns.notes, *(notes if with_times else [])]
    table.check_bad_rows(len(order))
    ignored = [quantity(n, kind) for kind, n in table.ignored.items()]
    if rows.n_without_field:
        ignored.append(quantity(rows.n_without_field, 'row') + ' without a field')
    notes += [f'ignored: {", ".join(ignored)}'] if ignored else []
    if table.bad:
        line, fault = min(table.bad)
        notes.append(f'warning: {quantity(len(table.bad), "unusable row")}, first row {line}: '
                     f'{fault}')
    return FieldTable(_sessions(rows, stamps, session, order), notes)


class _Rows:
    """Rows of a table whose numbers are valid; the others are added to `table.bad`."""

    def __init__(self, table: Table, columns: Columns, decimal: str, options: TableOptions) -> None:
        self.table, self.columns = table, columns
        self.lines: list[int] = []
        self.texts: list[str] = []
        """Text of the time."""
        self.keys: list[int] = []
        """Number of the sensor of each row; 0 if a row has all sensors."""
        self.names: list[tuple[int, str]] = []
        """Index of the row, and sensor, of each reading."""
        self.fields = array('d')
        """Three numbers of each reading [T]."""
        self.n_without_field = 0
        """Rows without any number in the columns of the field."""
        key_of: dict[str, int] = {}
        names = {name: value if value == IGNORED else sensor_name(value, '--sensors')
                 for name, value in options.sensors.items()}
        for line, cells in table.rows:
            try:
                sensor = '' if columns.sensor is None else sensor_name(
                    cells[columns.sensor], self._column(columns.sensor), names)
                if sensor != IGNORED:
                    self._add(line, cells, sensor, key_of.setdefault(sensor, len(key_of)), decimal)
            except (ValueError, RecordingError) as error:
                table.bad.append((line, str(error)))
        # A long table takes hundreds of megabytes.
        table.rows.clear()

    def _column(self, j: int) -> str:
        return self.table.header[j] if self.table.header else f'column {j + 1}'

    def _add(self, line: int, cells: Sequence[str], sensor: str, key: int, decimal: str) -> None:
        """Add a row; raises ValueError if a number is not valid."""
        fields: dict[str, list[float]] = {}
        for axis in self.columns.axes:
            try:
                value = parse_number(cells[axis.column], decimal)
            except ValueError as error:
                raise ValueError(f'{self._column(axis.column)} {error}') from None
            fields.setdefault(sensor or axis.sensor, [math.nan] * 3)[axis.axis] = value * axis.scale
        present = {name: v for name, v in fields.items() if not all(map(math.isnan, v))}
        self.n_without_field += not present
        for name, vector in present.items():
            self.names.append((len(self.lines), name))
            self.fields.extend(vector)
        self.lines.append(line)
        self.keys.append(key)
        self.texts.append(self._time_text([cells[j] for j in self.columns.time]))

    def _time_text(self, parts: Sequence[str]) -> str:
        """Join the cells of the time; a last column of ms, us or ns becomes decimals."""
        if len(parts) < 2 or not parts[-1].isdecimal() or '.' in parts[-2]:
            return ' '.join(parts)
        name = self.table.header[self.columns.time[-1]] if self.table.header else ''
        unit = time_unit(re.split('[^A-Za-z]', name)[-1]) or ''
        if not self.table.header and len(parts) == 2 and len(parts[0]) == 10:
            # Seconds since 1970 and nanoseconds, as `ros2 topic echo --csv` writes them.
            unit = 'ns'
        if len(parts[-1]) > _DECIMALS.get(unit, 0):
            return ' '.join(parts)
        return f'{" ".join(parts[:-1])}.{parts[-1].zfill(_DECIMALS[unit])}'


def _decimal(table: Table, options: TableOptions) -> str:
    """Return the decimal mark of a table; raises RecordingError if it is ambiguous."""
    if options.decimal not in ('', '.', ','):
        raise RecordingError(f"--decimal: expected . or ',', got {options.decimal!r}")
    decimal = options.decimal or find_decimal(
        (cell for _, cells in table.rows for cell in cells), table.separator)
    if not decimal:
        example = next(cell for _, cells in table.rows for cell in cells if ',' in cell)
        raise RecordingError(f"{table.path}: the decimal mark is ambiguous in {example!r}; give "
                             "--decimal ',' or --decimal .")
    return decimal


def _stamps(rows: _Rows, decimal: str, options: TableOptions
            ) -> tuple[list[int], list[int], list[int], list[str]]:
    """Return (timestamps [ns], sessions, indices of the rows, notes) of all rows with a time."""
    path, columns = rows.table.path, rows.columns
    if options.rate is not None and not 1e-3 <= options.rate <= 1e6:
        raise RecordingError(f'--rate: expected 0.001 to 1e6 Hz, got {options.rate:g}')
    if not columns.time:
        if options.rate is None:
            raise RecordingError(
                f'{path} has no column of the time; assign one with --columns time=..., or give '
                'the rate of the readings with --rate HZ. For a calibration by rotation, the times '
                'do not matter: mag-tracking calibrate tumble reads the table itself')
        return (_at_rate(rows.keys, [0] * len(rows.keys), options.rate), [0] * len(rows.keys),
                list(range(len(rows.keys))), [f'times from the rate, {options.rate:g} Hz'])
    where = f'{path}: {columns.time_name}'
    times = table_times.read_times(where, rows.texts, rows.keys, decimal, options.time_unit,
                                   columns.time_unit, options.date_order)
    ordered = table_times.order_times(where, times, rows.texts, rows.keys, rows.lines, options.wrap,
                                      options.jumps)
    for k, value in enumerate(times.values):
        if value is None:
            rows.table.bad.append((rows.lines[k], f'{columns.time_name}: {rows.texts[k][:30]!r} is '
                                   'not a time'))
    rows.table.bad += [(rows.lines[k], f'{columns.time_name}: {rows.texts[k][:30]!r} is far from '
                        'the times before and after') for k in ordered.outliers]
    rows.table.check_bad_rows(len(ordered.rows))
    keys = [rows.keys[k] for k in ordered.rows]
    stamps = times.stamps(ordered.values)
    low, high = min(stamps, default=0), max(stamps, default=0)
    if low < 0 and high - low < MAX_RELATIVE_NS:
        # The origin of such times is a trigger or the overflow of a signed counter.
        stamps = [stamp - low for stamp in stamps]
        times.notes.append(f'times from {low / NS:.6g} s, shifted to 0')
    for k, stamp in zip(ordered.rows, stamps, strict=True):
        table_times.check_range(where, rows.lines[k], stamp)
    if options.rate is None:
        table_times.check_resolution(where, rows.texts, ordered.values, keys)
    else:
        stamps = _at_rate(keys, stamps, options.rate)
    return stamps, ordered.session, ordered.rows, times.notes + ordered.notes


def _at_rate(keys: Sequence[int], stamps: Sequence[int], rate: float) -> list[int]:
    """Timestamps at a constant rate from the first timestamp of each sensor."""
    first: dict[int, int] = {}
    n: Counter[int] = Counter()
    out = []
    for key, stamp in zip(keys, stamps, strict=True):
        out.append(first.setdefault(key, stamp) + round(n[key] * NS / rate))
        n[key] += 1
    return out


def _sessions(rows: _Rows, stamps: Sequence[int], session: Sequence[int], order: Sequence[int]
              ) -> list[Readings]:
    """Divide the readings into sessions, each in chronological order."""
    fields = np.frombuffer(rows.fields).reshape(-1, 3)
    place = {k: (stamp, s) for k, stamp, s in zip(order, stamps, session, strict=True)}
    out = []
    for s in range(max(session, default=0) + 1):
        chosen = [i for i, (k, _) in enumerate(rows.names) if k in place and place[k][1] == s]
        if chosen:
            times = [place[rows.names[i][0]][0] for i in chosen]
            readings = Readings.by_name([rows.names[i][1] for i in chosen], times, fields[chosen])
            out.append(readings.part(np.argsort(times, kind='stable')))
    return out


def import_field_table(table: FilePath, options: TableOptions, out: FilePath
                       ) -> tuple[list[Path], FieldTable]:
    """Import a table to the folder `out`, or, if the clock restarts, to `session_1`, ... in it."""
    content = read_field_table(table, options)
    recordings = []
    for k, readings in enumerate(content.sessions):
        folder = Path(out) / f'session_{k + 1}' if len(content.sessions) > 1 else Path(out)
        recordings.append(folder / f'{Path(table).stem}.mcap')
        with RecordingWriter(recordings[-1]) as writer:
            for (name, message), stamp in zip(
                    magnetic_field_dicts(readings), readings.stamp_ns.tolist(), strict=True):
                writer.write(f'/{name}/imu/mag', MAGNETIC_FIELD, message, stamp)
    return recordings, content


def describe(readings: Readings) -> list[str]:
    """Lines with number, rate, gaps and median field of each sensor's readings, and warnings."""
    out, magnitudes = [], []
    spans: dict[str, tuple[int, int]] = {}
    begin = int(readings.stamp_ns.min())
    for k, name in enumerate(readings.names):
        own = readings.part(readings.sensor == k)
        if not len(own):
            continue
        steps = np.diff(own.stamp_ns)
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        gaps = np.flatnonzero(steps > table_times.MAX_STEPS * step)
        longest = gaps[np.argmax(steps[gaps])] if len(gaps) else 0
        rate = f'{NS / step:.4g} Hz' if step else 'no rate'
        gap_text = (f'{quantity(len(gaps), "gap")}, longest '
                    f'{table_times.span_text(steps[longest] / NS)} at '
                    f'{(own.stamp_ns[longest] - begin) / NS:.6g} s' if len(gaps) else 'no gaps')
        line = f'/{name}/imu/mag  {quantity(len(own), "reading")}, {rate}, {gap_text}'
        if not np.isnan(own.field).all(axis=0).any():
            magnitudes.append(float(np.nanmedian(np.linalg.norm(own.field, axis=1))))
            line += f', median field {1e6 * magnitudes[-1]:.4g} uT'
        out.append(line)
        spans[name] = int(own.stamp_ns[0]), int(own.stamp_ns[-1])
    last, first = max(spans, key=lambda n: spans[n][0]), min(spans, key=lambda n: spans[n][1])
    if spans[last][0] > spans[first][1]:
        out.append(f'warning: the readings of {last} begin after those of {first} have ended; the '
                   'clocks of the sensors may differ')
    if magnitudes and not any(USUAL_FIELD_T[0] <= m <= USUAL_FIELD_T[1] for m in magnitudes):
        out.append(f'warning: the median field is {1e6 * magnitudes[0]:.4g} uT, but the Earth\'s '
                   'field is 20 to 70 uT; check --unit (for raw counts, such as --unit 1090/G)')
    return out
