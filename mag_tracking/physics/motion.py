"""Exactly discretised motion models: constant velocity and coordinated turn.

The process noise is the exact discretisation of continuous white noise in the highest derivative.
T10 eq. (4.2) and ICASSP11 eq. (2) instead assume noise that is constant over a sample. PHD15 Paper
A eq. (18) is misprinted.
"""

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core

_INTEGRAL, _RATE = np.arange(3), np.arange(3, 6)


def integrator_noise(dt: float, density: ArrayLike) -> FloatArray:
    """Process noise covariance of a double integrator driven by white noise.

    Parameters
    ----------
    dt : float, s
        Time step.
    density : (3,) array, unit²/s³
        Power spectral density of the second derivative, per axis. The positions are in `unit`.

    Returns
    -------
    (6, 6) array
        For each axis, density * [[dt^3/3, dt^2/2], [dt^2/2, dt]]. The first three states are the
        integrals (positions), the last three states are their rates (velocities).

    References
    ----------
    [PHD15]_ Paper A eq. (24), the correct form of eq. (18).
    """
    Q, density = np.zeros((6, 6)), np.asarray(density, dtype=float)
    Q[_INTEGRAL, _INTEGRAL] = density * (dt**3 / 3.0)
    Q[_INTEGRAL, _RATE] = Q[_RATE, _INTEGRAL] = density * (dt**2 / 2.0)
    Q[_RATE, _RATE] = density * dt
    return Q


def constant_velocity(dt: float) -> FloatArray:
    """Transition matrix of position and velocity at constant velocity.

    Parameters
    ----------
    dt : float, s
        Time step.

    Returns
    -------
    (6, 6) array
        Matrix for the state order x, y, z, vx, vy, vz.
    """
    F = np.eye(6)
    F[_INTEGRAL, _RATE] = dt
    return F


def coordinated_turn(x: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Propagate states along an arc with a constant turn rate.

    Parameters
    ----------
    x : (n, n_x) array
        States: the first six are position [m] and velocity [m/s], the last is the turn rate
        [rad/s], anticlockwise as seen from above.
    dt : float, s
        Time step; negative to propagate backwards.

    Returns
    -------
    moved : (n, n_x) array
        States after `dt`.
    F : (n, n_x, n_x) array
        Derivative of `moved` with respect to `x`.

    References
    ----------
    [BarShalom01]_ section 11.7.
    """
    return decaying_turn(x, dt, 1.0, 1.0)


def decaying_turn(x: FloatArray, dt: float, mean_factor: float, final_factor: float
                ) -> tuple[FloatArray, FloatArray]:
    """Propagate states along an arc with a decaying turn rate.

    Parameters
    ----------
    x : (n, n_x) array
        States, as for `coordinated_turn`.
    dt : float, s
        Time step.
    mean_factor : float
        Mean turn rate over `dt`, relative to the initial rate.
    final_factor : float
        Turn rate after `dt`, relative to the initial rate.

    Returns
    -------
    moved : (n, n_x) array
        States after `dt`.
    F : (n, n_x, n_x) array
        Derivative of `moved` with respect to `x`.
    """
    return core.propagate_turn(np.ascontiguousarray(x, dtype=float), dt, mean_factor, final_factor)
