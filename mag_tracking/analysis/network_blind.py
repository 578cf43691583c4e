"""A network's geometry from a magnet that nothing tracks."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.analysis.magnet_pose import PoseSettings, locate_magnet
from mag_tracking.analysis.network_geometry import (
    MIN_POSES,
    GeometrySettings,
    NetworkGeometry,
    fitted_geometry,
)
from mag_tracking.analysis.network_readings import SHARED
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork

COARSE_ERROR = 0.1
"""What the field is taken to err by while poses are no better than their starts."""

FIRST = PoseSettings(field_error=COARSE_ERROR, ambient_std=1e-6)
"""How poses are looked for while the biases are hardly known."""


def calibrate_geometry_blind(network: SensorNetwork, field: FloatArray, moment: float,
                             low: ArrayLike, high: ArrayLike,
                             settings: GeometrySettings) -> NetworkGeometry:
    """As `calibrate_geometry` where nothing tracks the magnet: its poses are unknown, too.

    Parameters
    ----------
    network, field, moment, settings : as for `calibrate_geometry`
    low, high : (3,) [m], world
        Corners of the box in which the magnet was.

    Returns
    -------
    NetworkGeometry
        World is what the priors of the sensors make of it: compare after a registration. `rows`
        are the poses that were found in the box.

    Raises
    ------
    ValueError
        As `calibrate_geometry`, or fewer than `MIN_POSES` poses found in the box.

    The poses begin as if each bias were the sensor's median; then biases and poses are fitted to a
    field that is believed to a tenth, and only then all the rest.
    """
    field, low, high = (np.asarray(a, dtype=float) for a in (field, low, high))
    s = settings
    shared_unit = np.append(np.zeros(SHARED - 1), s.moment_std)
    pose_unit = np.repeat([s.start_position_std, np.deg2rad(s.start_tilt_std_deg), s.ambient_std],
                          [3, 2, 3])
    rows, r, u = _first_poses(network, field, moment, low, high)
    coarse = replace(s, gain_std=0.0, rotation_std_deg=0.0, position_std=0.0,
                     field_error=max(COARSE_ERROR, s.field_error))
    for how in (coarse, s):
        if len(rows) < MIN_POSES:
            raise ValueError(f'{len(rows)} of {len(field)} poses were found in the box, at least '
                             f'{MIN_POSES} are needed')
        geometry = fitted_geometry(network, field[rows], r, u, moment, how, shared_unit,
                                   pose_unit)
        used, (r, u) = rows, geometry.poses
        inside = ((low <= r) & (r <= high)).all(axis=1)
        rows, r, u = rows[inside], r[inside], u[inside]
    return replace(geometry, rows=used,
                   suspect_poses=tuple(int(used[k]) for k in geometry.suspect_poses))


def _first_poses(network: SensorNetwork, field: FloatArray, moment: float, low: FloatArray,
                 high: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Rows (k,) of poses that are found, their positions and axes (k, 3)."""
    if field.ndim != 3 or field.shape[1:] != (len(network), 3):
        raise ValueError(f'expected field (K, {len(network)}, 3), got {field.shape}')
    middle = np.zeros(field.shape[1:])
    for j, a in zip(*np.nonzero((~np.isnan(field)).any(axis=0)), strict=True):
        middle[j, a] = np.nanmedian(field[:, j, a])
    found = [locate_magnet(network, B - middle, moment, low, high, FIRST) for B in field]
    rows = np.flatnonzero([pose.converged for pose in found])
    positions, axes = (np.array([getattr(found[k], name) for k in rows]).reshape(-1, 3)
                       for name in ('position', 'axis'))
    return rows, positions, axes
