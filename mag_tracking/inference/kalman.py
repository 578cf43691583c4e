"""Kalman prediction and update, batched over hypotheses.

The leading axis is always the hypothesis. A state is the target's n_t states
followed by three background states per sensor (tesla, sensor frame). The
update takes the sensors one after the other, linearised at one common point,
which gives the numbers of the stacked update at a fraction of its cost.
"""

import math

import numpy as np
from numba import njit

_LOG_2PI = math.log(2.0 * math.pi)


def predict(x, P, x_target, F, Q, background_variance):
    """Time update of every hypothesis, in place.

    Parameters
    ----------
    x : (n_hyp, n_x)
        States; the first n_t are replaced by `x_target`.
    P : (n_hyp, n_x, n_x)
        Covariances.
    x_target : (n_hyp, n_t)
        Propagated target states.
    F, Q : (n_hyp, n_t, n_t) or (n_t, n_t)
        Jacobian of the propagation and covariance of the process noise.
    background_variance : float [T^2]
        Added to every background state (random walk over the interval).

    Source: T10 Alg. 2, time update.
    """
    n_t = x_target.shape[1]
    x[:, :n_t] = x_target
    P_tb = F @ P[:, :n_t, n_t:]
    P[:, :n_t, n_t:] = P_tb
    P[:, n_t:, :n_t] = np.swapaxes(P_tb, 1, 2)
    P_tt = F @ P[:, :n_t, :n_t] @ np.swapaxes(F, -1, -2) + Q
    P[:, :n_t, :n_t] = 0.5 * (P_tt + np.swapaxes(P_tt, 1, 2))
    background = np.arange(n_t, x.shape[1])
    P[:, background, background] += background_variance


_COMPILE = {'cache': True, 'error_model': 'numpy', 'fastmath': {'contract'}}
"""Fused multiply-add is allowed, nothing else that would change a result."""


@njit('int64(float64[::1], float64[:,::1], float64, int64[::1], float64[:,::1])', **_COMPILE)
def _cholesky_of_present(y, C, inflation, axes, L):
    """Cholesky factor of the noise of the axes that are not NaN; their number, -1 if singular."""
    n = 0
    for a in range(3):
        if not math.isnan(y[a]):
            axes[n] = a
            n += 1
    for i in range(n):
        for j in range(i + 1):
            s = C[axes[i], axes[j]]
            if i == j:
                s += inflation
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if j < i:
                L[i, j] = s / L[j, j]
            elif s > 0.0:
                L[i, i] = math.sqrt(s)
            else:
                return -1
    return n


@njit('float64(float64[::1], float64[:,::1], float64[:,::1], int64[::1], int64, '
      'float64[:,::1], float64[::1])', **_COMPILE)
def _whitened_rows(residual, H, L, axes, n, A, z):
    """L^-1 [H | I] and L^-1 residual of the `n` present axes, into A and z; det L.

    The rows of missing axes are zero: they change nothing further on.
    """
    n_t = H.shape[1]
    det = 1.0
    A[:] = 0.0
    z[:] = 0.0
    for i in range(n):
        a = axes[i]
        z[i] = residual[a]
        for c in range(n_t):
            A[i, c] = H[a, c]
        A[i, n_t + a] = 1.0
        for k in range(i):
            w = L[i, k]
            z[i] -= w * z[k]
            for c in range(n_t + 3):
                A[i, c] -= w * A[k, c]
        w = 1.0 / L[i, i]
        z[i] *= w
        for c in range(n_t + 3):
            A[i, c] *= w
        det *= L[i, i]
    return det


@njit('void(float64[:,::1], float64[:,::1], int64[::1], float64[:,::1])', **_COMPILE)
def _gain_rows(P, A, columns, T):
    """T = A P[columns]; four columns at a time, so that each entry of T is touched less often."""
    n_x = P.shape[0]
    T[:] = 0.0
    for c in range(0, columns.shape[0], 4):
        r0, r1, r2, r3 = columns[c], columns[c + 1], columns[c + 2], columns[c + 3]
        a0, a1, a2, a3 = A[0, c], A[0, c + 1], A[0, c + 2], A[0, c + 3]
        b0, b1, b2, b3 = A[1, c], A[1, c + 1], A[1, c + 2], A[1, c + 3]
        d0, d1, d2, d3 = A[2, c], A[2, c + 1], A[2, c + 2], A[2, c + 3]
        for i in range(n_x):
            p0, p1, p2, p3 = P[r0, i], P[r1, i], P[r2, i], P[r3, i]
            T[0, i] += a0 * p0 + a1 * p1 + a2 * p2 + a3 * p3
            T[1, i] += b0 * p0 + b1 * p1 + b2 * p2 + b3 * p3
            T[2, i] += d0 * p0 + d1 * p1 + d2 * p2 + d3 * p3


@njit('float64(float64[:,::1], int64[::1], float64[:,::1], float64[::1])', **_COMPILE)
def _whiten_innovation(A, columns, G, z):
    """Divide innovation z and gain rows G by the Cholesky factor of S = I + A G'.

    Returns the root of det S. A row of zeros stays one.
    """
    s00, s10, s11, s20, s21, s22 = 1.0, 0.0, 1.0, 0.0, 0.0, 1.0
    for c in range(columns.shape[0]):
        g0, g1, g2 = G[0, columns[c]], G[1, columns[c]], G[2, columns[c]]
        s00 += A[0, c] * g0
        s10 += A[1, c] * g0
        s11 += A[1, c] * g1
        s20 += A[2, c] * g0
        s21 += A[2, c] * g1
        s22 += A[2, c] * g2
    l00 = math.sqrt(s00)
    l10, l20 = s10 / l00, s20 / l00
    l11 = math.sqrt(s11 - l10 * l10)
    l21 = (s21 - l20 * l10) / l11
    l22 = math.sqrt(s22 - l20 * l20 - l21 * l21)
    d0, d1, d2 = 1.0 / l00, 1.0 / l11, 1.0 / l22
    for i in range(G.shape[1]):
        g0 = G[0, i] * d0
        g1 = (G[1, i] - l10 * g0) * d1
        G[2, i] = (G[2, i] - l20 * g0 - l21 * g1) * d2
        G[0, i] = g0
        G[1, i] = g1
    z[0] *= d0
    z[1] = (z[1] - l10 * z[0]) * d1
    z[2] = (z[2] - l20 * z[0] - l21 * z[1]) * d2
    return l00 * l11 * l22


@njit('void(float64[::1], float64[:,::1], float64[:,::1], float64[::1])', **_COMPILE)
def _apply(x, P, G, z):
    """x += G' z and P -= G' G; both halves get the same products, so P stays symmetric."""
    n_x = P.shape[0]
    for i in range(n_x):
        g0, g1, g2 = G[0, i], G[1, i], G[2, i]
        x[i] += g0 * z[0] + g1 * z[1] + g2 * z[2]
        row = P[i]
        for j in range(n_x):
            row[j] -= g0 * G[0, j] + g1 * G[1, j] + g2 * G[2, j]


@njit('int64(float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], '
      'float64[:,:,::1], float64[:,:,::1], float64[:,:,:,::1], float64[:,::1], '
      'float64[::1], float64[::1])', **_COMPILE)
def _update_bank(x, P, x_lin, y, C, h, H, inflation, log_likelihood, nis):
    """Loop of the update over hypotheses and sensors; -1 where a noise is singular."""
    n_hyp, n_sensors, n_t, n_x = H.shape[0], H.shape[1], H.shape[3], x.shape[1]
    axes = np.empty(3, dtype=np.int64)
    # Columns of P that a sensor sees: the target's and its own background's, and padding.
    n_columns = 4 * ((n_t + 3 + 3) // 4)
    columns = np.zeros(n_columns, dtype=np.int64)
    for c in range(n_t):
        columns[c] = c
    L = np.zeros((3, 3))
    A, G = np.zeros((3, n_columns)), np.empty((3, n_x))
    z, residual = np.empty(3), np.empty(3)
    for p in range(n_hyp):
        for j in range(n_sensors):
            n = _cholesky_of_present(y[j], C[j], inflation[p, j], axes, L)
            if n < 0:
                return -1
            if n == 0:
                continue
            first = n_t + 3 * j
            for a in range(3):
                columns[n_t + a] = first + a
                residual[a] = y[j, a] - h[p, j, a] - x[p, first + a]
                for c in range(n_t):
                    residual[a] -= H[p, j, a, c] * (x[p, c] - x_lin[p, c])
            det = _whitened_rows(residual, H[p, j], L, axes, n, A, z)
            _gain_rows(P[p], A, columns, G)
            det *= _whiten_innovation(A, columns, G, z)
            _apply(x[p], P[p], G, z)
            q = z[0] * z[0] + z[1] * z[1] + z[2] * z[2]
            nis[p] += q
            log_likelihood[p] -= math.log(det) + 0.5 * (q + n * _LOG_2PI)
    return 0


def update(x, P, y, h, H, C, inflation, x_lin=None):
    """Measurement update of every hypothesis, in place.

    Parameters
    ----------
    x : (n_hyp, n_x), P : (n_hyp, n_x, n_x)
        Predicted states and covariances, C-contiguous; n_x = n_t + 3 n_sensors.
    y : (n_sensors, 3) [T], sensor frame
        Measurement; NaN = axis or sensor missing.
    h : (n_hyp, n_sensors, 3) [T], sensor frame
        Field of the target alone, at the linearisation point.
    H : (n_hyp, n_sensors, 3, n_t)
        Its derivative with respect to the target states.
    C : (n_sensors, 3, 3) [T^2]
        Noise covariance per sensor.
    inflation : (n_hyp, n_sensors) [T^2]
        Isotropic variance added to C (model error near the target).
    x_lin : (n_hyp, n_x), optional
        Linearisation point; the predicted state if left out.

    Returns
    -------
    log_likelihood : (n_hyp,)
        Log-density of the measurement given the past, in tesla^-n.
    nis : (n_hyp,)
        Normalised innovation squared; as many degrees of freedom as axes present.

    Raises
    ------
    ValueError
        A noise covariance is not positive definite.

    Source: T10 Alg. 2, measurement update; ICASSP11 eq. (9) for the inflation.
    """
    x_lin = x.copy() if x_lin is None else x_lin
    log_likelihood = np.zeros(len(x))
    nis = np.zeros(len(x))
    if _update_bank(x, P, x_lin, y, C, h, H, inflation, log_likelihood, nis) < 0:
        raise ValueError('a sensor\'s noise covariance is not positive definite')
    return log_likelihood, nis
