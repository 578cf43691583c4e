"""Kalman filter in NumPy, batched over hypotheses and sequential over sensors, as an oracle.

The state vector is as in `inference/hypothesis.hpp`: n_t states of the target, n_own states of each
sensor, and three backgrounds of each sensor.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Gains:
    """Gains of a sequential update over the sensors.

    For each sensor, conditional on the preceding sensors, z = W u is the whitened innovation u. The
    update is x += G' z, P -= G' G, with G = W [H | I] P. Rows of missing axes are zero.
    """

    A: np.ndarray
    """Jacobian [H | I] for all states, (n_hyp, n_sensors, 3, n_x)."""
    G: np.ndarray
    """Whitened gain, (n_hyp, n_sensors, 3, n_x)."""
    z: np.ndarray
    """Whitened innovation, (n_hyp, n_sensors, 3)."""
    W: np.ndarray
    """Whitening matrix, (n_hyp, n_sensors, 3, 3)."""


def predict(x, P, x_target, F, Q, variance, decay=1.0):
    """Time update in place: `x_target` (n_hyp, n_t) with Jacobian `F` and noise `Q`.

    All other states are multiplied by `decay`, and `variance` is added to their variances.
    """
    n_hyp, n_t = x_target.shape
    others = np.arange(n_t, x.shape[1])
    A, noise = np.zeros_like(P), np.zeros_like(P)
    A[:, :n_t, :n_t], noise[:, :n_t, :n_t] = F, Q
    A[:, others, others], noise[:, others, others] = decay, variance
    x[:, :n_t], x[:, n_t:] = x_target, x[:, n_t:] * decay
    P[:] = A @ P @ np.swapaxes(A, 1, 2) + noise
    P[:] = 0.5 * (P + np.swapaxes(P, 1, 2))


def full_jacobian(H, n_own):
    """Expand `H` (n_hyp, n_sensors, 3, n_t + n_own) to all states, (n_hyp, n_sensors, 3, n_x)."""
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

    `y` (n_sensors, 3) is the measurement, with NaN for missing axes. `h` (n_hyp, n_sensors, 3) is
    its prediction without the backgrounds, with the Jacobian `H` (n_hyp, n_sensors, 3, n_t +
    n_own), both at `x_lin` (n_hyp, n_x) or the predicted state. `C` (n_sensors, 3, 3) is the noise
    covariance, and `inflation` (n_hyp, n_sensors) is added to the variance of each axis. Returns
    the log-likelihood (n_hyp,), the NIS (n_hyp, n_sensors) of each sensor conditional on the
    preceding sensors, and the `Gains`.
    """
    x_lin = x.copy() if x_lin is None else x_lin
    n_hyp, n_sensors, n_x = len(x), len(y), x.shape[1]
    A = full_jacobian(H, n_own)
    A[:, np.isnan(y)] = 0.0
    log_likelihood, nis = np.zeros(n_hyp), np.zeros((n_hyp, n_sensors))
    gains = Gains(A, np.zeros((n_hyp, n_sensors, 3, n_x)), np.zeros((n_hyp, n_sensors, 3)),
                  np.zeros((n_hyp, n_sensors, 3, 3)))
    for j in range(n_sensors):
        axes = np.flatnonzero(~np.isnan(y[j]))
        if not len(axes):
            continue
        of_axes = A[:, j, axes]
        u = y[j, axes] - h[:, j, axes] - x_lin[:, n_x - 3 * (n_sensors - j) + axes] \
            - np.einsum('pai,pi->pa', of_axes, x - x_lin)
        noise = C[j][np.ix_(axes, axes)] + inflation[:, j, None, None] * np.eye(len(axes))
        S = of_axes @ P @ np.swapaxes(of_axes, 1, 2) + noise
        L = np.linalg.cholesky(S)
        W = np.linalg.inv(L)
        G = W @ of_axes @ P
        z = np.einsum('pab,pb->pa', W, u)
        x += np.einsum('pai,pa->pi', G, z)
        P -= np.swapaxes(G, 1, 2) @ G
        gains.G[:, j, axes], gains.z[:, j, axes] = G, z
        gains.W[:, j, axes[:, None], axes] = W
        nis[:, j] = np.square(z).sum(axis=1)
        log_likelihood -= 0.5 * (nis[:, j] + len(axes) * np.log(2.0 * np.pi)) \
            + np.log(np.einsum('paa->pa', L)).sum(axis=1)
    return log_likelihood, nis, gains
