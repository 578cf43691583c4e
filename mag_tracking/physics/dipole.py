"""Flux density of magnetic dipoles, and its derivatives."""

import math

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core

MU0 = 4e-7 * math.pi
"""Vacuum permeability [T m/A]; 4e-7 pi, as in the cited papers."""

K_DIPOLE = core.K_DIPOLE
"""Constant mu0 / (4 pi) of the dipole field [T m/A]."""


def sensor_fields(positions: FloatArray, R_sw: FloatArray, r: FloatArray, m: FloatArray,
                  dr_dx: FloatArray, dm_dx: FloatArray
                  ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Field of moving dipoles at fixed sensors, and its derivative with respect to the state.

    Parameters
    ----------
    positions : (n_sensors, 3) array, m, world frame
        Sensor positions.
    R_sw : (n_sensors, 3, 3) array
        Rotation from the world frame to each sensor frame.
    r : (n_hyp, n_dipoles, 3) array, m, world frame
        Dipole positions.
    m : (n_hyp, n_dipoles, 3) array, A m², world frame
        Dipole moments.
    dr_dx : (n_hyp, n_dipoles, 3, n_t) array
        Derivative of `r` with respect to the target state.
    dm_dx : (n_hyp, n_dipoles, 3, n_t) array
        Derivative of `m` with respect to the target state.

    Returns
    -------
    h : (n_hyp, n_sensors, 3) array, T, sensor frame
        Sum of the fields of the dipoles.
    H : (n_hyp, n_sensors, 3, n_t) array
        Derivative of `h` with respect to the target state.
    gradient : (n_hyp, n_sensors) array, T/m
        Sum of mu0/(4 pi) ‖m‖ / ‖d‖^4 over the dipoles, where d is the vector from dipole to sensor.
        A term times the extent [m] of the body that the dipole represents is the magnitude of the
        first neglected multipole order. Magnitudes are added instead of squares, because the errors
        of adjacent dipoles of a body are correlated.

    Notes
    -----
    All three outputs are NaN or infinite if a dipole is at the position of a sensor.

    References
    ----------
    [ICASSP11]_ eq. (9).
    """
    return core.sensor_fields(positions, R_sw, r, m, dr_dx, dm_dx)


def _broadcast_pair(r: ArrayLike, m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Broadcast `r` and `m` to contiguous arrays of a common shape (..., 3)."""
    r, m = np.broadcast_arrays(np.asarray(r, dtype=float), np.asarray(m, dtype=float))
    if r.shape[-1:] != (3,):
        raise ValueError(f'r and m require a last axis of length 3, got shape {r.shape}')
    return np.ascontiguousarray(r), np.ascontiguousarray(m)


def dipole_field(r: ArrayLike, m: ArrayLike) -> FloatArray:
    """Flux density of a point dipole.

    Parameters
    ----------
    r : (..., 3) array, m, world frame
        Position of the sensor relative to the source.
    m : (..., 3) array, A m², world frame
        Dipole moment; broadcasts against `r`.

    Returns
    -------
    (..., 3) array, T, world frame
        NaN at r = 0.

    Raises
    ------
    ValueError
        If the last axis is not of length 3, or if `r` and `m` do not broadcast.

    References
    ----------
    [TSP14]_ eq. (2).
    """
    return core.dipole_field(*_broadcast_pair(r, m))


def dipole_jacobians(r: ArrayLike, m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the flux density of a point dipole.

    Parameters
    ----------
    r : (..., 3) array, m, world frame
        Position of the sensor relative to the source.
    m : (..., 3) array, A m², world frame
        Dipole moment; broadcasts against `r`.

    Returns
    -------
    dB_dr : (..., 3, 3) array, T/m
        Symmetric. The derivative with respect to the source position is -dB_dr. NaN at r = 0.
    dB_dm : (..., 3, 3) array, T/(A m²)
        Symmetric. NaN at r = 0.

    Raises
    ------
    ValueError
        If the last axis is not of length 3, or if `r` and `m` do not broadcast.

    References
    ----------
    [TSP14]_ eq. (30a), (30b), with the factor mu0/(4 pi).
    """
    return core.dipole_jacobians(*_broadcast_pair(r, m))
