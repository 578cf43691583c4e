"""Reading of CSV files, with error messages that name the file and the row."""

import csv
from os import PathLike
from typing import TypeAlias

import numpy as np

from mag_tracking.errors import RecordingError
from mag_tracking.files import checked_path

CsvPath: TypeAlias = str | PathLike[str]
Lines: TypeAlias = list[tuple[int, list[str]]]
"""Line number and cells of each line that is not empty."""


def read_csv(path: CsvPath) -> tuple[list[str], Lines]:
    """Read header and rows of a CSV file.

    Parameters
    ----------
    path : path_like

    Returns
    -------
    header : list of str
    rows : list of (int, list of str)
        Line number and cells.

    Raises
    ------
    RecordingError
        If the file cannot be read, has no rows, or a row has a wrong number of columns.
    """
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
    """Read the non-empty lines of a CSV file.

    Parameters
    ----------
    path : path_like

    Returns
    -------
    list of (int, list of str)
        Line number and cells.

    Raises
    ------
    RecordingError
        If the file cannot be read.
    """
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
    """Convert a cell to a number.

    Parameters
    ----------
    path : path_like
    line : int
        Line number, for error messages.
    column : str
        Name of the column, for error messages.
    text : str
        Content of the cell.
    finite : bool
        Whether an empty or NaN cell is an error.

    Returns
    -------
    float
        NaN for an empty or NaN cell.

    Raises
    ------
    RecordingError
        If the cell is not a number, is infinite, or is empty or NaN although `finite` is true. The
        message names file, row and column.
    """
    try:
        value = float(text) if text.strip() else np.nan
    except ValueError:
        raise RecordingError(f'{path}: row {line}: {column} is {text!r}, not a number') from None
    if np.isinf(value) or (finite and np.isnan(value)):
        raise RecordingError(f'{path}: row {line}: {column} is not a finite number')
    return value
