"""Labelled signatures in CSV, labelled intervals of a recording, and trained classes in JSON.

A table of signatures has a row for each sample (`label`, `signature`, `time_s`, and fields) or for
each signature (`label`, and its samples in order). A table of intervals has `label`, `begin_s` and
`end_s` (or `begin_ns` and `end_ns`), and maybe `sensor`.
"""

import json
import re
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.analysis.signature import Signature
from mag_tracking.analysis.signature_classifier import VERSION, SignatureModel
from mag_tracking.errors import LabelsError, RecordingError
from mag_tracking.files import checked_path, replace_text
from mag_tracking.recording.csv_file import Lines, number, read_csv
from mag_tracking.units import NS

LABEL, TIME = 'label', 'time_s'
EPOCH_S = 1e8
"""Seconds that are larger are since 1970, others since the first reading."""

_SAMPLE = re.compile(r'(?P<axis>.*?)_?(?P<number>\d+)')


@dataclass(frozen=True)
class LabelledInterval:
    """A stretch of a recording in which one target passed."""

    begin_ns: int
    end_ns: int
    label: str
    sensor: str
    """Empty: all sensors."""
    row: int
    """Of the table."""


def read_signatures(path: str | PathLike[str], is_labelled: bool = True) -> list[Signature]:
    """The signatures of a table; `is_labelled`: without labels it is of no use.

    Raises
    ------
    RecordingError
        If the table cannot be read.
    LabelsError
        If it has no labels, or a signature has several.
    """
    header, lines = read_csv(path)
    if LABEL not in header and is_labelled:
        raise LabelsError(f'{path}: there is no column {LABEL!r}; there are {", ".join(header)}')
    return _by_sample(path, header, lines) if TIME in header else _by_row(path, header, lines)


def _by_sample(path: str | PathLike[str], header: list[str], lines: Lines) -> list[Signature]:
    """Signatures with a row for each sample; the other columns name the signature."""
    axes = [name for name in header if re.fullmatch(r'[xyz](_.*)?|b[xyz](_.*)?', name.lower())]
    names = [name for name in header if name not in (*axes, LABEL, TIME)]
    if not axes:
        raise LabelsError(f'{path}: no column is a field; expected x, y, z (or x_nt and so on)')
    if not names:
        raise LabelsError(f'{path}: no column tells one signature from the next; expected one '
                          'such as signature')
    found: dict[tuple[str, ...], list[tuple[int, list[str]]]] = {}
    for line, row in lines:
        cells = dict(zip(header, row, strict=True))
        found.setdefault(tuple(cells[n] for n in names), []).append((line, row))
    out = []
    for key, rows in found.items():
        cells_of = [dict(zip(header, row, strict=True)) for _, row in rows]
        labels = sorted({cells.get(LABEL, '').strip() for cells in cells_of})
        source = f'{path}: signature {" ".join(key)}'
        if len(labels) > 1:
            raise LabelsError(f'{source} has several labels: {", ".join(labels)}')
        t = [number(path, line, TIME, c[TIME], True) for (line, _), c in
             zip(rows, cells_of, strict=True)]
        field = [[number(path, line, a, c[a], False) for a in axes] for (line, _), c in
                 zip(rows, cells_of, strict=True)]
        out.append(Signature(np.array(t), _measured(np.array(field)), labels[0], source))
    return out


def _by_row(path: str | PathLike[str], header: list[str], lines: Lines) -> list[Signature]:
    """Signatures with a row each: columns x0, x1, ... (y0, ...), or any that are numbered."""
    axes: dict[str, list[tuple[int, str]]] = {}
    for name in header:
        match = _SAMPLE.fullmatch(name)
        if name != LABEL and match:
            axes.setdefault(match['axis'], []).append((int(match['number']), name))
    columns = [[name for _, name in sorted(found)] for _, found in sorted(axes.items())]
    if not columns or len({len(c) for c in columns}) > 1:
        raise LabelsError(f'{path}: expected numbered columns of samples, as many for each axis '
                          f'(x0, x1, ..., y0, y1, ...) or a column {TIME}')
    out = []
    for line, row in lines:
        cells = dict(zip(header, row, strict=True))
        field = np.array([[number(path, line, name, cells[name], False) for name in names]
                          for names in columns]).T
        out.append(Signature(np.arange(len(field), dtype=float), _measured(field),
                             cells.get(LABEL, '').strip(), f'{path}: row {line}'))
    return out


def _measured(field: Any) -> Any:
    """The axes (n, n_axes) that were measured."""
    return field[:, ~np.isnan(field).all(axis=0)]


def read_intervals(path: str | PathLike[str], first_ns: int) -> list[LabelledInterval]:
    """The labelled intervals of a recording whose first reading is at `first_ns`.

    Raises
    ------
    RecordingError
        If the table cannot be read.
    LabelsError
        If a label is missing, an interval ends before it begins, or two overlap.
    """
    header, lines = read_csv(path)
    unit = 'ns' if 'begin_ns' in header else 's'
    missing = [n for n in (LABEL, f'begin_{unit}', f'end_{unit}') if n not in header]
    if missing:
        raise LabelsError(f'{path}: there is no column {", ".join(missing)}; there are '
                          f'{", ".join(header)}')
    out = []
    for line, row in lines:
        cells = dict(zip(header, row, strict=True))
        begin, end = (_stamp(path, line, f'{name}_{unit}', cells, first_ns)
                      for name in ('begin', 'end'))
        if end <= begin:
            raise LabelsError(f'{path}: row {line}: the interval ends before it begins')
        if not cells[LABEL].strip():
            raise LabelsError(f'{path}: row {line}: the label is empty')
        out.append(LabelledInterval(begin, end, cells[LABEL].strip(),
                                    cells.get('sensor', '').strip(), line))
    _check_overlaps(path, out)
    return out


def _stamp(path: str | PathLike[str], line: int, column: str, cells: dict[str, str],
           first_ns: int) -> int:
    """[ns] of a cell."""
    value = number(path, line, column, cells[column], True)
    if column.endswith('_ns'):
        # A float does not hold all nanoseconds since 1970.
        return int(cells[column]) if cells[column].strip().isdigit() else int(value)
    return round(value * NS) + (0 if value > EPOCH_S else first_ns)


def _check_overlaps(path: str | PathLike[str], intervals: list[LabelledInterval]) -> None:
    """Raise LabelsError where two intervals of a sensor overlap."""
    ordered = sorted(intervals, key=lambda i: i.begin_ns)
    for k, first in enumerate(ordered):
        for second in ordered[k + 1:]:
            if second.begin_ns >= first.end_ns:
                break
            if first.sensor == second.sensor or '' in (first.sensor, second.sensor):
                raise LabelsError(f'{path}: rows {first.row} and {second.row} overlap: a '
                                  'signature would hold two targets')


def write_model(path: str | PathLike[str], model: SignatureModel) -> None:
    """Write a model as JSON; raises OutputError."""
    content = {name: value.tolist() if isinstance(value, np.ndarray) else value
               for name, value in asdict(model).items()}
    replace_text(path, json.dumps({'mag_tracking.classes': VERSION, **content}, indent=1) + '\n')


def read_model(path: str | PathLike[str]) -> SignatureModel:
    """A model that `write_model` wrote; raises RecordingError."""
    path = checked_path(path, RecordingError)
    try:
        with open(path, encoding='utf-8') as stream:
            content = json.load(stream)
        version = content.pop('mag_tracking.classes')
        if version != VERSION:
            raise RecordingError(f'{path}: classes of version {version}; this reads {VERSION}')
        arrays = ('mean', 'scale', 'weights', 'offsets', 'centres', 'precision')
        content.update({name: np.array(content[name], dtype=float) for name in arrays})
        return SignatureModel(**{**content, 'classes': tuple(content['classes'])})
    except OSError as error:
        raise RecordingError(f'cannot read {path}: {error.strerror}') from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(f'{path} holds no trained classes ({error})') from error
