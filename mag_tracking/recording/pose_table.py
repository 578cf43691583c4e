"""Tables of a magnet's poses above a board of sensors, with one row per pose."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.recording.csv_file import CsvPath, Lines, number, read_csv, read_numbers

_POSE_COLUMNS = ('mag_x0', 'mag_y0', 'mag_z0', 'mag_mx0', 'mag_my0', 'mag_mz0')


def read_pose_table(path: CsvPath) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Read fields and the poses of a magnet from an external tracker.

    Columns: `x0,y0,z0,x1...` [T, sensor frame; empty or nan if not measured], `mag_x0..z0` [m,
    tracker frame] and `mag_mx0..mz0` (unit vector, tracker frame). Results: fields (K, n, 3), NaN
    if not measured; positions (K, 3); normalised axes (K, 3). Raises RecordingError also if the
    length of an axis differs from 1 by more than 1e-3.
    """
    rows, values = _values(path, _POSE_COLUMNS)
    axes = values[:, -3:]
    lengths = np.linalg.norm(axes, axis=1)
    for (line, _), vector_length in zip(rows, lengths, strict=True):
        if abs(vector_length - 1.0) > 1e-3:
            raise RecordingError(f'{path}: row {line}: mag_mx0..mag_mz0 has length '
                                 f'{vector_length:.6g}, expected 1')
    return (values[:, :-6].reshape(len(rows), -1, 3), values[:, -6:-3], axes / lengths[:, None])


def read_readings(path: CsvPath) -> FloatArray:
    """Fields (K, n, 3), T, sensor frames, of a pose table, which may lack pose columns; NaN if not
    measured."""
    rows, values = _values(path, ())
    return values.reshape(len(rows), -1, 3)


def read_sensor_positions(path: CsvPath) -> FloatArray:
    """Sensor positions (n, 3), m, from a CSV file x, y, z without header; # begins a comment
    line."""
    return read_numbers(path, ('x', 'y', 'z'))


def _values(path: CsvPath, pose: tuple[str, ...]) -> tuple[Lines, FloatArray]:
    """Read a table; return [(line, cells)], and an array of the field and `pose` columns."""
    header, rows = read_csv(path)
    n = sum(name[:1] == 'x' and name[1:].isdigit() for name in header)
    fields = [f'{a}{j}' for j in range(n) for a in 'xyz']
    if not n:
        raise RecordingError(f'{path}: column x0 is missing')
    for name in (*fields, *pose):
        if header.count(name) != 1:
            problem = 'missing' if name not in header else 'given twice'
            raise RecordingError(f'{path}: column {name} is {problem}')
    indices = [header.index(name) for name in (*fields, *pose)]
    values = np.array([[number(path, line, name, row[i], name in pose)
                        for name, i in zip((*fields, *pose), indices, strict=True)]
                       for line, row in rows])
    return rows, values
