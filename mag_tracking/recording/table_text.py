"""Text of tables: encoding, separator, decimal mark, and the cells of CSV files."""

import codecs
import csv
import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from os import PathLike
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.files import checked_path
from mag_tracking.recording.file_kind import binary_kind

FilePath: TypeAlias = str | PathLike[str]
Lines: TypeAlias = list[tuple[int, list[str]]]
"""Line number and cells of each line that is not empty."""
SEPARATORS = {'\t': 'tab', ';': 'semicolon', '|': 'bar', ',': 'comma', ' ': 'spaces'}
"""Names of the separators that are recognised. White space of any length is one separator."""
COMMENTS = ('#', '%', '//')
_MARKS = ((codecs.BOM_UTF8, 'utf-8-sig'), (codecs.BOM_UTF32_LE, 'utf-32'),
          (codecs.BOM_UTF32_BE, 'utf-32'), (codecs.BOM_UTF16_LE, 'utf-16'),
          (codecs.BOM_UTF16_BE, 'utf-16'))
_RECORDINGS = (b'\x89MCAP', b'SQLite format', b'#ROSBAG')
_NUMBER = re.compile(r"[+-]?(?:[0-9][0-9.,'\u2019\u00a0\u202f]*|[.,][0-9]+)(?:[eE][+-]?[0-9]+)?"
                     ).fullmatch
_TIME = re.compile(r'[0-9](?=.*[-:/.].*)[0-9TZ:.,/+ apmAPMUTCG-]+|[0-9]{1,2}[ -][A-Za-z]{3,9}[ -].*'
                   ).fullmatch
_DATE = re.compile(r'[0-9]{1,4}\.[0-9]{1,2}\.(?:[0-9]{2}){0,2}').fullmatch
_MISSING = frozenset(('', '-', '--', 'nan', '-nan', '+nan', 'na', 'n/a', '#n/a', 'null', 'none',
                      'nat', '<na>'))
_GROUPING = str.maketrans('', '', "'\u2019\u00a0\u202f ")
_COMMA_DECIMALS = re.compile(
    r'[+-]?(?:[0-9]*,(?:[0-9]{1,2}|[0-9]{4,})|0+,[0-9]+|[0-9]{4,},[0-9]+|[0-9.]+\.[0-9]{3},[0-9]+)'
    r'(?:[eE][+-]?[0-9]+)?').fullmatch
_POINT_DECIMALS = re.compile(
    r'[+-]?(?:[0-9]*\.(?:[0-9]{1,2}|[0-9]{4,})|0+\.[0-9]+|[0-9]{4,}\.[0-9]+|[0-9,]+,[0-9]{3}\.'
    r'[0-9]+)(?:[eE][+-]?[0-9]+)?|[+-]?[0-9]{1,3}(?:,[0-9]{3}){2,}').fullmatch


def read_text(path: FilePath, encoding: str = '') -> tuple[list[str], str]:
    """Lines (without ends and NUL) and encoding of a text file; raises RecordingError if binary."""
    path = checked_path(path, RecordingError)
    try:
        data, kind = path.read_bytes(), binary_kind(path)
    except OSError as error:
        raise RecordingError(f'cannot read {path}: {error.strerror}') from error
    if data.startswith(_RECORDINGS):
        kind = 'a recording, which needs no import'
    if kind:
        raise RecordingError(f'{path} is not a table of text but {kind}')
    encoding = encoding or _encoding_of(data)
    try:
        text = data.decode(encoding)
    except (LookupError, UnicodeError) as error:
        raise RecordingError(f'{path}: the encoding is not {encoding}: {error}; give another '
                             '--encoding') from error
    control = sum(text.count(c) for c in map(chr, (*range(1, 9), *range(14, 27))))
    if control > 0.01 * len(text):
        raise RecordingError(f'{path} is not a table of text: it contains {control} control '
                             'characters')
    return text.replace('\0', '').replace('\r\n', '\n').replace('\r', '\n').split('\n'), encoding


def _encoding_of(data: bytes) -> str:
    """Encoding by a byte order mark, UTF-16 by its zero bytes, UTF-8, or else Windows-1252."""
    for mark, name in _MARKS:
        if data.startswith(mark):
            return name
    begin = data[:4000]
    for first, name in ((1, 'utf-16-le'), (0, 'utf-16-be')):
        # The upper bytes of Latin characters are zero, the lower bytes are not.
        if len(begin) > 3 and begin[first::2].count(0) > 0.9 * (len(begin) // 2) \
                and begin[1 - first::2].count(0) < 0.1 * len(begin):
            return name
    for name in ('utf-8', 'cp1252'):
        with suppress(UnicodeDecodeError):
            data.decode(name)
            return name
    return 'latin-1'


def split_line(line: str, separator: str) -> list[str]:
    """Split a line into stripped cells; a blank separates by white space of any length."""
    if '"' in line:
        try:
            # The line may end within quotes, so strictness is left to the number of cells.
            row = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
        except (csv.Error, StopIteration):
            return [line]
        return [cell.strip() for cell in row if cell or separator != ' ']
    if separator == ' ':
        return line.split()
    return [cell.strip() for cell in line.split(separator)]


def find_separator(lines: Sequence[str]) -> str | None:
    """Separator that splits most lines into equal numbers of numbers and times, or None."""
    best: tuple[float, str | None] = (0.0, None)
    for separator in SEPARATORS:
        rows = [split_line(line, separator) for line in lines]
        n, frequency = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        if n < 2:
            continue
        cells = [cell for row in rows if len(row) == n for cell in row]
        score = frequency / len(rows) * sum(map(is_value, cells)) / len(cells)
        if score > best[0] + 1e-9:
            best = score, separator
    return best[1]


def is_value(cell: str) -> bool:
    """Whether a cell is a number or a time, or missing."""
    return is_missing(cell) or bool(_NUMBER(cell) or _TIME(cell)) or cell.lower() in (
        'inf', '-inf', 'infinity')


def is_number(cell: str) -> bool:
    """Whether a cell is a number with any decimal mark."""
    return bool(_NUMBER(cell))


def is_missing(cell: str) -> bool:
    """Whether a cell is empty or a usual mark of a missing value."""
    return cell.lower() in _MISSING


def find_decimal(cells: Iterable[str], separator: str) -> str:
    """Decimal mark of numbers, '.' or ','; empty if they fit both or contradict each other."""
    marked = {cell for cell in cells if (',' in cell or '.' in cell) and _NUMBER(cell)
              and not _DATE(cell)}
    if not any(',' in cell for cell in marked):
        return '.'
    comma = any(map(_COMMA_DECIMALS, marked))
    point = any(map(_POINT_DECIMALS, marked))
    if comma != point:
        return ',' if comma else '.'
    # 1,234 alone may be 1234 or 1.234. Spreadsheets write semicolons where the decimal mark is a
    # comma.
    return ',' if separator == ';' and not point and not any('.' in c for c in marked) else ''


def parse_number(cell: str, decimal: str = '.') -> float:
    """Convert a cell to a number, NaN if missing; raises ValueError with a phrase like "is 'b', not
    a number", also for infinity."""
    try:
        # The most frequent case; float also accepts '1_000' and a word for infinity.
        value = float(plain_number(cell, decimal))
    except ValueError:
        if is_missing(cell):
            return math.nan
        raise ValueError(f'is {cell[:40]!r}, not a number') from None
    if math.isinf(value) or '_' in cell:
        raise ValueError('is infinite' if math.isinf(value) else f'is {cell[:40]!r}, not a number')
    return value


def plain_number(cell: str, decimal: str) -> str:
    """Write a number with a decimal point and without grouping."""
    if decimal == ',' and ('.' in cell or ',' in cell):
        cell = cell.replace('.', '').replace(',', '.')
    elif ',' in cell:
        cell = cell.replace(',', '')
    return cell if cell.isascii() and "'" not in cell and ' ' not in cell \
        else cell.translate(_GROUPING)


class CsvTable(NamedTuple):
    """Cells of a CSV file."""

    path: FilePath
    header: Sequence[str]
    rows: Lines

    def by_name(self) -> list[tuple[int, dict[str, str]]]:
        """Line number, and cells by column, of each row."""
        return [(line, dict(zip(self.header, row, strict=True))) for line, row in self.rows]

    def numbers(self, names: Sequence[str], optional: Collection[str] = ()) -> FloatArray:
        """Values (n, len(names)) of columns, NaN if empty in the columns `optional`; raises
        RecordingError if a column is missing or a cell is not a number."""
        for name in names:
            if name not in self.header:
                raise RecordingError(f'{self.path}: column {name} is missing')
        indices = [self.header.index(name) for name in names]
        return np.array([[number(self.path, line, name, row[j], name not in optional)
                          for name, j in zip(names, indices, strict=True)]
                         for line, row in self.rows])


def read_csv(path: FilePath, header: Sequence[str] = ()) -> CsvTable:
    """Read a CSV file; raises RecordingError if a row is too long or short.

    If `header` names the columns, the file has no header, and # begins a comment line.
    """
    lines = _csv_lines(path)
    if header:
        lines = [(line, row) for line, row in lines if not row[0].startswith('#')]
    elif lines:
        header, lines = [name.strip() for name in lines[0][1]], lines[1:]
    if not lines:
        raise RecordingError(f'{path} has no rows')
    for line, row in lines:
        if len(row) != len(header):
            raise RecordingError(f'{path}: row {line}: expected {len(header)} columns, '
                                 f'got {len(row)}')
    return CsvTable(path, header, lines)


def _csv_lines(path: FilePath) -> Lines:
    """Non-empty lines of a CSV file as (line number, cells); tabs, semicolons, bars and white space
    also separate cells, and permit decimal commas, which become points."""
    lines, _ = read_text(path)
    first = next((line for line in lines if line.strip() and not line.startswith('#')), '')
    separator = next((c for c in '\t;|,' if c in first), ' ' if len(first.split()) > 1 else ',')
    rows = [(k + 1, split_line(line, separator)) for k, line in enumerate(lines) if line.strip()]
    if separator == ',' or find_decimal((c for _, row in rows for c in row), separator) != ',':
        return rows
    return [(line, [plain_number(cell, ',') if is_number(cell) else cell for cell in row])
            for line, row in rows]


def number(path: FilePath, line: int, column: str, text: str, finite: bool) -> float:
    """Convert a cell to a number, NaN if it is empty; raises RecordingError for NaN if `finite`,
    and for infinity."""
    try:
        value = float(text) if text.strip() else np.nan
    except ValueError:
        raise RecordingError(f'{path}: row {line}: {column} is {text!r}, not a number') from None
    if np.isinf(value) or (finite and np.isnan(value)):
        raise RecordingError(f'{path}: row {line}: {column} is not a finite number')
    return value
