"""What of three axes is compiled.

A symmetric 3 x 3 is its lower triangle, row by row: as six scalars it needs no array.
"""

import math
from typing import TypeAlias

import numpy as np
from numba import int64, njit

from mag_tracking.arrays import CompileOptions, FloatArray, IntArray
from mag_tracking.compiled import compiled_when_used

_INLINE: CompileOptions = {'error_model': 'numpy', 'fastmath': {'contract'}, 'forceinline': True}

_Lower: TypeAlias = tuple[float, float, float, float, float, float]
"""A lower triangle (3, 3), row by row."""


@njit(**_INLINE)
def _of_present_axes(y: FloatArray, j: int, s00: float, s10: float, s11: float, s20: float,
                     s21: float, s22: float) -> _Lower:
    """A covariance of sensor j with the rows and columns of missing axes as in identity."""
    if math.isnan(y[j, 0]):
        s00, s10, s20 = 1.0, 0.0, 0.0
    if math.isnan(y[j, 1]):
        s10, s11, s21 = 0.0, 1.0, 0.0
    if math.isnan(y[j, 2]):
        s20, s21, s22 = 0.0, 0.0, 1.0
    return s00, s10, s11, s20, s21, s22


@njit(**_INLINE)
def _covariance(y: FloatArray, C: FloatArray, j: int) -> _Lower:
    """That of sensor j among `C` (n, 3, 3), as `_of_present_axes`."""
    return _of_present_axes(
        y, j, C[j, 0, 0], C[j, 1, 0], C[j, 1, 1], C[j, 2, 0], C[j, 2, 1], C[j, 2, 2])


@njit(**_INLINE)
def _factor(s00: float, s10: float, s11: float, s20: float, s21: float, s22: float) -> _Lower:
    """Unit lower factor l10, l20, l21 and pivots e0, e1, e2: S = L diag(e) L'."""
    l10, l20 = s10 / s00, s20 / s00
    e1 = s11 - l10 * s10
    e21 = s21 - l20 * s10
    l21 = e21 / e1
    return l10, l20, l21, s00, e1, s22 - l20 * s20 - l21 * e21


@compiled_when_used(
    'boolean(float64[:,::1], float64[:,:,::1], float64[::1], int64[::1])', error_model='numpy')
def energies(y: FloatArray, C: FloatArray, energy: FloatArray, axes: IntArray) -> bool:
    """`axes.whitened_energy`; False where a covariance is not positive definite."""
    for j in range(len(y)):
        l10, l20, l21, e0, e1, e2 = _factor(*_covariance(y, C, j))
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


@compiled_when_used('void(float64[:,::1], float64[:,:,::1], float64[::1])', error_model='numpy')
def smallest_pivots(y: FloatArray, C: FloatArray, out: FloatArray) -> None:
    """`axes.smallest_pivots`."""
    for j in range(len(y)):
        s00, s10, s11, s20, s21, s22 = _covariance(y, C, j)
        # Scaled to one: in tesla squared every pivot looks like zero. Of what is negative NaN.
        a, b, c = math.sqrt(s00), math.sqrt(s11), math.sqrt(s22)
        _, _, _, e0, e1, e2 = _factor(s00 / (a * a), s10 / (a * b), s11 / (b * b),
                                     s20 / (a * c), s21 / (b * c), s22 / (c * c))
        out[j] = min(e0, min(e1, e2)) if math.isfinite(e0 + e1 + e2) else np.nan
        for k in range(3):
            for i in range(3):
                if not (math.isnan(y[j, i]) or math.isnan(y[j, k]) or math.isfinite(C[j, i, k])):
                    out[j] = np.nan
