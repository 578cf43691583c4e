"""Kalman filter in NumPy, batched over hypotheses, sensor by sensor: an oracle.

The states are those of `inference/hypothesis.hpp`: n_t of the target, n_own of each sensor, and
three backgrounds of each sensor.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Gains:
    """Gains of an update, sensor by sensor, as `plain_smoother` uses them.

    For each sensor, given those before it: z = W u whitens its innovation u, and x += G' z,
    P -= G' G, with G = W [H | I] P. Rows of missing axes are zero.
    """

    A: np.ndarray
    """(n_hyp, n_sensors, 3, n_x) Complete derivative [H | I]."""
    G: np.ndarray
    """(n_hyp, n_sensors, 3, n_x)"""
    z: np.ndarray
    """(n_hyp, n_sensors, 3)"""
    W: np.ndarray
    """(n_hyp, n_sensors, 3, 3)"""


def predict(x, P, x_target, F, Q, variance, decay=1.0):
    """Time update in place: `x_target` (n_hyp, n_t) with Jacobian `F` and noise `Q`.

    The other states are multiplied by `decay`, and `variance` is added.
    """
    n_hyp, n_t = x_target.shape
    rest = np.arange(n_t, x.shape[1])
    A, noise = np.zeros_like(P), np.zeros_like(P)
    A[:, :n_t, :n_t], noise[:, :n_t, :n_t] = F, Q
    A[:, rest, rest], noise[:, rest, rest] = decay, variance
    x[:, :n_t], x[:, n_t:] = x_target, x[:, n_t:] * decay
    P[:] = A @ P @ np.swapaxes(A, 1, 2) + noise
    P[:] = 0.5 * (P + np.swapaxes(P, 1, 2))


def whole_derivative(H, n_own):
    """(n_hyp, n_sensors, 3, n_x) complete derivative of `H` (n_hyp, n_sensors, 3, n_t + n_own)."""
    n_hyp, n_sensors, _, n_seen = H.shape
    n_t = n_seen - n_own
    A = np.zeros((n_hyp, n_sensors, 3, n_t + (n_own + 3) * n_sensors))
    for j in range(n_sensors):
        own, first = n_t + n_own * j, A.shape[3] - 3 * (n_sensors - j)
        A[:, j, :, :n_t] = H[:, j, :, :n_t]
        A[:, j, :, own:own + n_own] = H[:, j, :, n_t:]
        A[:, j, :, first:first + 3] = np.eye(3)
    return A


def update(x, P, y, h, H, C, inflation, x_lin=None, n_own=0):
    """Measurement update of every hypothesis, in place.

    `y` (n_sensors, 3), NaN for a missing axis; `h` (n_hyp, n_sensors, 3) without the backgrounds
    and `H` (n_hyp, n_sensors, 3, n_t + n_own), at `x_lin` (n_hyp, n_x) or the prediction; `C`
    (n_sensors, 3, 3); `inflation` (n_hyp, n_sensors) of the variance of each axis. Returns the
    log-likelihood (n_hyp,), the NIS (n_hyp, n_sensors) of each sensor given those before it, and
    the `Gains`.
    """
    x_lin = x.copy() if x_lin is None else x_lin
    n_hyp, n_sensors, n_x = len(x), len(y), x.shape[1]
    A = whole_derivative(H, n_own)
    A[:, np.isnan(y)] = 0.0
    log_likelihood, nis = np.zeros(n_hyp), np.zeros((n_hyp, n_sensors))
    gains = Gains(A, np.zeros((n_hyp, n_sensors, 3, n_x)), np.zeros((n_hyp, n_sensors, 3)),
                  np.zeros((n_hyp, n_sensors, 3, 3)))
    for j in range(n_sensors):
        there = np.flatnonzero(~np.isnan(y[j]))
        if not len(there):
            continue
        of_axes = A[:, j, there]
        u = y[j, there] - h[:, j, there] - x_lin[:, n_x - 3 * (n_sensors - j) + there] \
            - np.einsum('pai,pi->pa', of_axes, x - x_lin)
        noise = C[j][np.ix_(there, there)] + inflation[:, j, None, None] * np.eye(len(there))
        S = of_axes @ P @ np.swapaxes(of_axes, 1, 2) + noise
        L = np.linalg.cholesky(S)
        W = np.linalg.inv(L)
        G = W @ of_axes @ P
        z = np.einsum('pab,pb->pa', W, u)
        x += np.einsum('pai,pa->pi', G, z)
        P -= np.swapaxes(G, 1, 2) @ G
        gains.G[:, j, there], gains.z[:, j, there] = G, z
        gains.W[:, j, there[:, None], there] = W
        nis[:, j] = np.square(z).sum(axis=1)
        log_likelihood -= 0.5 * (nis[:, j] + len(there) * np.log(2.0 * np.pi)) \
            + np.log(np.einsum('paa->pa', L)).sum(axis=1)
    return log_likelihood, nis, gains
