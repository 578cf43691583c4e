"""The backward pass of the Rauch-Tung-Striebel smoother."""

import numpy as np
from scipy.linalg import cho_solve

SMALLEST_PIVOT = 1e-4
"""Of a covariance at unit diagonal: below it two states are nearly one, and the inverse is that in
the directions which have a variance."""


def smooth(filtered, predicted, jacobians):
    """States given all measurements, from those given the measurements up to each time.

    Parameters
    ----------
    filtered : list of n (x (n_x,), P (n_x, n_x))
        After the update at each time.
    predicted : list of n - 1 (x, P)
        Before the update at each time but the first.
    jacobians : list of n - 1 (F (n_t, n_t), decay (n_x - n_t,))
        Of the propagation to each time but the first: of the first n_t states, and the factors
        of the others, which go each their own way.

    Returns
    -------
    list of n (x, P)

    Where a prediction has no variance in some direction nothing is learnt there, and the
    filtered value stays. Source: Rauch, Tung & Striebel 1965 (fixed interval).
    """
    x, P = filtered[-1]
    out = [(x, P)]
    for k in range(len(filtered) - 2, -1, -1):
        x_f, P_f = filtered[k]
        x_p, P_p = predicted[k]
        G = _solve(P_p, _propagated(*jacobians[k], P_f)).T
        x = x_f + G @ (x - x_p)
        P = P_f + G @ (P - P_p) @ G.T
        P = 0.5 * (P + P.T)
        out.append((x, P))
    return out[::-1]


def _propagated(F, decay, P):
    """blockdiag(F, diag(decay)) P."""
    n_t = len(F)
    return np.vstack([F @ P[:n_t], decay[:, None] * P[n_t:]])


def _solve(P, B):
    """P^-1 B, scaled to unit diagonal first: metres and teslas are decades apart."""
    std = np.sqrt(np.diagonal(P))
    scale = np.where(std > 0.0, std, 1.0)
    unit, B = P / np.outer(scale, scale), B / scale[:, None]
    try:
        L = np.linalg.cholesky(unit)
        if np.diagonal(L).min() > SMALLEST_PIVOT:
            return cho_solve((L, True), B) / scale[:, None]
    except np.linalg.LinAlgError:
        pass  # a point among rows: states without variance, or that are one
    # The rounding of a filter's covariance is near 1e-12 of its diagonal.
    return np.linalg.pinv(unit, rcond=1e-10, hermitian=True) @ B / scale[:, None]
