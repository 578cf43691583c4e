"""Magnetic multipoles of orders 1 to 3: dipole, quadrupole and octupole about one point.

The moment of order l is a symmetric traceless tensor with 2l + 1 independent
components. They are kept as Cartesian components in the order of the alphabet,
without those that hold z twice, which follow from the trace:

    0..2   x y z                             [A m^2]  dipole
    3..7   xx xy xz yy yz                    [A m^3]  zz = -xx - yy
    8..14  xxx xxy xxz xyy xyz yyy yyz       [A m^4]  izz = -ixx - iyy

A vector of 3, 8 or 15 moments means the orders up to 1, 2 or 3. The scale is
that of T10 eq. (3.39)-(3.40). With P the polynomial (1/l!) m_ij.. d_i d_j ..,
the field of one order is

    B = -mu0/4pi grad(P / |d|^(2l+1)),

from which the kernel takes every derivative: grad P and grad grad P are
contractions of the tensor with d, and P = d.grad(P)/l.
"""

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from mag_tracking.arrays import CompileOptions, FloatArray
from mag_tracking.compiled import compiled_when_used
from mag_tracking.physics.dipole import K_DIPOLE, Symmetric, Vector

_COMPILE: CompileOptions = {'error_model': 'numpy', 'fastmath': {'contract'}}
_INLINE: CompileOptions = {'error_model': 'numpy', 'fastmath': {'contract'}, 'forceinline': True}


@njit(**_INLINE)
def _add_order(order: int, d: Vector, s: float, inv2: float, g: Vector, H: Symmetric,
               B: FloatArray, dB_dd: FloatArray) -> None:
    """Add field and Jacobian of one order; g, H are grad P and grad grad P, s mu0/4pi/|d|^(2l+1).

    `H` is an upper triangle, row by row.
    """
    a = (2 * order + 1) * s * inv2
    e = a * (g[0] * d[0] + g[1] * d[1] + g[2] * d[2]) / order
    f = (2 * order + 3) * e * inv2
    n = 0
    for i in range(3):
        B[i] += e * d[i] - s * g[i]
        dB_dd[i, i] += e
        for j in range(i, 3):
            J = a * (d[i] * g[j] + g[i] * d[j]) - f * d[i] * d[j] - s * H[n]
            dB_dd[i, j] += J
            if j > i:
                dB_dd[j, i] += J
            n += 1


@njit(**_INLINE)
def _set_columns(order: int, d: Vector, s: float, inv2: float, gradients: Sequence[Vector],
                 first: int, dB_dm: FloatArray) -> None:
    """Set the columns of `dB_dm` from `first` on: the fields of unit components of one order."""
    a = (2 * order + 1) * s * inv2 / order
    for c in range(len(gradients)):
        g = gradients[c]
        e = a * (g[0] * d[0] + g[1] * d[1] + g[2] * d[2])
        for i in range(3):
            dB_dm[i, first + c] = e * d[i] - s * g[i]


@njit(**_INLINE)
def _times(H: Symmetric, d: Vector, scale: float) -> Vector:
    """H d scale, of a symmetric H given as its upper triangle."""
    return (scale * (H[0] * d[0] + H[1] * d[1] + H[2] * d[2]),
            scale * (H[1] * d[0] + H[3] * d[1] + H[4] * d[2]),
            scale * (H[2] * d[0] + H[4] * d[1] + H[5] * d[2]))


@njit(**_INLINE)
def _add_quadrupole(d: Vector, m: FloatArray, s: float, inv2: float, B: FloatArray,
                    dB_dd: FloatArray, dB_dm: FloatArray) -> None:
    """Order 2 of `field_and_jacobians`."""
    x, y, z = d
    H = (m[3], m[4], m[5], m[6], m[7], -m[3] - m[6])
    _add_order(2, d, s, inv2, _times(H, d, 1.0), H, B, dB_dd)
    gradients = ((x, 0.0, -z), (y, x, 0.0), (z, 0.0, x), (0.0, y, -z), (0.0, z, y))
    _set_columns(2, d, s, inv2, gradients, 3, dB_dm)


@njit(**_INLINE)
def _add_octupole(d: Vector, m: FloatArray, s: float, inv2: float, B: FloatArray,
                  dB_dd: FloatArray, dB_dm: FloatArray) -> None:
    """Order 3 of `field_and_jacobians`."""
    x, y, z = d
    xxx, xxy, xxz, xyy, xyz, yyy, yyz = m[8], m[9], m[10], m[11], m[12], m[13], m[14]
    Hxx = xxx * x + xxy * y + xxz * z
    Hyy = xyy * x + yyy * y + yyz * z
    H = (Hxx, xxy * x + xyy * y + xyz * z, xxz * x + xyz * y - (xxx + xyy) * z,
         Hyy, xyz * x + yyz * y - (xxy + yyy) * z, -Hxx - Hyy)
    _add_order(3, d, s, inv2, _times(H, d, 0.5), H, B, dB_dd)
    p, q = 0.5 * (x * x - z * z), 0.5 * (y * y - z * z)
    gradients = ((p, 0.0, -x * z), (x * y, p, -y * z), (x * z, 0.0, p), (q, x * y, -x * z),
                 (y * z, x * z, x * y), (0.0, q, -y * z), (0.0, y * z, q))
    _set_columns(3, d, s, inv2, gradients, 8, dB_dm)


@njit(**_INLINE)
def field_and_jacobians(d0: float, d1: float, d2: float, m: FloatArray, B: FloatArray,
                        dB_dd: FloatArray, dB_dm: FloatArray) -> None:
    """Field and both Jacobians of one source at one point.

    `d` is sensor minus source [m], `m` (k,) holds 3, 8 or 15 moments. Overwrites
    B (3,) [T], dB_dd (3, 3) [T/m] and dB_dm (3, k); all are NaN where |d| = 0.

    Source: T10 eq. (3.39)-(3.41).
    """
    d = (d0, d1, d2)
    inv2 = 1.0 / (d0 * d0 + d1 * d1 + d2 * d2)
    s = K_DIPOLE * inv2 * math.sqrt(inv2)
    B[:] = 0.0
    dB_dd[:] = 0.0
    g = (m[0], m[1], m[2])
    _add_order(1, d, s, inv2, g, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), B, dB_dd)
    gradients = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    _set_columns(1, d, s, inv2, gradients, 0, dB_dm)
    if len(m) > 3:
        _add_quadrupole(d, m, s * inv2, inv2, B, dB_dd, dB_dm)
    if len(m) > 8:
        _add_octupole(d, m, s * inv2 * inv2, inv2, B, dB_dd, dB_dm)


@compiled_when_used(
    'void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,:,::1])',
    **_COMPILE)
def _field_and_jacobians_rows(d: FloatArray, m: FloatArray, B: FloatArray, dB_dd: FloatArray,
                              dB_dm: FloatArray) -> None:
    """Loop of `field_and_jacobians` over rows."""
    for i in range(d.shape[0]):
        field_and_jacobians(d[i, 0], d[i, 1], d[i, 2], m[i], B[i], dB_dd[i], dB_dm[i])


def _evaluate(r: ArrayLike, moments: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Broadcast, flatten, run the kernel; field and Jacobians in the broadcast shape."""
    r, moments = np.asarray(r, dtype=float), np.asarray(moments, dtype=float)
    if r.shape[-1:] != (3,):
        raise ValueError(f'r needs a last axis of length 3, got {r.shape}')
    if moments.shape[-1:] not in ((3,), (8,), (15,)):
        raise ValueError(f'moments need a last axis of length 3, 8 or 15, got {moments.shape}')
    k = moments.shape[-1]
    shape = np.broadcast_shapes(r.shape[:-1], moments.shape[:-1])
    # Copies: the kernel takes no read-only arrays, which broadcasts are.
    r = np.array(np.broadcast_to(r, shape + (3,)), order='C').reshape(-1, 3)
    moments = np.array(np.broadcast_to(moments, shape + (k,)), order='C').reshape(-1, k)
    B, dB_dr, dB_dm = np.empty_like(r), np.empty((len(r), 3, 3)), np.empty((len(r), 3, k))
    _field_and_jacobians_rows(r, moments, B, dB_dr, dB_dm)
    return (B.reshape(shape + (3,)), dB_dr.reshape(shape + (3, 3)),
            dB_dm.reshape(shape + (3, k)))


def multipole_field(r: ArrayLike, moments: ArrayLike) -> FloatArray:
    """Flux density of a multipole expansion, the sum of its orders.

    Parameters
    ----------
    r : (..., 3) [m], world
        Sensor minus source position.
    moments : (..., 3 | 8 | 15) [A m^2 | A m^3 | A m^4], world
        Components of the orders up to 1, 2 or 3, as in the module's head;
        broadcasts against `r`.

    Returns
    -------
    (..., 3) [T], world
        NaN where |r| = 0.

    Source: T10 eq. (3.39)-(3.41). T10 eq. (4.17) counts r from the sensor to the
    source: the moments of even order have the opposite sign there.
    """
    return _evaluate(r, moments)[0]


def multipole_jacobians(r: ArrayLike, moments: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the field of a multipole expansion.

    Parameters
    ----------
    r : (..., 3) [m], world
        Sensor minus source position.
    moments : (..., 3 | 8 | 15), world
        As in `multipole_field`; called k below.

    Returns
    -------
    dB_dr : (..., 3, 3) [T/m]
        With respect to `r`, symmetric; the one with respect to the source is its
        negative.
    dB_dm : (..., 3, k) [T per unit of the component]
        The field is dB_dm @ moments. Both are NaN where |r| = 0.

    Source: derivatives of T10 eq. (3.39)-(3.41).
    """
    return _evaluate(r, moments)[1:]


def multipole_moments(points: ArrayLike, dipoles: ArrayLike, order: int) -> FloatArray:
    """Moments about the origin of a cloud of dipoles.

    Those of order 1 are the sum of the dipoles; those above depend on the origin.

    Parameters
    ----------
    points : (..., n, 3) [m]
        Positions, relative to the origin of the expansion.
    dipoles : (..., n, 3) [A m^2]
        Dipole moments; broadcasts against `points`.
    order : int
        Highest order: 1, 2 or 3.

    Returns
    -------
    (..., 3 | 8 | 15)
        As `multipole_field` takes them, in the axes of `points`.

    Source: the Taylor series of the dipoles' potentials, in the scale of T10 eq.
    (3.40): l (2l-1)!! times the symmetric traceless part of m x x .., l - 1 times x.
    """
    if order not in (1, 2, 3):
        raise ValueError(f'order has to be 1, 2 or 3, got {order!r}')
    x, m = np.broadcast_arrays(np.asarray(points, dtype=float), np.asarray(dipoles, dtype=float))
    if x.ndim < 2 or x.shape[-1] != 3:
        raise ValueError(f'points and dipoles need the shape (..., n, 3), got {x.shape}')
    delta = np.eye(3)
    along = np.sum(x * m, axis=-1)
    moments = [m[..., i] for i in range(3)]
    if order > 1:
        moments += [3 * (m[..., i] * x[..., j] + x[..., i] * m[..., j]) - 2 * along * delta[i, j]
                    for i, j in _independent(2)]
    if order > 2:
        u = 6 * along[..., None] * x + 3 * np.sum(x * x, axis=-1, keepdims=True) * m
        moments += [sum(15 * m[..., a] * x[..., b] * x[..., c] - delta[b, c] * u[..., a]
                        for a, b, c in ((i, j, k), (j, k, i), (k, i, j)))
                    for i, j, k in _independent(3)]
    total: FloatArray = np.sum(np.stack(moments, axis=-1), axis=-2)
    return total


def _independent(order: int) -> list[tuple[int, ...]]:
    """Indices of the components that are kept: those with at most one z, sorted."""
    return [c for c in combinations_with_replacement(range(3), order) if c.count(2) < 2]
