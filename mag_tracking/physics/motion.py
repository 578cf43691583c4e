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
    """Process noise covariance (6, 6) of positions, then rates, driven by white noise over `dt`.

    For each axis it is density * [[dt^3/3, dt^2/2], [dt^2/2, dt]]; `density` (3,) is the spectral
    density of the second derivative. PHD15 Paper A eq. (24), the correct form of eq. (18).
    """
    Q, density = np.zeros((6, 6)), np.asarray(density, dtype=float)
    Q[_INTEGRAL, _INTEGRAL] = density * (dt**3 / 3.0)
    Q[_INTEGRAL, _RATE] = Q[_RATE, _INTEGRAL] = density * (dt**2 / 2.0)
    Q[_RATE, _RATE] = density * dt
    return Q


def constant_velocity(dt: float) -> FloatArray:
    """Transition matrix (6, 6) of x, y, z, vx, vy, vz at constant velocity."""
    F = np.eye(6)
    F[_INTEGRAL, _RATE] = dt
    return F


def coordinated_turn(x: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Propagate states (n, n_x) along an arc at constant turn rate; return also the Jacobians.

    The first six states are position and velocity, the last is the turn rate [rad/s], anticlockwise
    from above; a negative `dt` propagates backwards. [BarShalom01]_ section 11.7.
    """
    return decaying_turn(x, dt, 1.0, 1.0)


def decaying_turn(x: FloatArray, dt: float, mean_factor: float, final_factor: float
                ) -> tuple[FloatArray, FloatArray]:
    """Propagate states as `coordinated_turn`, with a turn rate whose mean over `dt` and final value
    are the given factors of the initial rate."""
    return core.propagate_turn(np.ascontiguousarray(x, dtype=float), dt, mean_factor, final_factor)
