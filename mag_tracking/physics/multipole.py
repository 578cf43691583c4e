"""Magnetic multipoles of orders 1 to 3 about one point: dipole, quadrupole and octupole.

The moment of order l is a symmetric traceless tensor with 2l + 1 independent components. The stored
components are Cartesian, in alphabetical order. Components with more than one z follow from the
zero trace and are not stored::

    0..2   x y z                             [A m^2]  dipole
    3..7   xx xy xz yy yz                    [A m^3]  zz = -xx - yy
    8..14  xxx xxy xxz xyy xyz yyy yyz       [A m^4]  izz = -ixx - iyy

A vector of 3, 8 or 15 moments contains the orders up to 1, 2 or 3, scaled as in T10 eq.
(3.39)-(3.40). With d from the source to the sensor, the field of one order is::

    B = -mu0/(4 pi) grad(P / |d|^(2l+1)),  P = (1/l!) m_ij.. d_i d_j ..

The derivatives are in `multipole.hpp`.
"""

from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core


def _field_and_jacobians(r: ArrayLike,
                         moments: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Field and its Jacobians with respect to `r` and `moments`, which are broadcast."""
    r, moments = np.asarray(r, dtype=float), np.asarray(moments, dtype=float)
    if r.shape[-1:] != (3,):
        raise ValueError(f'r requires a last axis of length 3, got shape {r.shape}')
    if moments.shape[-1:] not in ((3,), (8,), (15,)):
        raise ValueError('moments require a last axis of length 3, 8 or 15, '
                         f'got shape {moments.shape}')
    k = moments.shape[-1]
    shape = np.broadcast_shapes(r.shape[:-1], moments.shape[:-1])
    return core.multipoles(np.ascontiguousarray(np.broadcast_to(r, shape + (3,))),
                           np.ascontiguousarray(np.broadcast_to(moments, shape + (k,))))


def multipole_field(r: ArrayLike, moments: ArrayLike) -> FloatArray:
    """Flux density (..., 3) [T] of a multipole expansion, summed over its orders; NaN at r = 0.

    `r` [m] points from the source to the sensor, in the world frame; `moments` (..., 3 | 8 | 15)
    are as in the module docstring. T10 eq. (3.39)-(3.41); in T10 eq. (4.17), r points from the
    sensor to the source, so moments of even order have the opposite sign.
    """
    return _field_and_jacobians(r, moments)[0]


def multipole_jacobians(r: ArrayLike, moments: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `multipole_field` by `r` (..., 3, 3) and by `moments` (..., 3, k).

    Both are NaN at r = 0. The first is symmetric, and minus the derivative by the source position;
    the second times the moments is the field. T10 eq. (3.39)-(3.41), differentiated.
    """
    return _field_and_jacobians(r, moments)[1:]


def multipole_moments(points: ArrayLike, dipoles: ArrayLike, order: int) -> FloatArray:
    """Multipole moments (..., 3 | 8 | 15) about the origin of dipoles [A m²] at `points` [m].

    `points` and `dipoles` are (..., n, 3). `order` is 1, 2 or 3, otherwise ValueError; orders above
    1 depend on the origin. The moment of order l is l (2l-1)!! times the symmetric traceless part
    of m x x .., with l - 1 factors x, from the Taylor series of the potentials; scaled as in
    T10 eq. (3.40).
    """
    if order not in (1, 2, 3):
        raise ValueError(f'order must be 1, 2 or 3, got {order!r}')
    x, m = np.broadcast_arrays(np.asarray(points, dtype=float), np.asarray(dipoles, dtype=float))
    if x.ndim < 2 or x.shape[-1] != 3:
        raise ValueError(f'points and dipoles must have shape (..., n, 3), got {x.shape}')
    delta = np.eye(3)
    m_dot_x = np.sum(x * m, axis=-1)
    moments = [m[..., i] for i in range(3)]
    if order > 1:
        moments += [3 * (m[..., i] * x[..., j] + x[..., i] * m[..., j]) - 2 * m_dot_x * delta[i, j]
                    for i, j in _stored_components(2)]
    if order > 2:
        u = 6 * m_dot_x[..., None] * x + 3 * np.sum(x * x, axis=-1, keepdims=True) * m
        moments += [sum(15 * m[..., a] * x[..., b] * x[..., c] - delta[b, c] * u[..., a]
                        for a, b, c in ((i, j, k), (j, k, i), (k, i, j)))
                    for i, j, k in _stored_components(3)]
    total: FloatArray = np.sum(np.stack(moments, axis=-1), axis=-2)
    return total


def _stored_components(order: int) -> list[tuple[int, ...]]:
    """Sorted axis indices of the stored components, which contain z at most once."""
    return [c for c in combinations_with_replacement(range(3), order) if c.count(2) < 2]
