"""Covariances of the three axes of a sensor, some of which may be missing; compiled.

A symmetric 3 x 3 is its lower triangle, row by row: as six scalars it needs no array.
"""

import math

import numpy as np
from numba import int64, njit

from mag_tracking.records import plain

INLINE = {'error_model': 'numpy', 'fastmath': {'contract'}, 'forceinline': True}


@njit(**INLINE)
def of_present_axes(y, j, s00, s10, s11, s20, s21, s22):
    """A covariance of sensor j with the rows and columns of missing axes as in identity."""
    if math.isnan(y[j, 0]):
        s00, s10, s20 = 1.0, 0.0, 0.0
    if math.isnan(y[j, 1]):
        s10, s11, s21 = 0.0, 1.0, 0.0
    if math.isnan(y[j, 2]):
        s20, s21, s22 = 0.0, 0.0, 1.0
    return s00, s10, s11, s20, s21, s22


@njit(**INLINE)
def factor(s00, s10, s11, s20, s21, s22):
    """Unit lower factor l10, l20, l21 and pivots e0, e1, e2: S = L diag(e) L'."""
    l10, l20 = s10 / s00, s20 / s00
    e1 = s11 - l10 * s10
    e21 = s21 - l20 * s10
    l21 = e21 / e1
    return l10, l20, l21, s00, e1, s22 - l20 * s20 - l21 * e21


def whitened_energy(y, C):
    """Energy of a measurement in units of its noise: y' C^-1 y over the axes present.

    Parameters
    ----------
    y : (n, 3)
        Per sensor; NaN = missing axis.
    C : (n, 3, 3)
        Covariance, same unit squared; not read where `y` is missing.

    Returns
    -------
    energy : (n,)
        0 where no axis is present.
    axes : (n,) int
        How many are.

    Raises numpy.linalg.LinAlgError where a covariance is not positive definite.
    Source: T10 eq. (5.16).
    """
    y, C = _checked(y, C)
    energy, axes = np.empty(len(y)), np.empty(len(y), dtype=np.int64)
    if not _energies(y, C, energy, axes):
        raise np.linalg.LinAlgError('a covariance is not positive definite')
    return energy, axes


def smallest_pivots(y, C):
    """How far the covariance of each sensor is from singular, over the axes that are present.

    The arrays are as for `whitened_energy`. Returns (n,): of the covariance in units of its own
    variances, the least share of one axis that those before it do not tell. 1 = no axes go
    together; NaN or not positive: not positive definite.
    """
    y, C = _checked(y, C)
    out = np.empty(len(y))
    _smallest_pivots(y, C, out)
    return out


def _checked(y, C):
    """Both as compiled code takes them. Raises ValueError where the shapes do not fit."""
    if y.shape != (len(y), 3) or C.shape != (len(y), 3, 3):
        raise ValueError(f'covariances of shape {C.shape} for axes of shape {y.shape}')
    return plain(y), plain(C)


@njit('boolean(float64[:,::1], float64[:,:,::1], float64[::1], int64[::1])', cache=True,
      error_model='numpy')
def _energies(y, C, energy, axes):
    """`whitened_energy`; False where a covariance is not positive definite."""
    for j in range(len(y)):
        l10, l20, l21, e0, e1, e2 = factor(*of_present_axes(
            y, j, C[j, 0, 0], C[j, 1, 0], C[j, 1, 1], C[j, 2, 0], C[j, 2, 1], C[j, 2, 2]))
        if not (e0 > 0.0 and e1 > 0.0 and e2 > 0.0):
            return False
        axes[j] = 0
        for a in range(3):
            axes[j] += int64(not math.isnan(y[j, a]))
        u0 = 0.0 if math.isnan(y[j, 0]) else y[j, 0]
        u1 = (0.0 if math.isnan(y[j, 1]) else y[j, 1]) - l10 * u0
        u2 = (0.0 if math.isnan(y[j, 2]) else y[j, 2]) - l20 * u0 - l21 * u1
        energy[j] = u0 * u0 / e0 + u1 * u1 / e1 + u2 * u2 / e2
    return True


@njit('void(float64[:,::1], float64[:,:,::1], float64[::1])', cache=True, error_model='numpy')
def _smallest_pivots(y, C, out):
    """`smallest_pivots`."""
    for j in range(len(y)):
        s00, s10, s11, s20, s21, s22 = of_present_axes(
            y, j, C[j, 0, 0], C[j, 1, 0], C[j, 1, 1], C[j, 2, 0], C[j, 2, 1], C[j, 2, 2])
        # Scaled to one: in tesla squared every pivot looks like zero. Of what is negative NaN.
        a, b, c = math.sqrt(s00), math.sqrt(s11), math.sqrt(s22)
        _, _, _, e0, e1, e2 = factor(s00 / (a * a), s10 / (a * b), s11 / (b * b),
                                     s20 / (a * c), s21 / (b * c), s22 / (c * c))
        out[j] = min(e0, min(e1, e2)) if math.isfinite(e0 + e1 + e2) else np.nan
        for k in range(3):
            for i in range(3):
                if not (math.isnan(y[j, i]) or math.isnan(y[j, k]) or math.isfinite(C[j, i, k])):
                    out[j] = np.nan
