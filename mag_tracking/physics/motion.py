"""Motion models, exactly discretised; a turn at a rate that stays as it is.

Only the exact form of the process noise is supported: white noise drives the
highest derivative in continuous time. (T10 eq. (4.2) and ICASSP11 eq. (2)
hold it constant over a sample, and PHD15 Paper A eq. (18) is misprinted.)
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.compiled import compiled_when_used

SMALL = 1e-4
"""[rad] Below it the chord of an arc is taken from its series."""

_INTEGRAL, _RATE = np.arange(3), np.arange(3, 6)


def integrator_noise(dt: float, density: ArrayLike) -> FloatArray:
    """Process noise of a double integrator driven by white noise.

    Parameters
    ----------
    dt : float [s]
    density : (3,) [unit^2/s^3]
        Spectral density of the second derivative, per axis.

    Returns
    -------
    (6, 6)
        density * [[T^3/3, T^2/2], [T^2/2, T]], first three rows the integral.

    Source: PHD15 Paper A eq. (24), the form that (18) should have.
    """
    Q, density = np.zeros((6, 6)), np.asarray(density, dtype=float)
    Q[_INTEGRAL, _INTEGRAL] = density * (dt**3 / 3.0)
    Q[_INTEGRAL, _RATE] = Q[_RATE, _INTEGRAL] = density * (dt**2 / 2.0)
    Q[_RATE, _RATE] = density * dt
    return Q


def constant_velocity(dt: float) -> FloatArray:
    """Transition matrix (6, 6) of position and velocity over `dt` seconds."""
    F = np.eye(6)
    F[_INTEGRAL, _RATE] = dt
    return F


def coordinated_turn(x: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Turn the horizontal velocity at a constant rate, and move along the arc.

    Parameters
    ----------
    x : (n, n_x)
        States that begin with position [m] and velocity [m/s] and end with the rate [rad/s],
        anticlockwise seen from above.
    dt : float [s]

    Returns
    -------
    moved : (n, n_x)
    F : (n, n_x, n_x)
        Its derivative.

    Source: Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and
    Navigation, section 11.7.
    """
    moved = np.array(x, dtype=float, order='C')
    F = np.zeros((*x.shape, x.shape[1]))
    _turn(moved, dt, F)
    return moved, F


@compiled_when_used('void(float64[:,::1], float64, float64[:,:,::1])', error_model='numpy')
def _turn(x: FloatArray, dt: float, F: FloatArray) -> None:
    """The same, in place; the derivative comes as zeros."""
    n_x = x.shape[1]
    w = n_x - 1
    for p in range(len(x)):
        vx, vy, half = x[p, 3], x[p, 4], 0.5 * dt * x[p, w]
        # The chord of the arc: half the angle off the velocity, and a little shorter than the way.
        c, s = math.cos(half), math.sin(half)
        chord, slope = 1.0 - half * half / 6.0, -half / 3.0
        if abs(half) > SMALL:
            chord = s / half
            slope = (c - chord) / half
        along_x, along_y = c * vx - s * vy, s * vx + c * vy
        turned_x, turned_y = c * along_x - s * along_y, s * along_x + c * along_y
        for a in range(n_x):
            F[p, a, a] = 1.0
        F[p, 0, 3] = F[p, 1, 4] = dt * chord * c
        F[p, 1, 3] = dt * chord * s
        F[p, 0, 4] = -F[p, 1, 3]
        F[p, 2, 5] = dt
        F[p, 3, 3] = F[p, 4, 4] = c * c - s * s
        F[p, 4, 3] = 2.0 * s * c
        F[p, 3, 4] = -F[p, 4, 3]
        F[p, 0, w] = 0.5 * dt * dt * (slope * along_x - chord * along_y)
        F[p, 1, w] = 0.5 * dt * dt * (slope * along_y + chord * along_x)
        F[p, 3, w], F[p, 4, w] = -dt * turned_y, dt * turned_x
        x[p, 0] += dt * chord * along_x
        x[p, 1] += dt * chord * along_y
        x[p, 2] += dt * x[p, 5]
        x[p, 3], x[p, 4] = turned_x, turned_y
