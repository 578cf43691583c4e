"""A dipole that passes a sensor on a straight line, in the Anderson functions.

Positions are target minus sensor, as in TSP14; the field of a dipole is even in
them. One pass at a time.
"""

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core
from mag_tracking.physics.dipole import K_DIPOLE


def anderson_functions(tau: ArrayLike) -> FloatArray:
    """The three Anderson functions tau^n / (tau^2 + 1)^(5/2), n = 0, 1, 2.

    Parameters
    ----------
    tau : (...)
        Time from the closest approach, in units of its range over the speed.

    Returns
    -------
    (..., 3)
        The middle one is odd and orthogonal to the others; those two are not
        orthogonal to each other, against what TSP14 says.

    Source: TSP14 eq. (23), corrected: the exponent is 5/2, printed is n/2.
    """
    tau = np.asarray(tau, dtype=float)
    # Powers of 1/(tau^2 + 1) and of tau/sqrt(tau^2 + 1), which cannot overflow.
    cosine = 1.0 / np.hypot(tau, 1.0)
    sine = tau * cosine
    f: FloatArray = cosine[..., None]**3 * np.stack([cosine**2, sine * cosine, sine**2], axis=-1)
    return f


def closest_approach(r0: ArrayLike, v0: ArrayLike) -> tuple[float, float, FloatArray]:
    """Closest point of approach of a straight pass.

    Parameters
    ----------
    r0 : (3,) [m]
        Target minus sensor position at time zero.
    v0 : (3,) [m/s]
        Velocity of the target.

    Returns
    -------
    time : float [s]
    range : float [m]
        Zero where the line goes through the sensor, r0 parallel to v0; to
        rounding, a range below 1e-15 |r0| is taken as zero.
    r_cpa : (3,) [m]
        Target minus sensor position at that time, perpendicular to v0.

    Raises ValueError where v0 is zero or not finite.

    Source: TSP14 eq. (24).
    """
    r0, v0 = _checked_vector('r0', r0), _checked_vector('v0', v0)
    speed = np.linalg.norm(v0)
    if not 0.0 < speed < np.inf:
        raise ValueError(f'v0 has to be finite and not zero, got {v0.tolist()}')
    direction = v0 / speed
    path = -(r0 @ direction)
    r_cpa = r0 + path * direction
    # Once more, since the difference keeps a share along v0 of the rounding of r0.
    r_cpa -= (r_cpa @ direction) * direction
    distance = float(np.linalg.norm(r_cpa))
    if distance <= 1e-15 * np.linalg.norm(r0):
        distance, r_cpa = 0.0, np.zeros(3)
    return float(path / speed), distance, r_cpa


def anderson_coefficients(r_cpa: ArrayLike, v0: ArrayLike, m: ArrayLike) -> FloatArray:
    """Coefficients of the Anderson functions of a straight pass.

    Parameters
    ----------
    r_cpa : (3,) [m]
        Target minus sensor position at the closest approach.
    v0 : (3,) [m/s]
        Velocity of the target; only its direction counts.
    m : (3,) [A m^2]
        Dipole moment.

    Returns
    -------
    (3, 3) [T]
        The field is this matrix times the Anderson functions; NaN where r_cpa is
        zero.

    Raises ValueError where v0 is zero or r_cpa not perpendicular to it (1e-6).

    Source: TSP14 eq. (25)-(26), corrected: (25c) has a plus between its terms.
    """
    r_cpa, v0, m = (_checked_vector('r_cpa', r_cpa), _checked_vector('v0', v0),
                    _checked_vector('m', m))
    distance, speed = np.linalg.norm(r_cpa), np.linalg.norm(v0)
    if not 0.0 < speed < np.inf:
        raise ValueError(f'v0 has to be finite and not zero, got {v0.tolist()}')
    if distance == 0.0:
        return np.full((3, 3), np.nan)
    r, v = r_cpa / distance, v0 / speed
    if abs(r @ v) > 1e-6:
        raise ValueError('r_cpa has to be perpendicular to v0; the cosine between them is '
                         f'{r @ v:.3g}')
    c1 = 3 * (r @ m) * r - m
    c2 = 3 * (r @ m) * v + 3 * (v @ m) * r
    c3 = 3 * (v @ m) * v - m
    return K_DIPOLE / distance**3 * np.stack([c1, c2, c3], axis=-1)


def anderson_field(t: ArrayLike, r0: ArrayLike, v0: ArrayLike, m: ArrayLike) -> FloatArray:
    """Flux density at the sensor of a dipole on a straight pass.

    Parameters
    ----------
    t : (...) [s]
        Times, from the one at which the target is at `r0`.
    r0 : (3,) [m]
        Target minus sensor position at time zero.
    v0 : (3,) [m/s]
        Velocity of the target.
    m : (3,) [A m^2]
        Dipole moment, constant.

    Returns
    -------
    (..., 3) [T]
        The dipole field, written in other terms. NaN at all times where the line
        goes through the sensor: the expansion has no scale there.

    Raises ValueError where v0 is zero.

    Source: TSP14 eq. (22), without the background B0.
    """
    t_cpa, distance, r_cpa = closest_approach(r0, v0)
    C = anderson_coefficients(r_cpa, v0, m)
    if distance == 0.0:
        return np.full(np.shape(t) + (3,), np.nan)
    tau = (np.asarray(t, dtype=float) - t_cpa) * (np.linalg.norm(v0) / distance)
    return anderson_functions(tau) @ C.T


def anderson_residual(t: FloatArray, y: FloatArray, time: float, scale: float) -> float:
    """What is left of a measured field without the Anderson functions of a pass and a constant.

    Parameters
    ----------
    t : (n,) [s]
    y : (n, k)
        Fields, whitened; contiguous.
    time : float [s]
        Of the closest approach.
    scale : float [s]
        Range at the closest approach over the speed.

    Returns
    -------
    float
        Sum of squares of `y`, where the functions are fitted to each of its columns.

    Source: TSP14 eq. (22), (23), with the exponent 5/2.
    """
    return core.anderson_residual(t, y, time, scale)


def _checked_vector(name: str, value: ArrayLike) -> FloatArray:
    """The value as a vector of three."""
    value = np.asarray(value, dtype=float)
    if value.shape != (3,):
        raise ValueError(f'{name} needs the shape (3,), got {value.shape}')
    return value
