"""The magnetic dipole: field and derivatives."""

import math

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core

MU0 = 4e-7 * math.pi
"""Vacuum permeability [T m / A], the value of the source documents."""

K_DIPOLE = core.K_DIPOLE
"""mu0 / 4 pi [T m / A]."""


def sensor_fields(positions: FloatArray, R_sw: FloatArray, r: FloatArray, m: FloatArray,
                  dr_dx: FloatArray, dm_dx: FloatArray
                  ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Field of moving dipoles at fixed sensors, with its derivative by the state.

    Parameters
    ----------
    positions : (n_sensors, 3) [m], world
    R_sw : (n_sensors, 3, 3)
        Rotations world to sensor.
    r, m : (n_hyp, n_dipoles, 3) [m], [A m^2], world
        Positions and moments.
    dr_dx, dm_dx : (n_hyp, n_dipoles, 3, n_t)
        Their derivatives by the target state.

    Returns
    -------
    h : (n_hyp, n_sensors, 3) [T], sensor frame
    H : (n_hyp, n_sensors, 3, n_t)
    gradient : (n_hyp, n_sensors) [T/m]
        Sum of mu0/4pi |m| / |d|^4: the size of the first neglected multipole term
        for dipoles that stand for one metre each (ICASSP11 eq. (9)). Neighbours in a
        body err alike, so sizes are added and not squares.
        NaN and infinite where a dipole sits on a sensor.
    """
    return core.sensor_fields(positions, R_sw, r, m, dr_dx, dm_dx)


def _broadcast_pair(r: ArrayLike, m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Both in the shape that they broadcast to."""
    r, m = np.broadcast_arrays(np.asarray(r, dtype=float), np.asarray(m, dtype=float))
    if r.shape[-1:] != (3,):
        raise ValueError(f'r and m need a last axis of length 3, got {r.shape}')
    return np.ascontiguousarray(r), np.ascontiguousarray(m)


def dipole_field(r: ArrayLike, m: ArrayLike) -> FloatArray:
    """Flux density of a point dipole.

    Parameters
    ----------
    r : (..., 3) [m], world
        Sensor minus source position.
    m : (..., 3) [A m^2], world
        Dipole moment; broadcasts against `r`.

    Returns
    -------
    (..., 3) [T], world
        NaN where |r| = 0.

    Source: TSP14 eq. (2).
    """
    return core.dipole_field(*_broadcast_pair(r, m))


def dipole_jacobians(r: ArrayLike, m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the dipole field.

    Parameters
    ----------
    r : (..., 3) [m], world
        Sensor minus source position.
    m : (..., 3) [A m^2], world
        Dipole moment; broadcasts against `r`.

    Returns
    -------
    dB_dr : (..., 3, 3) [T/m]
        With respect to `r`; the one with respect to the source is its negative.
    dB_dm : (..., 3, 3) [T/(A m^2)]
        Both symmetric; NaN where |r| = 0.

    Source: TSP14 eq. (30a), (30b), with the factor mu0/4pi.
    """
    return core.dipole_jacobians(*_broadcast_pair(r, m))
