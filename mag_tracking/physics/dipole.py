"""The magnetic dipole: field and derivatives.

Three tiers: scalar kernels (compiled, one sensor and one source) that the
estimators call, and array functions over them for people.
"""

import math
from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from mag_tracking.arrays import CompileOptions, FloatArray
from mag_tracking.compiled import compiled_when_used

MU0 = 4e-7 * math.pi
"""Vacuum permeability [T m / A], the value of the source documents."""

K_DIPOLE = 1e-7
"""mu0 / 4 pi [T m / A]."""

_COMPILE: CompileOptions = {'error_model': 'numpy', 'fastmath': {'contract'}}
"""Fused multiply-add is allowed, nothing else that would change a result."""


_INLINE: CompileOptions = {'error_model': 'numpy', 'fastmath': {'contract'}, 'forceinline': True}
"""For kernels that pass scalars: small arrays would cost more than the arithmetic."""

Vector: TypeAlias = tuple[float, float, float]
Symmetric: TypeAlias = tuple[float, float, float, float, float, float]
"""The upper triangle of a symmetric (3, 3), row by row."""


@njit(**_INLINE)
def field_and_jacobians(d0: float, d1: float, d2: float, m0: float, m1: float, m2: float
                        ) -> tuple[Vector, Symmetric, Symmetric]:
    """Field and both Jacobians of one dipole at one point, as scalars.

    `d` is sensor minus source [m], `m` the moment [A m^2]. Returns B (3) [T] and
    the upper triangles, row by row (6 each), of dB/dd [T/m] and dB/dm [T/(A m^2)];
    all are NaN where |d| = 0.

    Source: TSP14 eq. (2), (30a), (30b), with the factor mu0/4pi.
    """
    inv2 = 1.0 / (d0 * d0 + d1 * d1 + d2 * d2)
    k3 = K_DIPOLE * inv2 * math.sqrt(inv2)
    a = 3.0 * k3 * inv2
    e = a * (d0 * m0 + d1 * m1 + d2 * m2)
    f = 5.0 * e * inv2
    return ((e * d0 - k3 * m0, e * d1 - k3 * m1, e * d2 - k3 * m2),
            (2.0 * a * d0 * m0 - f * d0 * d0 + e,
             a * (d0 * m1 + d1 * m0) - f * d0 * d1,
             a * (d0 * m2 + d2 * m0) - f * d0 * d2,
             2.0 * a * d1 * m1 - f * d1 * d1 + e,
             a * (d1 * m2 + d2 * m1) - f * d1 * d2,
             2.0 * a * d2 * m2 - f * d2 * d2 + e),
            (a * d0 * d0 - k3, a * d0 * d1, a * d0 * d2,
             a * d1 * d1 - k3, a * d1 * d2, a * d2 * d2 - k3))


@njit(**_INLINE)
def _row_times_symmetric(a: float, b: float, c: float, S: Symmetric) -> Vector:
    """[a b c] S of a symmetric S given as its upper triangle."""
    s00, s01, s02, s11, s12, s22 = S
    return a * s00 + b * s01 + c * s02, a * s01 + b * s11 + c * s12, a * s02 + b * s12 + c * s22


@compiled_when_used(
    'void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1])',
    **_COMPILE)
def _field_and_jacobians_rows(d: FloatArray, m: FloatArray, B: FloatArray, dB_dd: FloatArray,
                              dB_dm: FloatArray) -> None:
    """Loop of `field_and_jacobians` over rows."""
    for i in range(d.shape[0]):
        b, dd, dm = field_and_jacobians(d[i, 0], d[i, 1], d[i, 2], m[i, 0], m[i, 1], m[i, 2])
        B[i, 0], B[i, 1], B[i, 2] = b
        for J, (j00, j01, j02, j11, j12, j22) in ((dB_dd, dd), (dB_dm, dm)):
            J[i, 0, 0], J[i, 0, 1], J[i, 0, 2] = j00, j01, j02
            J[i, 1, 0], J[i, 1, 1], J[i, 1, 2] = j01, j11, j12
            J[i, 2, 0], J[i, 2, 1], J[i, 2, 2] = j02, j12, j22


@compiled_when_used(
    'void(float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], '
    'float64[:,:,:,::1], float64[:,:,:,::1], float64[:,:,::1], float64[:,:,:,::1], '
    'float64[:,::1])', **_COMPILE)
def _sensor_fields(positions: FloatArray, R_sw: FloatArray, r: FloatArray, m: FloatArray,
                   dr_dx: FloatArray, dm_dx: FloatArray, h: FloatArray, H: FloatArray,
                   gradient: FloatArray) -> None:
    """Loop of `field_and_jacobians` over hypotheses, sensors, dipoles; adds to zeros but for H."""
    n_hyp, n_dip, n_t = dr_dx.shape[0], dr_dx.shape[1], dr_dx.shape[3]
    for p in range(n_hyp):
        for j in range(positions.shape[0]):
            for s in range(n_dip):
                d0, d1, d2 = (positions[j, 0] - r[p, s, 0], positions[j, 1] - r[p, s, 1],
                              positions[j, 2] - r[p, s, 2])
                m0, m1, m2 = m[p, s, 0], m[p, s, 1], m[p, s, 2]
                (b0, b1, b2), dB_dd, dB_dm = field_and_jacobians(d0, d1, d2, m0, m1, m2)
                square = d0 * d0 + d1 * d1 + d2 * d2
                gradient[p, j] += (K_DIPOLE * math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
                                   / (square * square))
                # Turned into the sensor's frame first: 3 x 3 products are cheaper than 3 x n_t.
                for i in range(3):
                    u, v, w = R_sw[j, i, 0], R_sw[j, i, 1], R_sw[j, i, 2]
                    g0, g1, g2 = _row_times_symmetric(u, v, w, dB_dd)
                    q0, q1, q2 = _row_times_symmetric(u, v, w, dB_dm)
                    h[p, j, i] += u * b0 + v * b1 + w * b2
                    for c in range(n_t):
                        if s == 0:
                            H[p, j, i, c] = 0.0
                        H[p, j, i, c] += (
                            q0 * dm_dx[p, s, 0, c] + q1 * dm_dx[p, s, 1, c]
                            + q2 * dm_dx[p, s, 2, c] - g0 * dr_dx[p, s, 0, c]
                            - g1 * dr_dx[p, s, 1, c] - g2 * dr_dx[p, s, 2, c])


def sensor_fields(positions: FloatArray, R_sw: FloatArray, r: FloatArray, m: FloatArray,
                  dr_dx: FloatArray, dm_dx: FloatArray
                  ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Field of moving dipoles at fixed sensors, with its derivative by the state.

    Parameters
    ----------
    positions : (n_sensors, 3) [m], world
    R_sw : (n_sensors, 3, 3)
        Rotations world to sensor.
    r, m : (n_hyp, n_dipoles, 3) [m], [A m^2], world
        Positions and moments.
    dr_dx, dm_dx : (n_hyp, n_dipoles, 3, n_t)
        Their derivatives by the target state.

    Returns
    -------
    h : (n_hyp, n_sensors, 3) [T], sensor frame
    H : (n_hyp, n_sensors, 3, n_t)
    gradient : (n_hyp, n_sensors) [T/m]
        Sum of mu0/4pi |m| / |d|^4: the size of the first neglected multipole term
        for dipoles that stand for one metre each (ICASSP11 eq. (9)). Neighbours in a
        body err alike, so sizes are added and not squares.
        NaN and infinite where a dipole sits on a sensor.
    """
    n_hyp, n_sensors, n_t = len(r), len(positions), dr_dx.shape[-1]
    h = np.zeros((n_hyp, n_sensors, 3))
    H = np.empty((n_hyp, n_sensors, 3, n_t))
    gradient = np.zeros((n_hyp, n_sensors))
    _sensor_fields(positions, R_sw, r, m, dr_dx, dm_dx, h, H, gradient)
    return h, H, gradient


def _evaluate(r: ArrayLike, m: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Broadcast, flatten, run the kernel; field and Jacobians in the broadcast shape."""
    r, m = np.broadcast_arrays(np.asarray(r, dtype=float), np.asarray(m, dtype=float))
    if r.shape[-1:] != (3,):
        raise ValueError(f'r and m need a last axis of length 3, got {r.shape}')
    shape = r.shape
    # Copied: the kernels refuse arrays that may not be written.
    r, m = r.reshape(-1, 3).copy(), m.reshape(-1, 3).copy()
    B = np.empty_like(r)
    dB_dd = np.empty((len(r), 3, 3))
    dB_dm = np.empty((len(r), 3, 3))
    _field_and_jacobians_rows(r, m, B, dB_dd, dB_dm)
    return B.reshape(shape), dB_dd.reshape(shape + (3,)), dB_dm.reshape(shape + (3,))


def dipole_field(r: ArrayLike, m: ArrayLike) -> FloatArray:
    """Flux density of a point dipole.

    Parameters
    ----------
    r : (..., 3) [m], world
        Sensor minus source position.
    m : (..., 3) [A m^2], world
        Dipole moment; broadcasts against `r`.

    Returns
    -------
    (..., 3) [T], world
        NaN where |r| = 0.

    Source: TSP14 eq. (2).
    """
    return _evaluate(r, m)[0]


def dipole_jacobians(r: ArrayLike, m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the dipole field.

    Parameters
    ----------
    r : (..., 3) [m], world
        Sensor minus source position.
    m : (..., 3) [A m^2], world
        Dipole moment; broadcasts against `r`.

    Returns
    -------
    dB_dr : (..., 3, 3) [T/m]
        With respect to `r`; the one with respect to the source is its negative.
    dB_dm : (..., 3, 3) [T/(A m^2)]
        Both symmetric; NaN where |r| = 0.

    Source: TSP14 eq. (30a), (30b), with the factor mu0/4pi.
    """
    return _evaluate(r, m)[1:]
