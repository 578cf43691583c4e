"""Calibration of the geometry of a network with a magnet at unknown poses."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration.magnet_pose import PoseSettings, locate_magnet
from mag_tracking.calibration.network_geometry import (
    MIN_POSES,
    GeometrySettings,
    NetworkGeometry,
    fitted_geometry,
)
from mag_tracking.calibration.network_readings import N_SHARED
from mag_tracking.network import SensorNetwork

COARSE_ERROR = 0.1
"""Assumed error relative to the field in the first stage, while the poses are inaccurate."""

INITIAL_POSE_SETTINGS = PoseSettings(field_error=COARSE_ERROR, ambient_std=1e-6)
"""Settings of the search for the initial poses, while the biases are inaccurate."""


def calibrate_geometry_blind(network: SensorNetwork, field: FloatArray, moment: float,
                             low: ArrayLike, high: ArrayLike,
                             settings: GeometrySettings) -> NetworkGeometry:
    """Estimate the geometry of a network from readings of a magnet at unknown poses.

    The initial poses are found with the median reading of each sensor as its bias. Biases, poses
    and moment are then fitted with an assumed field error of at least 10 %; finally, all unknowns
    are fitted with the configured one. `field` (K, n, 3) [T, sensor frame] includes the constant
    background, NaN if not measured; `low` and `high` [m, world frame] are corners of the box that
    contains the magnet.

    The world frame is defined only by the priors of the sensors and must be registered before a
    comparison with another frame. `rows` are the indices of the fitted poses; poses located outside
    the box by an earlier stage are excluded. Raises ValueError for invalid input (see
    `calibrate_geometry`), or if fewer than `MIN_POSES` poses are inside the box.
    """
    field, low, high = (np.asarray(a, dtype=float) for a in (field, low, high))
    s = settings
    shared_unit = np.append(np.zeros(N_SHARED - 1), s.moment_std)
    pose_unit = np.repeat([s.start_position_std, np.deg2rad(s.start_tilt_std_deg), s.ambient_std],
                          [3, 2, 3])
    rows, r, u = _initial_poses(network, field, moment, low, high)
    coarse = replace(s, gain_std=0.0, rotation_std_deg=0.0, position_std=0.0,
                     field_error=max(COARSE_ERROR, s.field_error))
    for stage in (coarse, s):
        if len(rows) < MIN_POSES:
            raise ValueError(f'found {len(rows)} of {len(field)} poses in the box; at least '
                             f'{MIN_POSES} are required; check the moment and the box')
        geometry = fitted_geometry(network, field[rows], r, u, moment, stage, shared_unit,
                                   pose_unit)
        fitted_rows, (r, u) = rows, geometry.poses
        is_inside = ((low <= r) & (r <= high)).all(axis=1)
        rows, r, u = rows[is_inside], r[is_inside], u[is_inside]
    return replace(geometry, rows=fitted_rows,
                   suspect_poses=tuple(int(fitted_rows[k]) for k in geometry.suspect_poses))


def _initial_poses(network: SensorNetwork, field: FloatArray, moment: float, low: FloatArray,
                   high: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Locate the magnet in each reading; return rows, positions and axes of the valid poses."""
    if field.ndim != 3 or field.shape[1:] != (len(network), 3):
        raise ValueError(f'expected field (K, {len(network)}, 3), got {field.shape}')
    median = np.zeros(field.shape[1:])
    for j, a in zip(*np.nonzero((~np.isnan(field)).any(axis=0)), strict=True):
        median[j, a] = np.nanmedian(field[:, j, a])
    poses = [locate_magnet(network, B - median, moment, low, high, INITIAL_POSE_SETTINGS)
             for B in field]
    rows = np.flatnonzero([pose.converged for pose in poses])
    positions, axes = (np.array([getattr(poses[k], name) for k in rows]).reshape(-1, 3)
                       for name in ('position', 'axis'))
    return rows, positions, axes
