"""Tables in Parquet files, with the unit and the meaning of each column.

pyarrow is imported when a table is written or read.
"""

import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mag_tracking.errors import MissingDependencyError, OutputError

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 1
"""Version of the tables. A folder with another one is refused: rows would not be comparable."""

ROWS = 5000
"""Rows that are kept in memory at once."""


class Column(NamedTuple):
    """A column of a table."""

    name: str
    kind: str
    """t: time of UTC, i: whole number, f: number, s: text, b: yes or no, C: (6, 6) row by row."""
    unit: str
    meaning: str


def columns_of(kind: str, unit: str, /, **meanings: str) -> tuple[Column, ...]:
    """Columns of the same kind and unit: {name: meaning}."""
    return tuple(Column(name, kind, unit, meaning) for name, meaning in meanings.items())


def import_pyarrow() -> Any:
    """pyarrow, with its Parquet part; raises MissingDependencyError."""
    try:
        import pyarrow.compute
        import pyarrow.parquet
    except ImportError as error:
        raise MissingDependencyError(
            'Parquet needs pyarrow: pip install "mag_tracking[archive]"') from error
    return pyarrow


def schema_of(columns: Iterable[Column]) -> 'pa.Schema':
    """Columns with their meaning and unit; raises MissingDependencyError."""
    pa = import_pyarrow()
    kinds = {'i': pa.int64(), 'f': pa.float64(), 's': pa.string(), 'b': pa.bool_(),
             't': pa.timestamp('ns', 'UTC'), 'C': pa.list_(pa.float64(), 36)}
    return pa.schema([pa.field(c.name, kinds[c.kind], metadata={'unit': c.unit, 'is': c.meaning})
                      for c in columns], metadata={'mag_tracking.schema': str(VERSION)})


class TableWriter:
    """Writes a table piece by piece; until it is complete, what was there stays.

    A context manager, left with an error it leaves nothing. Raises OutputError.
    """

    def __init__(self, path: Path, columns: Iterable[Column]) -> None:
        self._path, self._schema = path, schema_of(columns)
        # Another attempt at the same table may be going on, on a worker that was taken for lost.
        self._draft = path.with_name(f'.{secrets.token_hex(8)}.part')
        self._rows: list[Mapping[str, Any]] = []
        with self._errors_named():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = import_pyarrow().parquet.ParquetWriter(
                self._draft, self._schema, compression='zstd')

    @contextmanager
    def _errors_named(self) -> Iterator[None]:
        """Errors of the system name the file."""
        try:
            yield
        except OSError as error:
            raise OutputError(f'cannot write {self._path}: {error.strerror or error}') from error

    def add(self, row: Mapping[str, Any]) -> None:
        """Take a row; columns that it has not are null."""
        self._rows.append(row)
        if len(self._rows) >= ROWS:
            self._flush()

    def add_table(self, table: 'pa.Table') -> None:
        """Take many rows."""
        self._flush()
        with self._errors_named():
            self._writer.write_table(table)

    def _flush(self) -> None:
        """Write the rows."""
        rows, self._rows = self._rows, []
        if rows:
            # A path need not be UTF-8, and Parquet has no other text.
            rows = [{name: value.encode(errors='backslashreplace').decode()
                     if isinstance(value, str) else value for name, value in row.items()}
                    for row in rows]
            with self._errors_named():
                self._writer.write_table(
                    import_pyarrow().Table.from_pylist(rows, self._schema))

    def __enter__(self) -> 'TableWriter':
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._flush()
            with self._errors_named():
                self._writer.close()
                if kind is None:
                    self._draft.replace(self._path)
        finally:
            self._draft.unlink(missing_ok=True)
