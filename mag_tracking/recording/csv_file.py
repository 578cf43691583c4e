"""Reading of CSV files, with error messages that name the file and the row."""

from collections.abc import Sequence
from os import PathLike
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.recording.table_text import (
    find_decimal,
    is_number,
    plain_number,
    read_text,
    split_line,
)

CsvPath: TypeAlias = str | PathLike[str]
Lines: TypeAlias = list[tuple[int, list[str]]]
"""Line number and cells of each line that is not empty."""


def read_csv(path: CsvPath) -> tuple[list[str], Lines]:
    """Header and numbered rows of a CSV file; raises RecordingError if a row is too long or
    short."""
    lines = csv_lines(path)
    if len(lines) < 2:
        raise RecordingError(f'{path} has no rows')
    header = [name.strip() for name in lines[0][1]]
    for line, row in lines[1:]:
        if len(row) != len(header):
            raise RecordingError(f'{path}: row {line}: expected {len(header)} columns, '
                                 f'got {len(row)}')
    return header, lines[1:]


def csv_lines(path: CsvPath) -> Lines:
    """Non-empty lines of a CSV file as (line number, cells).

    Tabs, semicolons, bars and white space also separate cells. Decimal commas, which need one of
    them, become points.
    """
    lines, _ = read_text(path)
    first = next((line for line in lines if line.strip() and not line.startswith('#')), '')
    separator = next((c for c in '\t;|,' if c in first), ' ' if len(first.split()) > 1 else ',')
    rows = [(k + 1, split_line(line, separator)) for k, line in enumerate(lines) if line.strip()]
    if separator == ',' or find_decimal((c for _, row in rows for c in row), separator) != ',':
        return rows
    return [(line, [plain_number(cell, ',') if is_number(cell) else cell for cell in row])
            for line, row in rows]


def read_numbers(path: CsvPath, columns: Sequence[str]) -> FloatArray:
    """Read a CSV file of numbers without a header as an (n, len(columns)) array; # begins a
    comment."""
    rows = [(line, row) for line, row in csv_lines(path) if not row[0].startswith('#')]
    if not rows:
        raise RecordingError(f'{path} has no rows')
    for line, row in rows:
        if len(row) != len(columns):
            raise RecordingError(f'{path}: row {line}: expected {len(columns)} columns, got '
                                 f'{len(row)}')
    return np.array([[number(path, line, name, text, True)
                      for name, text in zip(columns, row, strict=True)] for line, row in rows])


def number(path: CsvPath, line: int, column: str, text: str, finite: bool) -> float:
    """Convert a cell to a number, NaN if it is empty; raises RecordingError for NaN if `finite`,
    and for infinity."""
    try:
        value = float(text) if text.strip() else np.nan
    except ValueError:
        raise RecordingError(f'{path}: row {line}: {column} is {text!r}, not a number') from None
    if np.isinf(value) or (finite and np.isnan(value)):
        raise RecordingError(f'{path}: row {line}: {column} is not a finite number')
    return value
