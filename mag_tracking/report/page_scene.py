"""Map with a time slider as JSON: sensors, tracks, hypotheses and fields."""

import base64
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.report.road import Road
from mag_tracking.report.style import scale_of
from mag_tracking.units import NS

MAX_SENSORS = 8
"""Maximum number of sensors per track; those with the strongest fields are included."""
MAX_BYTES = 2_300_000
"""Approximate size limit of the track data [bytes]. Larger reports show fewer poses per track."""
MAX_TRACKS = 1_000
"""Maximum number of tracks in a report."""
MIN_POSES, TRACK_SIZE = 4, 2_500
"""Minimum number of poses per track, and approximate size of a track without poses [bytes]."""
MAX_MARGIN_RATIO = 6.0
"""Maximum margin of the map around the network, as a multiple of the span of the network."""
SINGLE_SENSOR_MARGIN_M = 10.0
"""Maximum margin of the map around a network without extent, such as a single sensor [m]."""


@dataclass(frozen=True, eq=False)
class SensorLayout:
    """Names and positions of the sensors, as published by the tracker."""

    frame: str
    """Name of the world frame."""
    names: tuple[str, ...]
    positions: FloatArray
    """(n, 3) [m], world frame."""

    def __len__(self) -> int:
        return len(self.names)


NO_ROAD = Road()
Sensors: TypeAlias = SensorNetwork | SensorLayout
Packed: TypeAlias = dict[str, str]
"""Maps the type of the numbers of an array to little-endian base64, which `scene.js` decodes."""


def packed(values: ArrayLike, kind: str = 'f8') -> Packed:
    """Encode an array (n,) as JSON object; 'f4' is sufficient for values that are only plotted."""
    raw = np.ascontiguousarray(values, dtype=f'<{kind}').tobytes()
    return {kind: base64.b64encode(raw).decode('ascii')}


def scene_of(network: Sensors, begin_ns: int, end_ns: int,
             tracks: Sequence[Mapping[str, Any]], road: Road = NO_ROAD) -> dict[str, Any]:
    """JSON object of the map of tracks from `track_entry`; times are in s since `begin_ns`."""
    xy = network.positions[:, :2]
    low, high = xy.min(axis=0), xy.max(axis=0)
    span = float((high - low).max())
    margin, max_margin = 1.0, SINGLE_SENSOR_MARGIN_M
    if span > 0.0:
        margin, max_margin = 0.15 * span, MAX_MARGIN_RATIO * span
    # Extents [x0, x1, y0, y1] [m].
    reach, most_reach = (np.stack([low - m, high + m], axis=1).ravel().tolist()
                         for m in (margin, max_margin))
    factor, unit = scale_of(span or SINGLE_SENSOR_MARGIN_M)
    return {'frame': network.frame, 'begin_ns': str(begin_ns), 'begin': 0.0,
            'end': (end_ns - begin_ns) / NS, 'scale': {'factor': factor, 'unit': unit},
            'sensors': {'names': list(network.names), 'x': packed(xy[:, 0]), 'y': packed(xy[:, 1]),
                        'z': packed(network.positions[:, 2])},
            'road': {name: [{'x': packed(line[:, 0]), 'y': packed(line[:, 1])} for line in lines]
                     for name, lines in (('areas', road.areas), ('markings', road.markings))},
            'reach': reach, 'most_reach': most_reach, 'tracks': list(tracks)}


def strongest_sensors(log: TrackLog, rows: Iterable[int] | None = None) -> IntArray:
    """Indices of up to `MAX_SENSORS` sensors with the strongest fields at poses (default: all)."""
    chosen = log.measured if rows is None else [log.measured[k] for k in rows]
    measured = np.abs(np.array(chosen).reshape(-1, len(log.measured[0]), 3))
    strength = np.nan_to_num(measured).max(axis=(0, 2), initial=0.0)
    return np.sort(np.argsort(-strength, kind='stable')[:MAX_SENSORS])


def max_poses_of(logs: Sequence[TrackLog]) -> int:
    """Maximum number of poses per track that keeps a report below `MAX_BYTES`."""
    lengths = np.array([len(log.stamp_ns) for log in logs])
    sizes = np.array([_pose_size(log) for log in logs])

    def size(max_poses: int) -> int:
        return TRACK_SIZE * len(logs) + int((np.minimum(lengths, max_poses) * sizes).sum())

    numbers = range(MIN_POSES + 1, int(lengths.max()) + 1)
    return MIN_POSES + bisect_right(numbers, MAX_BYTES, key=size)


def _pose_size(log: TrackLog) -> int:
    """Approximate size of a pose in base64 [bytes], including its true and smoothed positions."""
    n_sensors = min(MAX_SENSORS, len(log.measured[0]))
    n_arrivals = len({name for row in log.arrivals for name in row})
    # Base64 needs four bytes for three.
    return (4 * (160 + 24 * n_sensors + 32 * n_arrivals)) // 3


def thin_poses(log: TrackLog, max_poses: int) -> list[int]:
    """Indices of evenly spaced poses, with the first, the last and the most certain pose."""
    n = len(log.stamp_ns)
    if n <= max_poses:
        return list(range(n))
    rows = np.linspace(0, n - 1, max_poses - 1).round().astype(int)
    return sorted({*rows.tolist(), log.most_certain()})


def track_entry(log: TrackLog, begin_ns: int, sensors: IntArray,
                rows: Sequence[int] | None = None) -> dict[str, Any]:
    """JSON object of poses `rows` of a track, with fields of `sensors`; times since `begin_ns`."""
    rows = range(len(log.stamp_ns)) if rows is None else rows

    def column(name: str, *shape: int) -> FloatArray:
        values = getattr(log, name)
        return np.array([values[k] for k in rows], dtype=float).reshape(-1, *shape)

    times = (np.array([log.stamp_ns[k] for k in rows], dtype=np.int64) - begin_ns) / NS
    # A magnet, which has no kind, is drawn by its moment in place of its length.
    length = np.array([log.length[k] if log.kind[k] else np.nan for k in rows], dtype=float)
    measured, predicted = (column(name, len(log.measured[0]), 3)
                           for name in ('measured', 'predicted'))
    return {**pose_entry(log.id, times, np.hstack([column('position', 3), column('velocity', 3)]),
                         column('covariance', 6, 6), column('ambiguous'), length,
                         column('moment', 3), column('nis'), column('degrees_of_freedom')),
            'ended': log.ended, 'arrivals': _arrivals(log, rows),
            'fields': [field_entry(j, measured[:, j], predicted[:, j]) for j in sensors.tolist()],
            'doubts': [', '.join(log.doubts[k]) for k in rows]}


def pose_entry(track_id: int, times: FloatArray, state: FloatArray, C: FloatArray,
               ambiguous: ArrayLike, length: FloatArray, moment: FloatArray, nis: FloatArray,
               degrees_of_freedom: FloatArray) -> dict[str, Any]:
    """JSON object of an ended track with n poses, without fields and arrival directions.

    `times` (n,) [s] are since the start of the scene; `state` (n, 6) [m and m/s] and its covariance
    `C` are in the world frame. `length` (n,) [m] is that of the row of dipoles, NaN for a magnet,
    and `moment` (n, 3) [A m²] is drawn only for a magnet. Without degrees of freedom, there is no
    NIS.
    """
    u = state[:, 3:5] / np.maximum(np.linalg.norm(state[:, 3:5], axis=1, keepdims=True), 1e-12)
    # Variance of the horizontal speed, to first order.
    speed_variance = np.einsum('na,nab,nb->n', u, C[:, 3:5, 3:5], u)
    # NIS per axis, and the 90 % band that is expected of a consistent filter.
    n, axes = degrees_of_freedom, np.maximum(degrees_of_freedom, 1.0)
    low, high = (np.where(n > 0.0, chdtri(axes, p) / axes, np.nan) for p in (0.95, 0.05))
    columns = {
        't': packed(times),
        **{name: packed(state[:, k]) for k, name in enumerate(('x', 'y', 'z', 'vx', 'vy'))},
        **{a + b: packed(C[:, 'xyz'.index(a), 'xyz'.index(b)], 'f4')
           for a, b in ('xx', 'xy', 'yy', 'xz', 'zz')},
        'speed_sd': packed(np.sqrt(np.maximum(speed_variance, 0.0)), 'f4'),
        'ambiguous': packed(ambiguous, 'u1'), 'length': packed(length, 'f4'),
        **{f'm{axis}': packed(moment[:, a], 'f4') for a, axis in enumerate('xyz')},
        'nis': packed(np.where(n > 0.0, nis / axes, np.nan), 'f4'),
        'nis_low': packed(low, 'f4'), 'nis_high': packed(high, 'f4')}
    return {'id': track_id, 'key': track_id, 'ended': True, 'columns': columns, 'arrivals': {},
            'fields': [], 'doubts': [''] * len(times), 'smoothed': None, 'truth': None,
            'facts': None}


def field_entry(sensor: int, measured: FloatArray, predicted: FloatArray,
                times: FloatArray | None = None) -> dict[str, Any]:
    """JSON object of the measured and predicted field (n, 3) [T] of a sensor, at `times` (n,) [s]
    since the start of the scene, or None for those of the poses."""
    return {'sensor': sensor, 't': None if times is None else packed(times), **{
        name: [packed(column, 'f4') for column in values.T]
        for name, values in (('measured', measured), ('predicted', predicted))}}


def path_entry(points: FloatArray) -> dict[str, Packed]:
    """JSON object of the smoothed or the true path (n, 3) [m, world frame] of a track."""
    return {name: packed(points[:, a]) for a, name in enumerate('xyz')}


def facts_of(entry: Mapping[str, Any]) -> dict[str, Any]:
    """JSON object of a row in the table of tracks, from an entry of `summary.json`."""
    truth = entry.get('truth', {})
    error = next((truth[key] for key in ('closest', 'position_mean')
                  if isinstance(truth.get(key), float) and np.isfinite(truth[key])), None)
    arrival = entry['arrival']
    return {'arrival': f'{arrival} ({entry["arrival_weights"][arrival]:.0%})' if arrival else None,
            'kind': f'{entry["kind"]} ({entry["kind_weight"]:.0%})' if entry['kind'] else None,
            'speed': entry['speed'], 'moment': entry['moment_size'],
            'verdict': entry['verdict'], 'error': error,
            'doubts': ', '.join(f'{name.replace("_", " ")} ({n})'
                                for name, n in entry['doubts'].items())}


def _arrivals(log: TrackLog, rows: Sequence[int]) -> dict[str, dict[str, Packed]]:
    """Weight and best hypothesis of each arrival direction; weight 0 and NaN without one."""
    log_rows = [log.arrivals[k] for k in rows]
    out = {}
    for name in sorted({name for row in log_rows for name in row}):
        values = np.full((len(log_rows), 6), np.nan)
        values[:, 0] = 0.0
        for k, row in enumerate(log_rows):
            if name in row:
                weight, position, C = row[name]
                values[k] = weight, position[0], position[1], C[0, 0], C[0, 1], C[1, 1]
        # Coordinates in a large frame need double precision.
        out[name] = {key: packed(column, 'f8' if key in 'xy' else 'f4') for key, column in zip(
            ('weight', 'x', 'y', 'xx', 'xy', 'yy'), values.T, strict=True)}
    return out
