"""Tables of the poses of a magnet: above a board of sensors, and as imported recordings."""

from pathlib import Path

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
from mag_tracking.messages.schema import magnetic_field_dicts, pose_dict
from mag_tracking.messages.types import MAGNETIC_FIELD, POSE
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import write_network
from mag_tracking.recording.table_text import FilePath, Lines, read_csv
from mag_tracking.recording.writer import RecordingWriter
from mag_tracking.records import Readings

_COLUMNS = ('id', 'timestamp', 'Bx', 'By', 'Bz', 'sensor_x', 'sensor_y', 'sensor_z',
            'sensor_ox', 'sensor_oy', 'sensor_oz', 'm_x', 'm_y', 'm_z', 'm_ox', 'm_oy', 'm_oz')
MAX_ID, MAX_TIME_S = 1e6, 9e9
"""Limits of `id` and `timestamp`; nanoseconds since 1970 are 64-bit integers."""
_POSE_COLUMNS = ('mag_x0', 'mag_y0', 'mag_z0', 'mag_mx0', 'mag_my0', 'mag_mz0')


def read_pose_table(path: FilePath) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Read fields (K, n, 3), NaN if not measured, and the positions (K, 3) and normalised axes
    (K, 3) of a magnet from an external tracker.

    Columns: `x0,y0,z0,x1...` [T, sensor frame; empty or nan if not measured], `mag_x0..z0` [m,
    tracker frame] and `mag_mx0..mz0` (unit vector within 1e-3, tracker frame).
    """
    rows, values = _values(path, _POSE_COLUMNS)
    axes = values[:, -3:]
    lengths = np.linalg.norm(axes, axis=1)
    for (line, _), vector_length in zip(rows, lengths, strict=True):
        if abs(vector_length - 1.0) > 1e-3:
            raise RecordingError(f'{path}: row {line}: mag_mx0..mag_mz0 has length '
                                 f'{vector_length:.6g}, expected 1')
    return (values[:, :-6].reshape(len(rows), -1, 3), values[:, -6:-3], axes / lengths[:, None])


def read_readings(path: FilePath) -> FloatArray:
    """Fields (K, n, 3), T, sensor frames, of a table that may lack poses; NaN if not measured."""
    rows, values = _values(path, ())
    return values.reshape(len(rows), -1, 3)


def read_sensor_positions(path: FilePath) -> FloatArray:
    """Sensor positions (n, 3), m, from a CSV file x, y, z without header; # begins a comment."""
    return read_csv(path, 'xyz').numbers('xyz')


def _values(path: FilePath, pose: tuple[str, ...]) -> tuple[Lines, FloatArray]:
    """Read a table; return [(line, cells)], and an array of the field and `pose` columns."""
    table = read_csv(path)
    n = sum(name[:1] == 'x' and name[1:].isdigit() for name in table.header)
    fields = [f'{a}{j}' for j in range(n) for a in 'xyz']
    if not n:
        raise RecordingError(f'{path}: column x0 is missing')
    for name in (*fields, *pose):
        if table.header.count(name) != 1:
            raise RecordingError(f'{path}: column {name} is '
                                 f'{"given twice" if name in table.header else "missing"}')
    return table.rows, table.numbers((*fields, *pose), fields)


def import_pose_table(table: FilePath, background: FilePath, out: FilePath,
                      noise_std: float) -> tuple[Path, Path, int]:
    """Import a table of magnet poses and fields; return recording, network file and row count.

    `table` has one row per sensor and pose: `id`, `timestamp` [s], `Bx By Bz` [µT, sensor frame,
    including the background], `sensor_x..z` [mm], `sensor_ox..oz` (rotation vector, sensor to
    world), and the true pose of the magnet, `m_x..z` [mm] and `m_ox..oz` (rotation vector; the
    magnet's axis is the rotated z axis). Sensor poses repeat in every row; their medians are used.
    `background` has the field without the magnet [µT, sensor frame], one row per sensor in the
    order of the ids. `noise_std` [T] is that of one reading, which the table does not contain.
    """
    rows = _read_table(table)
    backgrounds = read_csv(background, _COLUMNS[2:5]).numbers(_COLUMNS[2:5])
    ids = np.unique(rows['id']).astype(int)
    if len(backgrounds) != len(ids):
        raise RecordingError(f'the tables have different numbers of sensors: {background} has '
                             f'{len(backgrounds)}, {table} has {len(ids)}')
    names = tuple(f'mag_{i}' for i in ids)
    positions, rotation_vectors = (
        np.array([np.median(rows[kind][rows['id'] == i], axis=0) for i in ids])
        for kind in ('sensor', 'sensor_rotation'))
    quaternions = quaternion_from_rotation_vector(rotation_vectors)
    network = SensorNetwork(
        names, positions * 1e-3, rotation_from_quaternion(quaternions),
        tuple(f'/{name}/imu/mag' for name in names),
        noise_std=(np.full(3, noise_std),) * len(ids), background=tuple(backgrounds * 1e-6))
    out = Path(out)
    recording = out / f'{Path(table).stem}.mcap'
    order = np.argsort(rows['timestamp'], kind='stable')
    with RecordingWriter(recording) as writer:
        for k in order:
            stamp = int(round(rows['timestamp'][k] * 1e9))
            name = f'mag_{int(rows["id"][k])}'
            for _, content in magnetic_field_dicts(
                    Readings.single(name, stamp, rows['field'][k] * 1e-6)):
                writer.write(f'/{name}/imu/mag', MAGNETIC_FIELD, content, stamp)
            if rows['id'][k] == ids[0]:
                q = quaternion_from_rotation_vector(rows['magnet_rotation'][k])
                writer.write('/ground_truth/magnet/pose', POSE,
                             pose_dict(stamp, 'map', rows['magnet'][k] * 1e-3, q), stamp)
    write_network(out / 'network.yaml', network,
                  f'Imported from {Path(table).name} and {Path(background).name}.')
    return recording, out / 'network.yaml', len(order)


def _read_table(path: FilePath) -> dict[str, FloatArray]:
    """Read a table of poses as arrays, in the units of the table; raises RecordingError."""
    a = read_csv(path).numbers(_COLUMNS)
    if ((a[:, 0] != np.round(a[:, 0])) | (np.abs(a[:, 0]) > MAX_ID)).any():
        raise RecordingError(f'{path}: column id contains values that are not integers up to '
                             f'{MAX_ID:g}')
    if ((a[:, 1] < 0.0) | (a[:, 1] > MAX_TIME_S)).any():
        raise RecordingError(f'{path}: column timestamp contains values outside 0 to '
                             f'{MAX_TIME_S:g} s')
    return {'id': a[:, 0], 'timestamp': a[:, 1], 'field': a[:, 2:5], 'sensor': a[:, 5:8],
            'sensor_rotation': a[:, 8:11], 'magnet': a[:, 11:14], 'magnet_rotation': a[:, 14:17]}
