"""Induced moment of a vehicle that is modelled as a permeable ellipsoid of revolution."""

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
    aspect : (...) array
        Semi-axis of revolution over the transverse semi-axis: above 1 for a prolate ellipsoid
        (needle), 1 for a sphere, below 1 for an oblate ellipsoid (disk).

    Returns
    -------
    L1 : (...) array
        Factor along the axis of revolution: 1/3 for a sphere, 0 for a needle, 1 for a disk.
    L2 : (...) array
        Factor across the axis, (1 - L1)/2: 1/3 for a sphere, 1/2 for a needle, 0 for a disk.

    Raises
    ------
    ValueError
        If `aspect` is not between 1e-100 and 1e100.

    Notes
    -----
    The closed form is 0/0 for a sphere. Instead, the underlying integral, a b c/2 times the
    integral of ds/((s + a^2) sqrt(...)), is evaluated as Carlson's R_D. The integral is also valid
    for oblate ellipsoids and is accurate near the sphere. The closed form in MITRE12 contains an
    error: t2 must be m - (t1 + 1)/m. With the printed t2 = m - t1 - 1, the sum L1 + 2 L2 is 0.49 at
    m = 2 instead of 1.

    References
    ----------
    [MITRE12]_ eq. (A.2)-(A.4).
    """
    aspect = np.asarray(aspect, dtype=float)
    if not np.all((aspect >= 1e-100) & (aspect <= 1e100)):
        raise ValueError(f'aspect must be between 1e-100 and 1e100, got {aspect.tolist()}')
    squared_aspect = aspect * aspect
    return (aspect / 3 * elliprd(1.0, 1.0, squared_aspect),
            aspect / 3 * elliprd(1.0, squared_aspect, 1.0))


def ellipsoid_moment(semi_axes: Sequence[float] | FloatArray, mu_r: float, heading: ArrayLike,
                     earth_field: ArrayLike) -> FloatArray:
    """Moment induced by the Earth's field in a permeable ellipsoid of revolution.

    The axis of revolution is horizontal and points along the heading.

    Parameters
    ----------
    semi_axes : (2,) array, m
        Semi-axis of revolution and transverse semi-axis: half the length and half the width of a
        vehicle.
    mu_r : float
        Relative permeability, 1 + susceptibility; 11 in MITRE12 Table 1.
    heading : (...) array, rad, world frame
        Measured from x towards y, which is from east towards north in ENU.
    earth_field : (..., 3) array, T, world frame
        Flux density B0; all axes but the last broadcast against `heading`.

    Returns
    -------
    (..., 3) array, A m², world frame

    Raises
    ------
    ValueError
        If a semi-axis is not positive and finite, `mu_r` is below 1 or not finite, or the last axis
        of `earth_field` is not of length 3.

    Notes
    -----
    The factor B0/mu0 is printed as 2.5 B0/pi in MITRE12, which is equal for B0 in microtesla. In
    MITRE12, the moment is in the vehicle frame, and the course is clockwise from north. In MITRE12
    eq. (A.6), the vertical field is positive downwards although the third axis points up.

    References
    ----------
    [MITRE12]_ eq. (A.1), (A.5)-(A.7).
    """
    a, b = semi_axes
    if not (0.0 < a < math.inf and 0.0 < b < math.inf):
        raise ValueError(f'semi_axes must be positive and finite, got {a}, {b}')
    if not 1.0 <= mu_r < math.inf:
        raise ValueError(f'mu_r must be at least 1 and finite, got {mu_r}')
    earth_field, heading = np.asarray(earth_field, dtype=float), np.asarray(heading, dtype=float)
    if earth_field.shape[-1:] != (3,):
        raise ValueError('earth_field requires a last axis of length 3, got shape '
                         f'{earth_field.shape}')
    volume = 4.0 / 3.0 * math.pi * a * b * b
    kappa = mu_r - 1.0
    p1, p2 = (volume * kappa / (1.0 + kappa * L) for L in demagnetisation_factors(a / b))
    axis = np.stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)], axis=-1)
    axial_field = np.sum(axis * earth_field, axis=-1, keepdims=True)
    moment: FloatArray = (p2 * earth_field + (p1 - p2) * axial_field * axis) / MU0
    return moment
