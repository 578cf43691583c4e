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


@njit('int64(float64[::1], float64[:,::1], float64, int64[::1], float64[:,::1])', cache=True)
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


@njit('float64(float64[::1], float64[:,::1], float64[::1], int64, int64, float64, '
      'float64[::1])', cache=True)
def _scalar_update(x, P, a, n_t, first, residual, Ph):
    """Update with one whitened row; returns the variance of the innovation `residual`.

    `a` covers the target states and one sensor's background. P stays exactly
    symmetric: both halves are the same products.
    """
    n_x = x.shape[0]
    Ph[:] = 0.0
    for c in range(n_t + 3):
        w = a[c]
        if w != 0.0:
            row = P[c if c < n_t else first + c - n_t]
            for i in range(n_x):
                Ph[i] += w * row[i]
    s = 1.0
    for c in range(n_t + 3):
        s += a[c] * Ph[c if c < n_t else first + c - n_t]
    gain = residual / s
    root = 1.0 / math.sqrt(s)
    for i in range(n_x):
        x[i] += gain * Ph[i]
        Ph[i] *= root
    for i in range(n_x):
        g = Ph[i]
        if g != 0.0:
            row = P[i]
            for j in range(n_x):
                row[j] -= g * Ph[j]
    return s


@njit('int64(float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], '
      'float64[:,:,::1], float64[:,:,::1], float64[:,:,:,::1], float64[:,::1], '
      'float64[::1], float64[::1])', cache=True)
def _update_bank(x, P, x_lin, y, C, h, H, inflation, log_likelihood, nis):
    """Loop of the update over hypotheses, sensors and axes; -1 where a noise is singular."""
    n_hyp, n_sensors, n_t = H.shape[0], H.shape[1], H.shape[3]
    axes = np.empty(3, dtype=np.int64)
    L = np.zeros((3, 3))
    rows = np.empty((3, n_t + 3))
    z = np.empty(3)
    Ph = np.empty(x.shape[1])
    for p in range(n_hyp):
        for j in range(n_sensors):
            n = _cholesky_of_present(y[j], C[j], inflation[p, j], axes, L)
            if n < 0:
                return -1
            first = n_t + 3 * j
            for i in range(n):
                # Forward substitution: row i of L^-1 [y - h | H | I].
                a = axes[i]
                z[i] = y[j, a] - h[p, j, a] - x_lin[p, first + a]
                for c in range(n_t):
                    rows[i, c] = H[p, j, a, c]
                for c in range(3):
                    rows[i, n_t + c] = 1.0 if c == a else 0.0
                for k in range(i):
                    z[i] -= L[i, k] * z[k]
                    for c in range(n_t + 3):
                        rows[i, c] -= L[i, k] * rows[k, c]
                z[i] /= L[i, i]
                for c in range(n_t + 3):
                    rows[i, c] /= L[i, i]
            for i in range(n):
                residual = z[i]
                for c in range(n_t):
                    residual -= rows[i, c] * (x[p, c] - x_lin[p, c])
                for c in range(3):
                    residual -= rows[i, n_t + c] * (x[p, first + c] - x_lin[p, first + c])
                s = _scalar_update(x[p], P[p], rows[i], n_t, first, residual, Ph)
                q = residual * residual / s
                nis[p] += q
                log_likelihood[p] -= 0.5 * (q + math.log(s) + _LOG_2PI) + math.log(L[i, i])
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
