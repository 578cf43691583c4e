"""Field of a dipole on a straight pass, expanded in Anderson functions.

Position vectors point from the sensor to the target, as in TSP14. Their sign does not affect the
field of a dipole.
"""

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core
from mag_tracking.physics.dipole import K_DIPOLE


def anderson_functions(tau: ArrayLike) -> FloatArray:
    """Anderson functions tau^n / (tau^2 + 1)^(5/2), n = 0, 1, 2, (..., 3); TSP14 eq. (23).

    `tau` is (t - t_cpa) times speed over range at the closest point of approach (CPA). TSP14 prints
    the exponent n/2. The odd function n = 1 is orthogonal to the others; contrary to TSP14, n = 0
    and n = 2 are not orthogonal to each other.
    """
    tau = np.asarray(tau, dtype=float)
    # Powers of 1/(tau^2 + 1) and of tau/sqrt(tau^2 + 1) cannot overflow.
    cosine = 1.0 / np.hypot(tau, 1.0)
    sine = tau * cosine
    f: FloatArray = cosine[..., None]**3 * np.stack([cosine**2, sine * cosine, sine**2], axis=-1)
    return f


def closest_approach(r0: ArrayLike, v0: ArrayLike) -> tuple[float, float, FloatArray]:
    """Time, range and relative position of the closest point of approach (CPA) of a pass.

    `r0` [m] is the position relative to the sensor at time zero, `v0` [m/s] the velocity. The range
    is zero if they are parallel (below 1e-15 ‖r0‖). Raises ValueError if `v0` is zero or not
    finite. TSP14 eq. (24).
    """
    r0, v0 = _checked_vector('r0', r0), _checked_vector('v0', v0)
    speed = np.linalg.norm(v0)
    if not 0.0 < speed < np.inf:
        raise ValueError(f'v0 must be finite and non-zero, got {v0.tolist()}')
    direction = v0 / speed
    travelled = -(r0 @ direction)
    r_cpa = r0 + travelled * direction
    # Project twice: rounding of r0 leaves a component along v0 in the first difference.
    r_cpa -= (r_cpa @ direction) * direction
    distance = float(np.linalg.norm(r_cpa))
    if distance <= 1e-15 * np.linalg.norm(r0):
        distance, r_cpa = 0.0, np.zeros(3)
    return float(travelled / speed), distance, r_cpa


def anderson_coefficients(r_cpa: ArrayLike, v0: ArrayLike, m: ArrayLike) -> FloatArray:
    """Coefficients C (3, 3) [T] of the field B = C f(tau), with f of `anderson_functions`.

    `r_cpa` [m] is the position relative to the sensor at the CPA; of `v0` only the direction is
    used. NaN if `r_cpa` is zero. Raises ValueError if `v0` is zero or not finite, or not
    perpendicular to `r_cpa` (cosine above 1e-6). TSP14 eq. (25), (26); the two terms of (25c) are
    added, the printed sign is wrong.
    """
    r_cpa, v0, m = (_checked_vector('r_cpa', r_cpa), _checked_vector('v0', v0),
                    _checked_vector('m', m))
    distance, speed = np.linalg.norm(r_cpa), np.linalg.norm(v0)
    if not 0.0 < speed < np.inf:
        raise ValueError(f'v0 must be finite and non-zero, got {v0.tolist()}')
    if distance == 0.0:
        return np.full((3, 3), np.nan)
    r, v = r_cpa / distance, v0 / speed
    if abs(r @ v) > 1e-6:
        raise ValueError('r_cpa must be perpendicular to v0; the cosine between them is '
                         f'{r @ v:.3g}')
    c1 = 3 * (r @ m) * r - m
    c2 = 3 * (r @ m) * v + 3 * (v @ m) * r
    c3 = 3 * (v @ m) * v - m
    return K_DIPOLE / distance**3 * np.stack([c1, c2, c3], axis=-1)


def anderson_field(t: ArrayLike, r0: ArrayLike, v0: ArrayLike, m: ArrayLike) -> FloatArray:
    """Flux density (..., 3) [T] of a dipole on a straight pass; TSP14 eq. (22) without B0.

    The target is at `r0` [m] relative to the sensor at t = 0. Equal to `dipole.dipole_field`, but
    NaN at all times if the path passes through the sensor. Raises ValueError if `v0` is zero or not
    finite.
    """
    t_cpa, distance, r_cpa = closest_approach(r0, v0)
    C = anderson_coefficients(r_cpa, v0, m)
    if distance == 0.0:
        return np.full(np.shape(t) + (3,), np.nan)
    tau = (np.asarray(t, dtype=float) - t_cpa) * (np.linalg.norm(v0) / distance)
    return anderson_functions(tau) @ C.T


def anderson_residual(t: FloatArray, y: FloatArray, time: float, scale: float) -> float:
    """Residual sum of squares of a fit of Anderson functions and a constant to each column of `y`.

    `t` (n,) is in s, `y` (n, k) whitened and contiguous; `time` is that of the CPA and `scale` [s]
    its range over the speed. TSP14 eq. (22), (23), with the exponent 5/2.
    """
    return core.anderson_residual(t, y, time, scale)


def _checked_vector(name: str, value: ArrayLike) -> FloatArray:
    """Convert `value` to a (3,) array; raise ValueError for any other shape."""
    value = np.asarray(value, dtype=float)
    if value.shape != (3,):
        raise ValueError(f'{name} must have shape (3,), got {value.shape}')
    return value
