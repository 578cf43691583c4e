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


@njit('void(float64[::1], float64[:,::1], float64[:,::1], int64[::1], int64, float64[:,::1], '
      'float64[:,::1], float64[::1])', **_COMPILE)
def _whitened_rows(residual, H, L, axes, n, A, A_b, z):
    """L^-1 [H | I | residual] of the `n` present axes, into A, A_b and z."""
    n_t = A.shape[1]
    for i in range(n):
        a = axes[i]
        z[i] = residual[a]
        for c in range(n_t):
            A[i, c] = H[a, c]
        for c in range(3):
            A_b[i, c] = 0.0
        A_b[i, a] = 1.0
        for k in range(i):
            w = L[i, k]
            z[i] -= w * z[k]
            for c in range(n_t):
                A[i, c] -= w * A[k, c]
            for c in range(3):
                A_b[i, c] -= w * A_b[k, c]
        w = 1.0 / L[i, i]
        z[i] *= w
        for c in range(n_t):
            A[i, c] *= w
        for c in range(3):
            A_b[i, c] *= w


@njit('void(float64[:,::1], float64[:,::1], float64[:,::1], int64, int64, float64[:,::1])',
      **_COMPILE)
def _gain_rows(P, A, A_b, n, first, T):
    """T = [A, A_b] P for the columns of the target and of one sensor's background."""
    n_x, n_t = P.shape[0], A.shape[1]
    T[:n] = 0.0
    if n == 3:
        for c in range(n_t + 3):
            if c < n_t:
                row, a0, a1, a2 = P[c], A[0, c], A[1, c], A[2, c]
            else:
                b = c - n_t
                row, a0, a1, a2 = P[first + b], A_b[0, b], A_b[1, b], A_b[2, b]
            for i in range(n_x):
                p = row[i]
                T[0, i] += a0 * p
                T[1, i] += a1 * p
                T[2, i] += a2 * p
        return
    for k in range(n):
        for c in range(n_t):
            for i in range(n_x):
                T[k, i] += A[k, c] * P[c, i]
        for b in range(3):
            for i in range(n_x):
                T[k, i] += A_b[k, b] * P[first + b, i]


@njit('void(float64[:,::1], float64[:,::1], int64)', **_COMPILE)
def _downdate(P, G, n):
    """P -= G' G; both halves get the same products, so P stays exactly symmetric."""
    n_x = P.shape[0]
    for i in range(n_x):
        row = P[i]
        if n == 3:
            g0, g1, g2 = G[0, i], G[1, i], G[2, i]
            for j in range(n_x):
                row[j] -= g0 * G[0, j] + g1 * G[1, j] + g2 * G[2, j]
        else:
            for k in range(n):
                for j in range(n_x):
                    row[j] -= G[k, i] * G[k, j]


@njit('float64(float64[:,::1], float64[:,::1], int64, int64, float64[:,::1], float64[::1], '
      'float64[:,::1])', **_COMPILE)
def _whiten_innovation(A, A_b, n, first, G, z, S):
    """Divide innovation z and gain rows G by the Cholesky factor of S; half its log-determinant."""
    n_t, n_x = A.shape[1], G.shape[1]
    for i in range(n):
        for k in range(i + 1):
            s = 1.0 if i == k else 0.0
            for c in range(n_t):
                s += A[i, c] * G[k, c]
            for b in range(3):
                s += A_b[i, b] * G[k, first + b]
            S[i, k] = s
    half = 0.0
    for i in range(n):
        for k in range(i + 1):
            for m in range(k):
                S[i, k] -= S[i, m] * S[k, m]
            if k < i:
                S[i, k] /= S[k, k]
        S[i, i] = math.sqrt(S[i, i])
        half += math.log(S[i, i])
    for i in range(n):
        for k in range(i):
            w = S[i, k]
            z[i] -= w * z[k]
            for j in range(n_x):
                G[i, j] -= w * G[k, j]
        w = 1.0 / S[i, i]
        z[i] *= w
        for j in range(n_x):
            G[i, j] *= w
    return half


@njit('int64(float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], '
      'float64[:,:,::1], float64[:,:,::1], float64[:,:,:,::1], float64[:,::1], '
      'float64[::1], float64[::1])', **_COMPILE)
def _update_bank(x, P, x_lin, y, C, h, H, inflation, log_likelihood, nis):
    """Loop of the update over hypotheses and sensors; -1 where a noise is singular."""
    n_hyp, n_sensors, n_t, n_x = H.shape[0], H.shape[1], H.shape[3], x.shape[1]
    axes = np.empty(3, dtype=np.int64)
    L, S, A_b = np.zeros((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    A, G = np.empty((3, n_t)), np.empty((3, n_x))
    z, residual = np.empty(3), np.empty(3)
    for p in range(n_hyp):
        for j in range(n_sensors):
            n = _cholesky_of_present(y[j], C[j], inflation[p, j], axes, L)
            if n < 0:
                return -1
            first = n_t + 3 * j
            for a in range(3):
                residual[a] = y[j, a] - h[p, j, a] - x[p, first + a]
                for c in range(n_t):
                    residual[a] -= H[p, j, a, c] * (x[p, c] - x_lin[p, c])
            _whitened_rows(residual, H[p, j], L, axes, n, A, A_b, z)
            _gain_rows(P[p], A, A_b, n, first, G)
            half = _whiten_innovation(A, A_b, n, first, G, z, S)
            for i in range(n):
                w = z[i]
                for c in range(n_x):
                    x[p, c] += w * G[i, c]
                nis[p] += w * w
                half += math.log(L[i, i]) + 0.5 * w * w
            _downdate(P[p], G, n)
            log_likelihood[p] -= half + 0.5 * n * _LOG_2PI
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
