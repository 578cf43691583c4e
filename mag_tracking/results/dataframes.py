"""Results as pandas DataFrames, with the columns of the CSV files that `mag-tracking` writes.

`DataFrame.attrs['units']` contains the units by column; columns without a unit are dimensionless.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from mag_tracking.arrays import StructArray
from mag_tracking.errors import MissingDependencyError
from mag_tracking.results.columns import Column

if TYPE_CHECKING:
    import pandas as pd


def dataframe(columns: Iterable[Column], values: Mapping[str, Any]) -> 'pd.DataFrame':
    """Create a DataFrame from values (n,) by column; raises MissingDependencyError without
    pandas."""
    try:
        import pandas as pd
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            'DataFrames require pandas: run pip install mag_tracking[pandas]') from error
    columns = tuple(columns)
    frame = pd.DataFrame({c.name: values[c.name] for c in columns})
    frame.attrs['units'] = {c.name: c.unit for c in columns if c.unit}
    return frame


def rows_dataframe(columns: Iterable[Column], rows: Sequence[Mapping[str, Any]],
                   time: str = '') -> 'pd.DataFrame':
    """Create a DataFrame from rows by column, indexed by the UTC times of the column `time`."""
    columns = tuple(columns)
    frame = dataframe(columns, {c.name: [row[c.name] for row in rows] for c in columns})
    return with_time_index(frame, time) if time else frame


def with_time_index(frame: 'pd.DataFrame', column: str) -> 'pd.DataFrame':
    """Index a DataFrame by the UTC times of a column in ns since 1970, which remains."""
    import pandas as pd

    return frame.set_index(pd.to_datetime(frame[column].astype('int64'), utc=True).rename('time'))


def array_dataframe(columns: Iterable[Column], rows: StructArray) -> 'pd.DataFrame':
    """Convert an array of `results.result_arrays` to a DataFrame."""
    columns = tuple(columns)
    fields = {name: rows[name] for name in rows.dtype.names or ()}
    record = SimpleNamespace(**{'id': fields.get('track_id'), **fields})
    return dataframe(columns, {c.name: c.of(record) for c in columns})
