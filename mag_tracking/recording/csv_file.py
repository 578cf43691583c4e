"""CSV files: lines, header, numbers, and errors that name the place."""

import csv
from os import PathLike
from typing import TypeAlias

import numpy as np

from mag_tracking.errors import RecordingError
from mag_tracking.files import checked_path

CsvPath: TypeAlias = str | PathLike[str]
Lines: TypeAlias = list[tuple[int, list[str]]]
"""Number of each line, and its cells."""


def read_csv(path: CsvPath) -> tuple[list[str], Lines]:
    """Header and rows of a CSV file; raises RecordingError, which names file and row."""
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
    """The lines that are not empty; raises RecordingError."""
    path = checked_path(path, RecordingError)
    try:
        with open(path, newline='', encoding='utf-8-sig') as stream:
            reader = csv.reader(stream)
            return [(reader.line_num, row) for row in reader if row]
    except OSError as error:
        raise RecordingError(f'cannot read {path}: {error.strerror}') from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f'{path}: {error}') from error


def number(path: CsvPath, line: int, column: str, text: str, finite: bool) -> float:
    """One cell as a number, NaN where it is empty and that is allowed; raises RecordingError."""
    try:
        value = float(text) if text.strip() else np.nan
    except ValueError:
        raise RecordingError(f'{path}: row {line}: {column} is {text!r}, no number') from None
    if np.isinf(value) or (finite and np.isnan(value)):
        raise RecordingError(f'{path}: row {line}: {column} is not a finite number')
    return value
