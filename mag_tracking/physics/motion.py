"""Motion models, exactly discretised.

Only the exact form of the process noise is supported: white noise drives the
highest derivative in continuous time. (T10 eq. (4.2) and ICASSP11 eq. (2)
hold it constant over a sample, and PHD15 Paper A eq. (18) is misprinted.)
"""

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray

SMALL = 1e-4
"""[rad] Below it the slope of a chord is taken from its series."""

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
    v, half = x[:, 3:5], 0.5 * dt * x[:, -1]
    # The chord of the arc: half the angle off the velocity, and a little shorter than the way.
    chord, slope = np.sinc(half / np.pi), np.where(
        np.abs(half) > SMALL, (np.cos(half) - np.sinc(half / np.pi)) / np.where(half, half, 1.0),
        -half / 3.0)
    R_half, R = _turns(half), _turns(2.0 * half)
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    F = np.zeros((*x.shape, x.shape[1]))
    F[:] = np.eye(x.shape[1])
    F[:, 2, 5] = dt
    F[:, :2, 3:5] = (dt * chord)[:, None, None] * R_half
    F[:, 3:5, 3:5] = R
    along = np.einsum('nij,nj->ni', R_half, v)
    F[:, :2, -1] = 0.5 * dt**2 * (slope[:, None] * along + chord[:, None] * along @ quarter.T)
    F[:, 3:5, -1] = dt * np.einsum('nij,nj->ni', R, v) @ quarter.T
    moved = x.copy()
    moved[:, :2] += (dt * chord)[:, None] * along
    moved[:, 2] += dt * x[:, 5]
    moved[:, 3:5] = np.einsum('nij,nj->ni', R, v)
    return moved, F


def _turns(angle: FloatArray) -> FloatArray:
    """(n, 2, 2) rotations by `angle` (n,) [rad], anticlockwise."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
