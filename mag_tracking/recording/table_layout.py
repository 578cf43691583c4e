"""Layout of tables of text: preamble, header line, line of units, rows, and lines between them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mag_tracking.errors import RecordingError
from mag_tracking.quantities import quantity
from mag_tracking.recording import table_text
from mag_tracking.units import field_unit, time_unit

SAMPLE_LINES = 400
MAX_BAD_FRACTION = 0.1
"""Maximum fraction of rows that may be unusable."""
_SEPARATOR_NAMES = {name: separator for separator, name in table_text.SEPARATORS.items()}


@dataclass
class Table:
    """Cells of a table of text."""

    path: Path
    header: list[str] | None
    units: list[str]
    """Cells of the line of units; empty without one."""
    header_line: int
    """Number of the header line; 0 without one."""
    rows: table_text.Lines
    separator: str
    notes: list[str]
    """What was found out: encoding, separator, header."""
    ignored: Counter[str] = field(default_factory=Counter)
    """Number of lines without readings, by kind."""
    bad: list[tuple[int, str]] = field(default_factory=list)
    """Line number and fault of each unusable row."""

    def check_bad_rows(self, n_good: int) -> None:
        """Raise the first fault as RecordingError if too many rows, or all, are unusable."""
        n, n_bad = n_good + len(self.bad), len(self.bad)
        if n_bad > MAX_BAD_FRACTION * n:
            line, fault = min(self.bad)
            others = f' ({n_bad} of {n} rows are unusable)' if n_bad > 1 else ''
            raise RecordingError(f'{self.path}: row {line}: {fault}{others}')


def read_table(path: Path, separator: str = '', header: int | None = None,
               encoding: str = '') -> Table:
    """Read a table of text; what is not given is found, or RecordingError names the option.

    `separator` may be a name in `SEPARATORS`; `header` is a line number, 0 for none.
    """
    lines, found_encoding = table_text.read_text(path, encoding)
    numbers = [k for k, line in enumerate(lines) if line.strip()]
    if not numbers:
        raise RecordingError(f'{path} has no rows')
    separator = _SEPARATOR_NAMES.get(separator, separator.replace('\\t', '\t'))
    if len(separator) > 1:
        raise RecordingError(f'--separator: expected one character or one of '
                             f'{", ".join(_SEPARATOR_NAMES)}, got {separator!r}')
    if len(numbers) < 2 and header != 0:
        raise RecordingError(f'{path} has no rows')
    # Preamble and header come first.
    sample = numbers[max(len(numbers) // 4, header != 0):]
    sample = sample[::max(1, len(sample) // SAMPLE_LINES)]
    separator = separator or table_text.find_separator([lines[k] for k in sample]) or ''
    if not separator:
        raise RecordingError(f'{path} is not a table: no separator splits line {numbers[0] + 1}, '
                             f'{lines[numbers[0]][:40]!r}; give --separator')
    n, first = _first_row(path, lines, numbers, sample, separator, header)
    above = [k for k in numbers if k < first]
    names, units, header_line = _header(lines, above, separator, n, header)
    if names is not None and header_line is not None:
        n = _checked_width(path, lines, first, separator, names, n, header_line)
    notes = [f'separator {table_text.SEPARATORS.get(separator, separator)}',
             *([] if found_encoding in ('utf-8', 'utf-8-sig') else [f'encoding {found_encoding}']),
             f'header in line {header_line + 1}' if header_line is not None else 'no header',
             *(['line of units'] if units else [])]
    table = Table(path, names, units, 0 if header_line is None else header_line + 1, [], separator,
                  notes)
    # Lines between header and rows are no preamble: a logger reports faults of its sensor there.
    between = [k for k in above if header_line is not None and k > header_line]
    n_preamble = len(above) - len(between) - (header_line is not None or bool(units))
    table.ignored.update({'preamble line': n_preamble} if n_preamble > 0 else {})
    between = [k for k in between if _header_cells(lines[k], separator) != units]
    _read_rows(table, lines, [*between, *(k for k in numbers if k >= first)], n)
    return table


def _first_row(path: Path, lines: list[str], numbers: list[int], sample: list[int],
               separator: str, header: int | None) -> tuple[int, int]:
    """Return (number of cells of a row, index of the first line with a row)."""
    if header is not None and not 0 <= header <= len(lines):
        raise RecordingError(f'--header: the file has {len(lines)} lines, got {header}')
    sampled = (table_text.split_line(lines[k], separator) for k in sample)
    widths = Counter(len(cells) for cells in sampled if _is_row(cells))
    if not widths:
        raise RecordingError(f'{path} has no rows of numbers separated by '
                             f'{table_text.SEPARATORS.get(separator, separator)}; if the separator '
                             'is another one, give --separator')
    # Lines of a preamble may outnumber the rows, but have fewer cells.
    n = max(widths, key=lambda width: width * widths[width])
    rows = ((k, table_text.split_line(lines[k], separator)) for k in numbers if k >= (header or 0))
    first = next((k for k, cells in rows if len(cells) == n and _is_row(cells)), None)
    if first is None:
        raise RecordingError(f'{path} has no rows of {n} cells after line {header}, the header')
    return n, first


def _is_row(cells: Sequence[str]) -> bool:
    """Whether at least half of the cells that are not missing are numbers or times."""
    present = [cell for cell in cells if not table_text.is_missing(cell)]
    return len(cells) > 1 and 2 * sum(map(table_text.is_value, present)) >= len(present) > 0 \
        and not cells[0].startswith(table_text.COMMENTS)


def _header(lines: list[str], above: list[int], separator: str, n: int, header: int | None
            ) -> tuple[list[str] | None, list[str], int | None]:
    """Return (names of the columns, line of units, index of the header line)."""
    candidates = [k for k in above if not _is_row(table_text.split_line(lines[k], separator))
                  ] if header is None else [k for k in above if k >= header - 1]
    if header == 0 or not candidates:
        return None, [], None
    # Messages of the logger may follow the header.
    last = max((k for k in candidates if len(_header_cells(lines[k], separator)) == n),
               default=candidates[-1])
    candidates = [k for k in candidates if k <= last]
    cells = _header_cells(lines[candidates[-1]], separator)
    if header is not None and len(candidates) == 1:
        return cells, [], candidates[0]
    units: list[str] = []
    if _is_units(cells) and len(candidates) > 1:
        units, candidates = cells, candidates[:-1]
        cells = _header_cells(lines[candidates[-1]], separator)
    if header is not None:
        return _header_cells(lines[header - 1], separator), units, header - 1
    is_comment = lines[candidates[-1]].startswith(table_text.COMMENTS)
    if len(cells) < 2 or is_comment and len(cells) != n:
        return None, units, None
    return cells, units, candidates[-1]


def _header_cells(line: str, separator: str) -> list[str]:
    """Split a header line, which may begin like a comment."""
    line = line.lstrip('#%/ ') if line.startswith(table_text.COMMENTS) else line
    return table_text.split_line(line, separator)


def _is_units(cells: Sequence[str]) -> bool:
    """Whether a line consists of units of fields and times, and of empty or other short cells."""
    units = [cell for cell in cells if field_unit(cell) and len(cell.strip('[](){} ')) > 1
             or cell.strip('[](){} ') in ('T', 'G')]
    others = [cell for cell in cells if cell not in units and not table_text.is_missing(cell)
              and not time_unit(cell) and not cell.startswith(('[', '('))]
    return bool(units) and len(others) <= len(units)


def _checked_width(path: Path, lines: list[str], first: int, separator: str, names: list[str],
                   n: int, header_line: int) -> int:
    """Compare header and rows; remove empty names at the end. Return the number of columns."""
    while names and not names[-1] and len(names) > n:
        names.pop()
    cells = table_text.split_line(lines[first], separator)
    if len(names) < n and all(table_text.is_missing(cell) for cell in cells[len(names):]):
        return len(names)
    if len(names) == n:
        return n
    message = (f'{path}: the header in line {header_line + 1} has '
               f'{quantity(len(names), "cell")}, but row {first + 1} has {n}')
    if separator == ',' and n > len(names) + 1:
        raise RecordingError(f'{message}; does it contain decimal commas? Export the table with '
                             'semicolons or tabs as separators, or with decimal points')
    raise RecordingError(f'{message}; give --header with the number of the header line (0 if it '
                         'does not name all columns, and their numbers in --columns), or another '
                         '--separator')


def _read_rows(table: Table, lines: list[str], numbers: list[int], n: int) -> None:
    """Add the rows to a table; sort out comments, repeated headers and rows of another width."""
    header = table.header
    for k in numbers:
        line = lines[k]
        if line.startswith(table_text.COMMENTS):
            table.ignored['comment line'] += 1
            continue
        cells = table_text.split_line(line, table.separator)
        if len(cells) > n and not any(cells[n:]):
            del cells[n:]
        if k == len(lines) - 1 and len(cells) == n and _is_cut(cells[-1], table.rows):
            table.ignored['incomplete last row'] += 1
        elif len(cells) == n and cells != header and cells != table.units:
            table.rows.append((k + 1, cells))
        elif header and cells[:len(header)] == header:
            table.ignored['repeated header line'] += 1
        elif table.units and cells == table.units:
            table.ignored['repeated line of units'] += 1
        elif k == numbers[-1] and len(cells) < n and table.rows:
            table.ignored['incomplete last row'] += 1
        else:
            table.bad.append((k + 1, f'{quantity(len(cells), "cell")}, expected {n}'))


def _is_cut(cell: str, rows: table_text.Lines) -> bool:
    """Whether the last cell of a file has fewer decimals than all other cells of its column."""
    is_missing = table_text.is_missing
    others = [cells[-1] for _, cells in rows if is_missing(cells[-1]) == is_missing(cell)]
    return bool(rows) and _n_decimals(cell) < min(map(_n_decimals, others), default=1)


def _n_decimals(cell: str) -> int:
    """Number of characters after the first mark of a number, exponent included."""
    return len(cell.replace(',', '.').partition('.')[2])
