"""Synthetic records of tracks, as published by a tracker."""

import numpy as np

from mag_tracking.records import FieldFrame, SmoothedPose, Track

NS = 1_000_000_000


def _common(t, x, y, v, **changes):
    """Fields common to `Track` and `SmoothedPose`."""
    return {'stamp_ns': round(t * NS), 'id': 1, 'position': np.array([x, y, 0.5]),
            'velocity': np.array([v, 0.0, 0.0]), 'covariance': 0.01 * np.eye(6),
            'orientation': np.array([0.0, 0.0, 0.0, 1.0]),
            'orientation_covariance': np.eye(3),
            'position_orientation_covariance': np.zeros((3, 3)),
            'moment': np.array([400.0, 0.0, 200.0]), 'moment_covariance': 100.0 * np.eye(3),
            'kind': 'car', 'length': 3.0, 'length_std': 0.3, 'ambiguous': False, **changes}


def track_pose(t, x, y=-1.5, v=10.0, ended=False, **changes):
    """`Track` at time `t` [s] and position (`x`, `y`) [m], with speed `v` [m/s] along x."""
    return Track(**{
        'ended': ended, 'existence': 1.0, 'weight': 1.0, 'nis': 1.0,
        'nis_by_sensor': np.ones(2), 'degrees_of_freedom': 6, 'arrival': 'left',
        'kind_weight': 1.0, 'unobservable': (False,) * 6, 'predicted': np.zeros((2, 3)),
        'mounting': np.zeros((0, 3)), 'mounting_covariance': np.zeros((0, 3, 3)),
        **_common(t, x, y, v), **changes})


def smoothed_pose(t, x, y=-1.5, v=10.0, **changes):
    """`SmoothedPose` of a complete track, with arguments as for `track_pose`."""
    return SmoothedPose(**{'complete': True, **_common(t, x, y, v), **changes})


def frame(t, n_sensors=2, field=None):
    """`FieldFrame` at time `t` [s]; the default `field` is zero."""
    return FieldFrame(round(t * NS), np.zeros((n_sensors, 3)) if field is None else field,
                      np.tile(1e-16 * np.eye(3), (n_sensors, 1, 1)),
                      np.ones(n_sensors, dtype=np.int64), np.zeros(n_sensors))
