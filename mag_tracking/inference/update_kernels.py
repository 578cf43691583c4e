"""What of the Kalman update, and of three axes, is compiled.

It stands in one file: of a compiled function on disk only the file that it is in itself is looked
at, so that what it takes from another one would stay as it was when that is changed.
A symmetric 3 x 3 is its lower triangle, row by row: as six scalars it needs no array.
"""

import math
from typing import TypeAlias

import numpy as np
from numba import int64, njit

from mag_tracking.arrays import CompileOptions, FloatArray, IntArray

_LOG_2PI = math.log(2.0 * math.pi)


_COMPILE: CompileOptions = {'cache': True, 'error_model': 'numpy', 'fastmath': {'contract'}}
"""Fused multiply-add is allowed, nothing else that would change a result.

The kernels take whole arrays and row numbers, and give back scalars: a slice
or a small array passed on costs more than the arithmetic it saves writing.
"""

_INLINE: CompileOptions = {'error_model': 'numpy', 'fastmath': {'contract'}, 'forceinline': True}

_Vector: TypeAlias = tuple[float, float, float]
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


@njit(**_INLINE)
def _gain_rows(y: FloatArray, P: FloatArray, H: FloatArray, p: int, j: int, n_own: int,
               first: int, T: FloatArray) -> None:
    """T = [H | I] P, the three rows of sensor j; rows of missing axes are zero.

    Five columns of H at a time, so that each entry of T is touched less often.
    """
    n_x, n_t = P.shape[1], H.shape[3] - n_own
    for i in range(n_x):
        T[0, i] = P[p, first, i]
        T[1, i] = P[p, first + 1, i]
        T[2, i] = P[p, first + 2, i]
    for c in range(0, n_t - 4, 5):
        a0, a1, a2, a3, a4 = (H[p, j, 0, c], H[p, j, 0, c + 1], H[p, j, 0, c + 2],
                              H[p, j, 0, c + 3], H[p, j, 0, c + 4])
        b0, b1, b2, b3, b4 = (H[p, j, 1, c], H[p, j, 1, c + 1], H[p, j, 1, c + 2],
                              H[p, j, 1, c + 3], H[p, j, 1, c + 4])
        d0, d1, d2, d3, d4 = (H[p, j, 2, c], H[p, j, 2, c + 1], H[p, j, 2, c + 2],
                              H[p, j, 2, c + 3], H[p, j, 2, c + 4])
        for i in range(n_x):
            p0, p1, p2, p3, p4 = (P[p, c, i], P[p, c + 1, i], P[p, c + 2, i],
                                  P[p, c + 3, i], P[p, c + 4, i])
            T[0, i] += a0 * p0 + a1 * p1 + a2 * p2 + a3 * p3 + a4 * p4
            T[1, i] += b0 * p0 + b1 * p1 + b2 * p2 + b3 * p3 + b4 * p4
            T[2, i] += d0 * p0 + d1 * p1 + d2 * p2 + d3 * p3 + d4 * p4
    for c in range(n_t - n_t % 5, n_t + n_own):
        a0, b0, d0 = H[p, j, 0, c], H[p, j, 1, c], H[p, j, 2, c]
        row = c if c < n_t else c + n_own * j
        for i in range(n_x):
            T[0, i] += a0 * P[p, row, i]
            T[1, i] += b0 * P[p, row, i]
            T[2, i] += d0 * P[p, row, i]
    for a in range(3):
        if math.isnan(y[j, a]):
            for i in range(n_x):
                T[a, i] = 0.0


@njit(**_INLINE)
def _n_present(y: FloatArray, C: FloatArray) -> int:
    """How many axes are not NaN; -1 if the noise of a sensor's is not positive definite."""
    n = 0
    for j in range(y.shape[0]):
        _, _, _, e0, e1, e2 = _factor(*_covariance(y, C, j))
        if not (e0 > 0.0 and e1 > 0.0 and e2 > 0.0):
            return -1
        for a in range(3):
            n += not math.isnan(y[j, a])
    return n


@njit(**_INLINE)
def _innovation(y: FloatArray, C: FloatArray, inflation: FloatArray, h: FloatArray, H: FloatArray,
                x: FloatArray, x_lin: FloatArray, p: int, j: int, n_own: int, first: int,
                T: FloatArray) -> tuple[_Vector, _Lower]:
    """Innovation u and its covariance T [H | I]' + C + inflation; u is zero on missing axes."""
    u0 = y[j, 0] - h[p, j, 0] - x[p, first]
    u1 = y[j, 1] - h[p, j, 1] - x[p, first + 1]
    u2 = y[j, 2] - h[p, j, 2] - x[p, first + 2]
    s00 = C[j, 0, 0] + inflation[p, j] + T[0, first]
    s10, s11 = C[j, 1, 0] + T[1, first], C[j, 1, 1] + inflation[p, j] + T[1, first + 1]
    s20, s21 = C[j, 2, 0] + T[2, first], C[j, 2, 1] + T[2, first + 1]
    s22 = C[j, 2, 2] + inflation[p, j] + T[2, first + 2]
    n_t = H.shape[3] - n_own
    for c in range(n_t + n_own):
        h0, h1, h2 = H[p, j, 0, c], H[p, j, 1, c], H[p, j, 2, c]
        i = c if c < n_t else c + n_own * j
        t0, t1, t2 = T[0, i], T[1, i], T[2, i]
        d = x[p, i] - x_lin[p, i]
        u0 -= h0 * d
        u1 -= h1 * d
        u2 -= h2 * d
        s00 += h0 * t0
        s10 += h0 * t1
        s11 += h1 * t1
        s20 += h0 * t2
        s21 += h1 * t2
        s22 += h2 * t2
    u0 = 0.0 if math.isnan(y[j, 0]) else u0
    u1 = 0.0 if math.isnan(y[j, 1]) else u1
    u2 = 0.0 if math.isnan(y[j, 2]) else u2
    return (u0, u1, u2), _of_present_axes(y, j, s00, s10, s11, s20, s21, s22)


@njit(**_INLINE)
def _apply(x: FloatArray, P: FloatArray, p: int, G: FloatArray, z0: float, z1: float,
           z2: float) -> None:
    """x += G' z and P -= G' G; both halves get the same products, so P stays symmetric."""
    n_x = x.shape[1]
    for i in range(n_x):
        g0, g1, g2 = G[0, i], G[1, i], G[2, i]
        x[p, i] += g0 * z0 + g1 * z1 + g2 * z2
        for k in range(n_x):
            P[p, i, k] -= g0 * G[0, k] + g1 * G[1, k] + g2 * G[2, k]


@njit(**_INLINE)
def _whiten(T: FloatArray, l10: float, l20: float, l21: float, r0: float, r1: float,
            r2: float) -> None:
    """Rows of T to diag(r) L^-1 T, where r is one over the root of the pivots."""
    for i in range(T.shape[1]):
        t0 = T[0, i]
        t1 = T[1, i] - l10 * t0
        T[2, i] = r2 * (T[2, i] - l20 * t0 - l21 * t1)
        T[1, i] = r1 * t1
        T[0, i] = r0 * t0


@njit(**_INLINE)
def _keep(p: int, j: int, T: FloatArray, z0: float, z1: float, z2: float, l10: float, l20: float,
          l21: float, r0: float, r1: float, r2: float, G: FloatArray, z: FloatArray,
          W: FloatArray) -> None:
    """Store what `Gains` holds of hypothesis p and sensor j."""
    for a in range(3):
        for i in range(T.shape[1]):
            G[p, j, a, i] = T[a, i]
    z[p, j, 0], z[p, j, 1], z[p, j, 2] = z0, z1, z2
    W[p, j, 0] = r0
    W[p, j, 1], W[p, j, 2] = -r1 * l10, r1
    W[p, j, 3], W[p, j, 4], W[p, j, 5] = r2 * (l10 * l21 - l20), -r2 * l21, r2


@njit(**_INLINE)
def _shapes_fit(x: FloatArray, P: FloatArray, x_lin: FloatArray, y: FloatArray, C: FloatArray,
                h: FloatArray, H: FloatArray, inflation: FloatArray, n_own: int, G: FloatArray,
                z: FloatArray, W: FloatArray) -> bool:
    """Whether the arrays of `update_bank` have the sizes that it reads."""
    n_hyp, n_sensors, n_columns = H.shape[0], H.shape[1], H.shape[3]
    n_x = n_columns - n_own + (n_own + 3) * n_sensors
    # Sizes one by one: numba takes half a second to compile comparisons of tuples.
    if (len(x) != n_hyp or len(P) != n_hyp or len(x_lin) != n_hyp or len(h) != n_hyp
            or len(inflation) != n_hyp or x.shape[1] != n_x or x_lin.shape[1] != n_x
            or P.shape[1] != n_x or P.shape[2] != n_x or len(y) != n_sensors
            or len(C) != n_sensors or h.shape[1] != n_sensors or inflation.shape[1] != n_sensors
            or y.shape[1] != 3 or C.shape[1] != 3 or C.shape[2] != 3 or h.shape[2] != 3
            or H.shape[2] != 3):
        return False
    return len(G) == 0 or (
        len(G) == n_hyp and len(z) == n_hyp and len(W) == n_hyp and G.shape[1] == n_sensors
        and z.shape[1] == n_sensors and W.shape[1] == n_sensors and G.shape[2] == 3
        and G.shape[3] == n_x and z.shape[2] == 3 and W.shape[2] == 6)


@njit('int64(float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], '
      'float64[:,:,::1], float64[:,:,::1], float64[:,:,:,::1], float64[:,::1], '
      'int64, float64[::1], float64[:,::1], '
      'float64[:,:,:,::1], float64[:,:,::1], float64[:,:,::1])', **_COMPILE)
def update_bank(x: FloatArray, P: FloatArray, x_lin: FloatArray, y: FloatArray, C: FloatArray,
                h: FloatArray, H: FloatArray, inflation: FloatArray, n_own: int,
                log_likelihood: FloatArray, nis: FloatArray, G: FloatArray, z: FloatArray,
                W: FloatArray) -> int:
    """Loop of the update over hypotheses and sensors; nothing is changed where it is not 0.

    -1: a noise is not positive definite; -2: shapes do not fit, it would read beyond an array.
    What a backward pass wants goes into G, z and W unless they are of length 0.
    """
    if not _shapes_fit(x, P, x_lin, y, C, h, H, inflation, n_own, G, z, W):
        return -2
    n_hyp, n_sensors, keep = H.shape[0], H.shape[1], len(G) > 0
    n = _n_present(y, C)
    if n < 0:
        return -1
    T = np.empty((3, x.shape[1]))
    for p in range(n_hyp):
        log_likelihood[p] = -0.5 * n * _LOG_2PI
        for j in range(n_sensors):
            first = x.shape[1] - 3 * (n_sensors - j)
            _gain_rows(y, P, H, p, j, n_own, first, T)
            (u0, u1, u2), (s00, s10, s11, s20, s21, s22) = _innovation(
                y, C, inflation, h, H, x, x_lin, p, j, n_own, first, T)
            l10, l20, l21, e0, e1, e2 = _factor(s00, s10, s11, s20, s21, s22)
            r0, r1, r2 = 1.0 / math.sqrt(e0), 1.0 / math.sqrt(e1), 1.0 / math.sqrt(e2)
            _whiten(T, l10, l20, l21, r0, r1, r2)
            u1 -= l10 * u0
            z0, z1, z2 = r0 * u0, r1 * u1, r2 * (u2 - l20 * u0 - l21 * u1)
            _apply(x, P, p, T, z0, z1, z2)
            if keep:
                _keep(p, j, T, z0, z1, z2, l10, l20, l21, r0, r1, r2, G, z, W)
            q = z0 * z0 + z1 * z1 + z2 * z2
            nis[p, j] = q
            log_likelihood[p] -= 0.5 * (q + math.log(e0 * e1 * e2))
    return 0


@njit('boolean(float64[:,::1], float64[:,:,::1], float64[::1], int64[::1])', cache=True,
      error_model='numpy')
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


@njit('void(float64[:,::1], float64[:,:,::1], float64[::1])', cache=True, error_model='numpy')
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
