"""Results as structured arrays, and as pandas DataFrames with the columns of the CSV files.

`DataFrame.attrs['units']` contains the units by column; columns without a unit are dimensionless.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.arrays import StructArray
from mag_tracking.errors import MissingDependencyError
from mag_tracking.records import Detection, SmoothedPose, Track
from mag_tracking.results.columns import Column

if TYPE_CHECKING:
    import pandas as pd

_TEXT_WIDTH = 16
"""Minimum width of a string field in characters. Longer names widen the field."""

_STATE_FIELDS = {
    'stamp_ns': 'i8', 'track_id': 'i8', 'position': '3f8', 'velocity': '3f8',
    'covariance': '(6,6)f8', 'orientation': '4f8', 'orientation_covariance': '(3,3)f8',
    'position_orientation_covariance': '(3,3)f8', 'moment': '3f8', 'moment_covariance': '(3,3)f8',
    'kind': 'U', 'length': 'f8', 'length_std': 'f8', 'ambiguous': '?'}
"""Fields that `Track` and `SmoothedPose` have in common. These classes document the units."""

_POSE_FIELDS = {
    **_STATE_FIELDS, 'doubts': 'U', 'arrival': 'U', 'weight': 'f8', 'kind_weight': 'f8',
    'existence': 'f8', 'nis': 'f8', 'degrees_of_freedom': 'i8', 'unobservable': '6?'}

_SMOOTHED_FIELDS = {**_STATE_FIELDS, 'complete': '?'}

_DETECTION_FIELDS = {
    'stamp_ns': 'i8', 'id': 'i8', 'onset': '?', 'statistic': 'f8', 'degrees_of_freedom': 'i8',
    'threshold': 'f8', 'false_alarm_probability': 'f8', 'strongest_sensor': 'U'}


def pose_array(tracks: Sequence[Track]) -> StructArray:
    """Structured array (n,) of the poses of tracks, without the closing records (`ended`), which
    repeat the last pose: fields of `Track`, `id` as `track_id`."""
    return _array([t for t in tracks if not t.ended], _POSE_FIELDS)


def smoothed_array(poses: Sequence[SmoothedPose]) -> StructArray:
    """Structured array (n,) of smoothed poses: fields of `SmoothedPose`, `id` as `track_id`."""
    return _array(poses, _SMOOTHED_FIELDS)


def detection_array(detections: Sequence[Detection]) -> StructArray:
    """Structured array (n,) of onsets and releases of the detector: fields of `Detection`."""
    return _array(detections, _DETECTION_FIELDS)


def _array(records: Sequence[Track | SmoothedPose | Detection], fields: Mapping[str, str]
           ) -> StructArray:
    """Convert records to a structured array (n,) of the attributes that `fields` names."""
    columns: dict[str, list[Any]] = {
        name: [getattr(r, 'id' if name == 'track_id' else name) for r in records]
        for name in fields}
    if 'doubts' in columns:
        columns['doubts'] = [' '.join(doubts) for doubts in columns['doubts']]
    dtype = [(name, f'U{max(_TEXT_WIDTH, *map(len, columns[name]), 1)}' if kind == 'U' else kind)
             for name, kind in fields.items()]
    out = np.zeros(len(records), dtype=dtype)
    for name, values in columns.items():
        out[name] = np.array(values, dtype=out[name].dtype).reshape(out[name].shape)
    return out


def dataframe(columns: Iterable[Column], values: Mapping[str, Any]) -> 'pd.DataFrame':
    """Create a DataFrame of values (n,) by column; raises MissingDependencyError without pandas."""
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
    """Convert an array of this module to a DataFrame."""
    columns = tuple(columns)
    fields = {name: rows[name] for name in rows.dtype.names or ()}
    record = SimpleNamespace(**{'id': fields.get('track_id'), **fields})
    return dataframe(columns, {c.name: c.of(record) for c in columns})
