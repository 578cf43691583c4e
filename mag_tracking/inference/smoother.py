"""The backward pass of the Rauch-Tung-Striebel smoother."""

import numpy as np


def smooth(filtered, predicted, jacobians):
    """States given all measurements, from those given the measurements up to each time.

    Parameters
    ----------
    filtered : list of n (x (n_x,), P (n_x, n_x))
        After the update at each time.
    predicted : list of n - 1 (x, P)
        Before the update at each time but the first.
    jacobians : list of n - 1 (n_x, n_x)
        Of the propagation to each time but the first.

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
        G = P_f @ jacobians[k].T @ _inverse(P_p)
        x = x_f + G @ (x - x_p)
        P = P_f + G @ (P - P_p) @ G.T
        P = 0.5 * (P + P.T)
        out.append((x, P))
    return out[::-1]


def _inverse(P):
    """Pseudo-inverse, scaled to unit diagonal first: metres and teslas are decades apart."""
    std = np.sqrt(np.diagonal(P))
    scale = np.where(std > 0.0, std, 1.0)
    outer = np.outer(scale, scale)
    # The rounding of a filter's covariance is near 1e-12 of its diagonal.
    return np.linalg.pinv(P / outer, rcond=1e-10, hermitian=True) / outer
