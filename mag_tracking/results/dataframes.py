"""Results as pandas DataFrames, with the columns of the CSV files that `mag-tracking` writes.

`DataFrame.attrs['units']` contains the units by column; columns without a unit are dimensionless.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.arrays import StructArray
from mag_tracking.errors import MissingDependencyError

if TYPE_CHECKING:
    import pandas as pd

_POSITION, _VELOCITY, _MOMENT = ('x', 'y', 'z'), ('vx', 'vy', 'vz'), ('mx', 'my', 'mz')
_STD = tuple(f'sd_{name}' for name in _POSITION + _VELOCITY)

STATE_UNITS = {
    'stamp_ns': 'ns', **dict.fromkeys(_POSITION + _STD[:3], 'm'),
    **dict.fromkeys(_VELOCITY + _STD[3:], 'm/s'), **dict.fromkeys(_MOMENT, 'A m^2'),
    'length': 'm', 'sd_length': 'm'}
"""Units of the columns of poses."""


def dataframe(columns: Mapping[str, Any], units: Mapping[str, str]) -> 'pd.DataFrame':
    """Create a DataFrame with units by column; raises MissingDependencyError without pandas.

    Units of missing columns are ignored.
    """
    try:
        import pandas as pd
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            'DataFrames require pandas: run pip install mag_tracking[pandas]') from error
    frame = pd.DataFrame(dict(columns))
    frame.attrs['units'] = {name: unit for name, unit in units.items() if name in frame}
    return frame


def poses_dataframe(poses: StructArray) -> 'pd.DataFrame':
    """Convert poses of `pose_array` to a DataFrame with the columns of `poses.csv`."""
    columns = {**_state_columns(poses), **{name: poses[name] for name in (
        'weight', 'ambiguous', 'kind', 'kind_weight', 'length')}, 'sd_length': poses['length_std'],
        'doubts': poses['doubts']}
    return dataframe(columns, STATE_UNITS)


def smoothed_dataframe(smoothed: StructArray) -> 'pd.DataFrame':
    """Convert poses of `smoothed_array` to the columns of `poses_smoothed.csv`, and `complete`."""
    columns = {**_state_columns(smoothed), **{name: smoothed[name] for name in (
        'ambiguous', 'kind', 'length')}, 'sd_length': smoothed['length_std'],
        'complete': smoothed['complete']}
    return dataframe(columns, STATE_UNITS)


def detections_dataframe(detections: StructArray) -> 'pd.DataFrame':
    """Convert onsets and releases of `detection_array` to the columns of `detections.csv`."""
    columns = {'stamp_ns': detections['stamp_ns'], 'id': detections['id'],
               'event': np.where(detections['onset'], 'onset', 'release'),
               **{name: detections[name] for name in (
                   'statistic', 'degrees_of_freedom', 'threshold', 'false_alarm_probability',
                   'strongest_sensor')}}
    return dataframe(columns, {'stamp_ns': 'ns'})


def _state_columns(rows: StructArray) -> dict[str, Any]:
    """Columns of poses and smoothed poses: time, track, state, standard deviations and moment."""
    std = np.sqrt(np.diagonal(rows['covariance'], axis1=1, axis2=2))
    columns: dict[str, Any] = {'stamp_ns': rows['stamp_ns'], 'track_id': rows['track_id']}
    for names, values in ((_POSITION, rows['position']), (_VELOCITY, rows['velocity']),
                          (_STD, std), (_MOMENT, rows['moment'])):
        columns |= {name: values[:, k] for k, name in enumerate(names)}
    return columns
