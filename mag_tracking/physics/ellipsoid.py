"""A permeable ellipsoid of revolution in the earth's field: a vehicle's induced moment."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import elliprd

from mag_tracking.arrays import FloatArray
from mag_tracking.physics.dipole import MU0


def demagnetisation_factors(aspect: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Demagnetisation factors of an ellipsoid of revolution.

    Parameters
    ----------
    aspect : (...)
        Semi-axis of revolution over the transverse one: above 1 prolate (needle),
        1 a sphere, below 1 oblate (disk).

    Returns
    -------
    L1, L2 : (...)
        Along the axis of revolution and across it; L1 + 2 L2 = 1.
        Sphere 1/3, 1/3; needle 0, 1/2; disk 1, 0.

    Raises ValueError where the aspect is not between 1e-100 and 1e100.

    Source: MITRE12 eq. (A.2)-(A.4), corrected: t2 = m - (t1 + 1)/m; the printed
    t2 = m - t1 - 1 gives L1 + 2 L2 = 0.49 at m = 2. Evaluated as the integral
    they come from, a b c/2 int ds/((s + a^2) sqrt(...)), which is Carlson's R_D:
    it holds for oblate ellipsoids, too, and loses no digits near the sphere,
    where the printed form is 0/0.
    """
    aspect = np.asarray(aspect, dtype=float)
    if not np.all((aspect >= 1e-100) & (aspect <= 1e100)):
        raise ValueError(f'aspect has to be between 1e-100 and 1e100, got {aspect.tolist()}')
    square = aspect * aspect
    return aspect / 3 * elliprd(1.0, 1.0, square), aspect / 3 * elliprd(1.0, square, 1.0)


def ellipsoid_moment(semi_axes: Sequence[float] | FloatArray, mu_r: float, heading: ArrayLike,
                     earth_field: ArrayLike) -> FloatArray:
    """Moment that the earth's field induces in a permeable ellipsoid of revolution.

    The axis of revolution is horizontal and points along the heading.

    Parameters
    ----------
    semi_axes : (2,) [m]
        Along the axis of revolution and across it; half a vehicle's length and
        half its width.
    mu_r : float
        Relative permeability, 1 plus the susceptibility: 11 in MITRE12's table 1.
    heading : (...) [rad], world
        From the x axis towards y: from east towards north in ENU.
    earth_field : (..., 3) [T], world
        Flux density B0; its last axis apart it broadcasts against `heading`.

    Returns
    -------
    (..., 3) [A m^2], world

    Raises ValueError where a semi-axis is not above 0, or mu_r not finite and at
    least 1.

    Source: MITRE12 eq. (A.1), (A.5)-(A.7), corrected: the factor printed as
    2.5 B0/pi is B0/mu0 (with B0 in microtesla it is that number). MITRE12 gives
    the moment in the vehicle's axes, its course from north clockwise, and in
    (A.6) the vertical field downwards on axes whose third points up.
    """
    a, b = semi_axes
    if not (0.0 < a < math.inf and 0.0 < b < math.inf):
        raise ValueError(f'semi_axes have to be above 0 and finite, got {a}, {b}')
    if not 1.0 <= mu_r < math.inf:
        raise ValueError(f'mu_r has to be at least 1 and finite, got {mu_r}')
    earth_field, heading = np.asarray(earth_field, dtype=float), np.asarray(heading, dtype=float)
    if earth_field.shape[-1:] != (3,):
        raise ValueError(f'earth_field needs a last axis of length 3, got {earth_field.shape}')
    volume = 4.0 / 3.0 * math.pi * a * b * b
    kappa = mu_r - 1.0
    p1, p2 = (volume * kappa / (1.0 + kappa * L) for L in demagnetisation_factors(a / b))
    axis = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=-1)
    along = np.sum(axis * earth_field, axis=-1, keepdims=True)
    moment: FloatArray = (p2 * earth_field + (p1 - p2) * along * axis) / MU0
    return moment
