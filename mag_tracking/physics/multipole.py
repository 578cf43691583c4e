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

whose derivatives `multipole.hpp` has.
"""

from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core


def _evaluate(r: ArrayLike, moments: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Field and both Jacobians, in the shape that the arguments broadcast to."""
    r, moments = np.asarray(r, dtype=float), np.asarray(moments, dtype=float)
    if r.shape[-1:] != (3,):
        raise ValueError(f'r needs a last axis of length 3, got {r.shape}')
    if moments.shape[-1:] not in ((3,), (8,), (15,)):
        raise ValueError(f'moments need a last axis of length 3, 8 or 15, got {moments.shape}')
    k = moments.shape[-1]
    shape = np.broadcast_shapes(r.shape[:-1], moments.shape[:-1])
    return core.multipoles(np.ascontiguousarray(np.broadcast_to(r, shape + (3,))),
                           np.ascontiguousarray(np.broadcast_to(moments, shape + (k,))))


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
