"""Non-linear least squares from many starts at once.

The model comes in as a function, so that this file is mathematics only.
"""

import numpy as np


def refine(residual_and_jacobian, x, n_iterations=40):
    """Levenberg-Marquardt on many starts at once, each with its own damping.

    Parameters
    ----------
    residual_and_jacobian : function
        Takes (n, n_x), returns whitened residuals (n, n_y) (measured minus
        predicted) and the Jacobians (n, n_y, n_x) of the prediction.
    x : (n, n_x)
        Starts.
    n_iterations : int

    Returns
    -------
    x : (n, n_x)
    cost : (n,)
        Sum of squared whitened residuals; infinite where a start is unusable.
    covariance : (n, n_x, n_x)
        Pseudo-inverse of the information at x.

    Source: T10 section 2.3, Alg. 1.
    """
    x = np.array(x, dtype=float)
    residual, J, cost = _evaluate(residual_and_jacobian, x)
    damping = np.full(len(x), 1e-3)
    for _ in range(n_iterations):
        information = np.einsum('nyi,nyj->nij', J, J)
        # Marquardt's scaling: damping is relative to each parameter's own information.
        diagonal = np.einsum('nii->ni', information)
        A = information + (damping[:, None] * diagonal)[:, :, None] * np.eye(x.shape[1])
        step = np.einsum('nij,nj->ni', _inverse(A), np.einsum('nyi,ny->ni', J, residual))
        trial = x + step
        trial_residual, trial_J, trial_cost = _evaluate(residual_and_jacobian, trial)
        better = trial_cost < cost
        x[better], cost[better] = trial[better], trial_cost[better]
        residual[better], J[better] = trial_residual[better], trial_J[better]
        damping = np.where(better, damping * 0.2, damping * 5.0)
        if np.all(np.abs(step) <= 1e-10 * np.abs(x)):
            break
    return x, cost, _inverse(np.einsum('nyi,nyj->nij', J, J))


def _evaluate(residual_and_jacobian, x):
    """Residuals, Jacobians and costs; an unusable point costs infinity."""
    residual, J = residual_and_jacobian(x)
    cost = np.einsum('ni,ni->n', residual, residual)
    bad = ~np.isfinite(cost)
    residual[bad], J[bad], cost[bad] = 0.0, 0.0, np.inf
    return residual, J, cost


def _inverse(A):
    """Pseudo-inverses (n, k, k), scaled to unit diagonal first: units differ by decades."""
    scale = np.sqrt(np.einsum('nii->ni', A))
    scale = np.where(scale > 0.0, scale, 1.0)
    outer = scale[:, :, None] * scale[:, None, :]
    return np.linalg.pinv(A / outer, hermitian=True) / outer


def project_out_linear(A, y):
    """Best linear parameters of many linear models y = A p + e, e ~ N(0, I).

    Parameters
    ----------
    A : (n, n_y, k)
    y : (n_y,)

    Returns
    -------
    p : (n, k)
    cost : (n,)
        Remaining sum of squares.
    """
    normal = np.einsum('nyi,nyj->nij', A, A)
    p = np.einsum('nij,nj->ni', _inverse(normal), np.einsum('nyi,y->ni', A, y))
    residual = y - np.einsum('nyi,ni->ny', A, p)
    return p, np.einsum('ny,ny->n', residual, residual)
