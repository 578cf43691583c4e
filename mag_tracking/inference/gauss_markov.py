"""Vectors that change smoothly, without a model of what moves them.

Each component is an integrated random walk: its rate of change is a Wiener process. How strong
that is, is unknown and may change: a bank of strengths is weighed by the data, and each gives way
to another one at a constant rate.

Source: Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and
Navigation, sections 6.2.2 (the process) and 11.6 (the weights; the states are not mixed here, as
all of them follow the same data).
"""

import numpy as np
from numba import float64, int64, njit, void

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.compiled import compiled_when_used

STRENGTHS = np.logspace(-1.5, 4.5, 13)
"""[1/s^1.5] Root spectral densities of the bank, in units of a vector's scale."""

SWITCH_S = 0.75
"""[s] Mean time for which a strength holds."""

_M, _B = float64[:, :, ::1], float64[:, :, :, ::1]


class GaussMarkovVectors:
    """Filters of vectors that change independently of each other, and begin at zero."""

    def __init__(self, n: int, scale: FloatArray, std: float) -> None:
        """
        Parameters
        ----------
        n : int
            Number of vectors.
        scale : (m,) array
            Unit of the `STRENGTHS`, of each component.
        std : float
            Standard deviation of each component at the beginning.
        """
        m, n_strengths = len(scale), len(STRENGTHS)
        # [k, i]: of strength k and component i.
        self._densities = np.square(STRENGTHS[:, None] * scale)
        self._x = np.zeros((n, n_strengths, 2 * m))
        self._P = np.zeros((n, n_strengths, 2 * m, 2 * m))
        level = np.arange(m)
        self._P[:, :, level, level] = std**2
        self._P[:, :, m + level, m + level] = self._densities
        self._log_w = np.full((n, n_strengths), -np.log(n_strengths))

    def log_density(self, vector: IntArray, H: FloatArray, y: FloatArray, variance: FloatArray,
                    dt: float) -> float:
        """Log-density of scalar measurements given those before.

        Parameters
        ----------
        vector : (n_y,) int array, ascending
            Which vector each measurement is of.
        H : (n_y, m) array
            The measurement is H times the vector.
        y, variance : (n_y,) arrays
            Measurements without NaN, and the variance of their noise, which is positive.
        dt : float [s]
            Since the measurements before.
        """
        out = np.zeros(1)
        _step(self._x, self._P, self._log_w, self._densities, vector, np.ascontiguousarray(H),
              y, variance, dt, out)
        return float(out[0])


@njit()
def _predict(x: FloatArray, P: FloatArray, q: FloatArray, dt: float) -> None:
    """Move levels and rates (2 m,) and their covariance on by `dt`, in place."""
    m = len(q)
    for i in range(m):
        x[i] += dt * x[m + i]
        for j in range(2 * m):
            P[i, j] += dt * P[m + i, j]
    for i in range(2 * m):
        for j in range(m):
            P[i, j] += dt * P[i, m + j]
    for i in range(m):
        P[i, i] += q[i] * dt**3 / 3.0
        P[i, m + i] += q[i] * dt**2 / 2.0
        P[m + i, i] += q[i] * dt**2 / 2.0
        P[m + i, m + i] += q[i] * dt


@njit()
def _update(x: FloatArray, P: FloatArray, h: FloatArray, y: float, variance: float,
            PH: FloatArray) -> float:
    """Update with a scalar measurement, in place; its log-density. `PH` (2 m,) is overwritten."""
    n, m = len(x), len(h)
    S, nu = 0.0, y
    for i in range(n):
        PH[i] = 0.0
        for j in range(m):
            PH[i] += P[i, j] * h[j]
    for j in range(m):
        S += h[j] * PH[j]
        nu -= h[j] * x[j]
    # After a long gap the prediction is so wide that rounding errors exceed the noise.
    S = max(S, 0.0) + variance
    for i in range(n):
        gain = PH[i] / S
        x[i] += gain * nu
        for j in range(n):
            P[i, j] -= gain * PH[j]
    # Joseph's form: (I - K h') P (I - K h')' + K R K', with K = PH / S; symmetric.
    for i in range(n):
        left = 0.0
        for j in range(m):
            left += P[i, j] * h[j]
        for j in range(n):
            P[i, j] += (variance * PH[i] / S - left) * PH[j] / S
    for i in range(n):
        P[i, i] = max(P[i, i], 0.0)
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
    return float(-0.5 * (nu * nu / S + np.log(2.0 * np.pi * S)))


@compiled_when_used(
    void(_M, _B, float64[:, ::1], float64[:, ::1], int64[::1], float64[:, ::1], float64[::1],
    float64[::1], float64, float64[::1]))
def _step(x: FloatArray, P: FloatArray, log_w: FloatArray, densities: FloatArray,
          vector: IntArray, H: FloatArray, y: FloatArray, variance: FloatArray, dt: float,
          out: FloatArray) -> None:
    """`GaussMarkovVectors.log_density`; it is added to `out` (1,)."""
    n = len(densities)
    stay, PH = np.exp(-dt / SWITCH_S), np.empty(x.shape[2])
    first = 0
    for v in range(len(x)):
        after = first
        while after < len(y) and vector[after] == v:
            after += 1
        top, total = -np.inf, 0.0
        for k in range(n):
            log_w[v, k] = np.log(stay * np.exp(log_w[v, k]) + (1.0 - stay) / n + 1e-300)
            _predict(x[v, k], P[v, k], densities[k], dt)
            for i in range(first, after):
                log_w[v, k] += _update(x[v, k], P[v, k], H[i], y[i], variance[i], PH)
            top = max(top, log_w[v, k])
        for k in range(n):
            total += np.exp(log_w[v, k] - top)
        evidence = top + np.log(total)
        for k in range(n):
            log_w[v, k] -= evidence
        out[0] += evidence
        first = after
