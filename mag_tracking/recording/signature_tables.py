"""Labelled signatures in CSV, labelled intervals of a recording, and trained classes in JSON.

A table of signatures has one row per sample (`label`, `signature`, `time_s` and fields) or one row
per signature (`label`, and the samples in order). A table of intervals has `label`, `begin_s` and
`end_s` (or `begin_ns` and `end_ns`), and optionally `sensor`.
"""

import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, fields
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from mag_tracking.analysis.signature import Signature
from mag_tracking.analysis.signature_classifier import VERSION, SignatureModel
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import LabelsError, RecordingError
from mag_tracking.files import checked_path, replace_text
from mag_tracking.recording.table_text import CsvTable, FilePath, number, read_csv
from mag_tracking.units import NS

LABEL, TIME, PASS = 'label', 'time_s', 'pass'
MIN_EPOCH_S = 1e8
"""Larger times [s] are measured from 1970, smaller times from the first reading."""
MAX_TIME_S = 1e11
UNITS = {'t': 1.0, 'ut': 1e-6, 'nt': 1e-9}
"""Tesla per unit, by suffix of the column."""

_VERSION_ENTRY = 'mag_tracking.classes'
_Entry: TypeAlias = tuple[str, Callable[[Any], bool], Callable[[Any], Any]]
_NUMBER: _Entry = ('a number', lambda v: isinstance(v, (int, float)) and not isinstance(v, bool),
                   float)
_TEXT: _Entry = ('a string', lambda v: isinstance(v, str), str)
_NAMES: _Entry = ('a list of names', lambda v: isinstance(v, list) and all(
    isinstance(name, str) for name in v), tuple)
_ENTRIES: dict[str, _Entry] = {
    'temperature': _NUMBER, 'limit': _NUMBER, 'method': _TEXT, 'unit': _TEXT, 'classes': _NAMES,
    'axes': _NAMES, 'examples': ('a mapping from classes to numbers', lambda v: isinstance(
        v, dict) and all(isinstance(n, int) for n in v.values()), dict)}
"""Entries of a model file, except arrays: (expected value, its test, its conversion)."""
_AXIS_COLUMN = re.compile(r'b?(?P<axis>[xyz])(_(?P<unit>t|ut|nt))?')
_SAMPLE_COLUMN = re.compile(r'b?(?P<axis>[xyz])(_(?P<unit>t|ut|nt))?_?(?P<number>\d+)')


class LabelledInterval(NamedTuple):
    """An interval of a recording in which one target passed."""

    begin_ns: int
    end_ns: int
    label: str
    sensor: str
    """Name of the sensor. Empty for all sensors."""
    row: int


def read_signatures(path: FilePath, is_labelled: bool = True) -> list[Signature]:
    """Read the signatures of a table; raises LabelsError if it is inconsistent."""
    table = read_csv(path)
    if LABEL not in table.header and is_labelled:
        raise LabelsError(f'{path}: column {LABEL!r} is missing; the columns are '
                          f'{", ".join(table.header)}')
    return _read_by_sample(table) if TIME in table.header else _read_by_row(table)


def _read_by_sample(table: CsvTable) -> list[Signature]:
    """Read a table with one row per sample, whose remaining columns identify the signature."""
    path, header = table.path, table.header
    axes = {name: match for name in header if (match := _AXIS_COLUMN.fullmatch(name.lower()))}
    names = [name for name in header if name not in (*axes, LABEL, TIME, PASS)]
    if not axes:
        raise LabelsError(f'{path}: no column contains a field; expected x, y, z (or x_nt, ...)')
    if not names:
        raise LabelsError(f'{path}: no column identifies the signatures; expected a column '
                          'such as \'signature\'')
    fields = _Fields(path, [(m['axis'], m['unit'] or '', [name]) for name, m in axes.items()])
    found: dict[tuple[str, ...], list[tuple[int, dict[str, str]]]] = {}
    for line, cells in table.by_name():
        found.setdefault(tuple(cells[n] for n in names), []).append((line, cells))
    out = []
    for key, rows in found.items():
        source = f'{path}: signature {" ".join(key)}'
        label, group = (_unique_value(source, column, rows) for column in (LABEL, PASS))
        t = np.array([number(path, line, TIME, cells[TIME], True) for line, cells in rows])
        field = np.array([fields.parse_row(line, cells)[0] for line, cells in rows])
        out.append(fields.signature(t, field, label, source, group))
    if len(out) > 1 and all(len(s.t) == 1 for s in out):
        raise LabelsError(f'{path}: each signature has only one sample; the columns '
                          f'{", ".join(names)} were treated as names of signatures')
    return out


def _unique_value(source: str, column: str, rows: list[tuple[int, dict[str, str]]]) -> str:
    """Value of all rows in a column, '' if it is missing; raises LabelsError if they differ."""
    values = sorted({cells.get(column, '').strip() for _, cells in rows})
    if len(values) > 1:
        raise LabelsError(f'{source} has several values of {column}: {", ".join(values)}')
    return values[0]


def _read_by_row(table: CsvTable) -> list[Signature]:
    """Read a table with one row per signature and its samples in columns x0, x1, ..., y0, ..."""
    path = table.path
    axes: dict[tuple[str, str], list[tuple[int, str]]] = {}
    for name in table.header:
        if match := _SAMPLE_COLUMN.fullmatch(name.lower()):
            axes.setdefault((match['axis'], match['unit'] or ''), []).append(
                (int(match['number']), name))
    for found in axes.values():
        numbers = sorted(n for n, _ in found)
        if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            raise LabelsError(f'{path}: the columns {found[0][1]}, ... are not numbered '
                              'consecutively')
    if not axes or len({len(found) for found in axes.values()}) > 1:
        raise LabelsError(f'{path}: expected numbered columns of samples, the same number for each '
                          f'axis (x0, x1, ..., y0, y1, ...), or a column {TIME}')
    fields = _Fields(path, [(axis, unit, [name for _, name in sorted(found)])
                            for (axis, unit), found in axes.items()])
    out = []
    for line, cells in table.by_name():
        field = fields.parse_row(line, cells)
        out.append(fields.signature(np.arange(len(field), dtype=float), field,
                                    cells.get(LABEL, '').strip(), f'{path}: row {line}',
                                    cells.get(PASS, '').strip()))
    return out


class _Fields:
    """Field columns of a table, [(axis, unit, names)]; raises LabelsError if inconsistent."""

    def __init__(self, path: FilePath, columns: list[tuple[str, str, list[str]]]) -> None:
        columns = sorted(columns)
        for (axis, _, _), (following, _, _) in pairwise(columns):
            if axis == following:
                raise LabelsError(f'{path}: several columns contain the axis {axis}')
        units = [unit for _, unit, _ in columns if unit]
        if units and len(units) < len(columns):
            raise LabelsError(f'{path}: only some fields have a unit (_t, _ut or _nt)')
        self._path, self._columns, self._unit = path, columns, 'T' if units else ''

    def parse_row(self, line: int, cells: dict[str, str]) -> FloatArray:
        """Parse the field samples in a row of the table; return an array (n, n_axes)."""
        return np.array([[number(self._path, line, name, cells[name], False)
                          * UNITS.get(unit, 1.0) for name in names]
                         for _, unit, names in self._columns]).T

    def signature(self, t: FloatArray, field: FloatArray, label: str, source: str,
                  group: str) -> Signature:
        """Create a signature; omit unmeasured axes, and incomplete samples at both ends."""
        measured = np.flatnonzero(~np.isnan(field).all(axis=0))
        field = field[:, measured]
        complete = np.flatnonzero(~np.isnan(field).any(axis=1)) if len(measured) else measured
        inner = slice(complete[0], complete[-1] + 1) if len(complete) else slice(0, 0)
        axes = tuple(self._columns[k][0] for k in measured.tolist())
        return Signature(t[inner], field[inner], label, source, axes, self._unit, group or source)


def read_intervals(path: FilePath, first_ns: int) -> list[LabelledInterval]:
    """Read the labelled intervals of a recording whose first reading is at `first_ns`; raises
    LabelsError if they are inconsistent."""
    table = read_csv(path)
    unit = 'ns' if 'begin_ns' in table.header else 's'
    missing = [n for n in (LABEL, f'begin_{unit}', f'end_{unit}') if n not in table.header]
    if missing:
        raise LabelsError(f'{path}: missing columns: {", ".join(missing)}; the columns are '
                          f'{", ".join(table.header)}')
    out = []
    for line, cells in table.by_name():
        begin, end = (_stamp(path, line, f'{name}_{unit}', cells, first_ns)
                      for name in ('begin', 'end'))
        if end <= begin:
            raise LabelsError(f'{path}: row {line}: the interval must end after it begins')
        if not cells[LABEL].strip():
            raise LabelsError(f'{path}: row {line}: the label is empty')
        out.append(LabelledInterval(begin, end, cells[LABEL].strip(),
                                    cells.get('sensor', '').strip(), line))
    _check_overlaps(path, out)
    return out


def _stamp(path: FilePath, line: int, column: str, cells: dict[str, str], first_ns: int) -> int:
    """Convert a cell to ns since 1970; small times [s] are relative to `first_ns`."""
    value = number(path, line, column, cells[column], True)
    if abs(value) > (MAX_TIME_S * NS if column.endswith('_ns') else MAX_TIME_S):
        raise LabelsError(f'{path}: row {line}: {column} is not a valid time')
    if column.endswith('_ns'):
        # A float cannot represent nanoseconds since 1970 exactly.
        return int(cells[column]) if cells[column].strip().isdigit() else int(value)
    return round(value * NS) + (0 if value > MIN_EPOCH_S else first_ns)


def _check_overlaps(path: FilePath, intervals: list[LabelledInterval]) -> None:
    ordered = sorted(intervals, key=lambda i: i.begin_ns)
    for k, first in enumerate(ordered):
        for second in ordered[k + 1:]:
            if second.begin_ns >= first.end_ns:
                break
            if first.sensor == second.sensor or '' in (first.sensor, second.sensor):
                raise LabelsError(f'{path}: the intervals in rows {first.row} and {second.row} '
                                  'overlap: a signature must contain only one target')


def write_model(path: FilePath, model: SignatureModel) -> None:
    """Write a trained model as JSON."""
    content = {name: value.tolist() if isinstance(value, np.ndarray) else value
               for name, value in asdict(model).items()}
    replace_text(path, json.dumps({_VERSION_ENTRY: VERSION, **content}, indent=1) + '\n')


def read_model(path: FilePath) -> SignatureModel:
    """Read a model written by `write_model`; raises RecordingError for another version."""
    path = checked_path(path, RecordingError)
    try:
        with open(path, encoding='utf-8') as stream:
            content = json.load(stream)
        if isinstance(content, dict) and content.get(_VERSION_ENTRY, VERSION) != VERSION:
            raise RecordingError(f'{path}: format version {content[_VERSION_ENTRY]} is not '
                                 f'supported; expected {VERSION}')
        return _parse_model(content)
    except OSError as error:
        raise RecordingError(f'cannot read {path}: {error.strerror}') from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RecordingError(f'{path} is not a valid file of trained classes: '
                             'it is not valid JSON') from error
    except ValueError as error:
        raise RecordingError(f'{path} is not a valid file of trained classes: {error}') from error


def _parse_model(content: Any) -> SignatureModel:
    if not isinstance(content, dict):
        raise ValueError('expected a mapping of entries')
    names = [field.name for field in fields(SignatureModel)]
    for name in (_VERSION_ENTRY, *names):
        if name not in content:
            raise ValueError(f'the entry {name!r} is missing')
    for name in content:
        if name not in (_VERSION_ENTRY, *names):
            raise ValueError(f'unknown entry {name!r}')
    model = SignatureModel(**{name: _parse_entry(name, content[name]) for name in names})
    _check_model(model)
    return model


def _parse_entry(name: str, value: Any) -> Any:
    """Convert an entry of a model file to the type of its field; raise ValueError if invalid."""
    expected, is_valid, convert = _ENTRIES.get(name, (
        'a list of numbers', lambda v: isinstance(v, list), partial(np.array, dtype=float)))
    with suppress(ValueError, TypeError, OverflowError):
        if is_valid(value):
            return convert(value)
    raise ValueError(f'{name}: expected {expected}')


def _check_model(model: SignatureModel) -> None:
    n, k = len(model.mean), len(set(model.classes))
    if k < 2 or k < len(model.classes):
        raise ValueError('classes: expected at least two different names')
    if not n:
        raise ValueError('mean: expected at least one number')
    shapes = {'mean': (n,), 'scale': (n,), 'weights': (k, n), 'offsets': (k,), 'centres': (k, n),
              'precision': (n, n)}
    for name, shape in shapes.items():
        values = getattr(model, name)
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f'{name}: expected finite numbers of shape {shape}, since there are '
                             f'{k} classes, and mean has length {n}')
    for name in ('temperature', 'limit'):
        if not 0.0 < getattr(model, name) < np.inf:
            raise ValueError(f'{name}: expected a positive number')
    if not (model.scale > 0.0).all():
        raise ValueError('scale: expected positive numbers')
