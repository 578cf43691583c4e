"""Motion models, exactly discretised; a turn at a rate that stays as it is.

Only the exact form of the process noise is supported: white noise drives the
highest derivative in continuous time. (T10 eq. (4.2) and ICASSP11 eq. (2)
hold it constant over a sample, and PHD15 Paper A eq. (18) is misprinted.)
"""

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core

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
    return fading_turn(x, dt, 1.0, 1.0)


def fading_turn(x: FloatArray, dt: float, mean: float, fading: float
                ) -> tuple[FloatArray, FloatArray]:
    """As `coordinated_turn`, at a rate that changes.

    Over `dt` its mean is `mean` times that at the beginning; at the end it is `fading` times that.
    """
    return core.turned(np.ascontiguousarray(x, dtype=float), dt, mean, fading)
