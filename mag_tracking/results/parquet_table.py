"""Tables in Parquet files, with unit and meaning of each column.

pyarrow is imported when a table is written or read.
"""

import math
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mag_tracking.errors import MissingDependencyError, OutputError
from mag_tracking.results.columns import Column

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = 3
"""Version of the tables. Folders of other versions are rejected: rows are not comparable."""

MAX_BUFFERED_ROWS = 5000

_MAGIC = b'PAR1'


def check_row(row: Mapping[str, Any], columns: Iterable[Column]) -> None:
    """Check a row of texts, and of integers and times (or None), from a file; raises ValueError."""
    for column in columns:
        if column.name not in row:
            raise ValueError(f'{column.name} is missing')
        value = row[column.name]
        is_valid = isinstance(value, str) if column.kind == 's' else value is None or (
            isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63)
        if not is_valid:
            raise ValueError(f'invalid {column.name}: {value!r:.40}')


def import_pyarrow() -> Any:
    """Import pyarrow with its Parquet module; raises MissingDependencyError."""
    try:
        import pyarrow.compute
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            'Parquet requires pyarrow: run pip install "mag_tracking[archive]"') from error
    return pyarrow


def schema_of(columns: Iterable[Column]) -> 'pa.Schema':
    """Arrow schema of a table, with unit and meaning of each column as metadata."""
    pa = import_pyarrow()
    # DuckDB 1.5 cuts nanoseconds of times with a time zone, and 2.0 has fewer functions for them.
    kinds = {'i': pa.int64(), 'f': pa.float64(), 's': pa.string(), 'b': pa.bool_(),
             't': pa.timestamp('ns'), 'C': pa.list_(pa.float64(), 36)}
    return pa.schema([pa.field(c.name, kinds[c.kind], metadata={'unit': c.unit, 'is': c.meaning})
                      for c in columns], metadata={'mag_tracking.schema': str(VERSION)})


def is_complete(path: Path) -> bool:
    """Whether a file begins and ends as a Parquet file; its content is not read."""
    with open(path, 'rb') as stream:
        begin = stream.read(len(_MAGIC))
        stream.seek(max(0, path.stat().st_size - len(_MAGIC)))
        return begin == stream.read() == _MAGIC and stream.tell() > 2 * len(_MAGIC)


class TableWriter(AbstractContextManager['TableWriter']):
    """Writer of a Parquet file, in batches of rows; a context manager.

    An existing file is replaced only on success; after an error, none is created.
    """

    def __init__(self, path: Path, columns: Iterable[Column]) -> None:
        columns = tuple(columns)
        self._path, self._schema = path, schema_of(columns)
        # pyarrow 25 cannot read a null in a column of lists of fixed size.
        self._unknown = {c.name: [math.nan] * 36 for c in columns if c.kind == 'C'}
        # A worker that was assumed to be lost may still be writing the same table.
        self._draft = path.with_name(f'.{secrets.token_hex(8)}.part')
        self._rows: list[Mapping[str, Any]] = []
        with self._convert_errors():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = import_pyarrow().parquet.ParquetWriter(
                self._draft, self._schema, compression='zstd')

    @contextmanager
    def _convert_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f'cannot write {self._path}: {error.strerror or error}') from error

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row; missing columns and NaN are null, except in a matrix, which is NaN."""
        self._rows.append({**self._unknown, **row})
        if len(self._rows) >= MAX_BUFFERED_ROWS:
            self._flush()

    def add_table(self, table: 'pa.Table') -> None:
        """Add all rows of a table."""
        self._flush()
        with self._convert_errors():
            self._writer.write_table(table)

    def _flush(self) -> None:
        rows, self._rows = self._rows, []
        if rows:
            rows = [{name: _stored(value) for name, value in row.items()} for row in rows]
            with self._convert_errors():
                self._writer.write_table(
                    import_pyarrow().Table.from_pylist(rows, self._schema))

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self._flush()
            with self._convert_errors():
                self._writer.close()
                if kind is None:
                    self._draft.replace(self._path)
        finally:
            self._draft.unlink(missing_ok=True)


def _stored(value: Any) -> Any:
    """Value that Parquet stores: UTF-8, although a path may have other bytes, and null for NaN."""
    if isinstance(value, str):
        return value.encode(errors='backslashreplace').decode()
    return None if isinstance(value, float) and math.isnan(value) else value
