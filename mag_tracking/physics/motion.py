"""Motion models, exactly discretised.

Only the exact form of the process noise is supported: white noise drives the
highest derivative in continuous time. (T10 eq. (4.2) and ICASSP11 eq. (2)
hold it constant over a sample, and PHD15 Paper A eq. (18) is misprinted.)
"""

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray

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
