"""Kalman prediction, batched over hypotheses; the states are those of `inference.kalman`."""

import numpy as np
from numba import njit


def predict(x, P, x_target, F, Q, variance, decay=None):
    """Time update of every hypothesis, in place.

    Parameters
    ----------
    x : (n_hyp, n_x)
        States; the first n_t are replaced by `x_target`.
    P : (n_hyp, n_x, n_x)
        Covariances, symmetric.
    x_target : (n_hyp, n_t)
        Propagated target states.
    F, Q : (n_hyp, n_t, n_t) or (n_t, n_t)
        Jacobian of the propagation and covariance of the process noise.
    variance : float or (n_x - n_t,)
        Added to the states behind the target's.
    decay : (n_x - n_t,), optional
        Before that they are multiplied by this.

    Raises ValueError where the shapes do not fit.

    Source: T10 Alg. 2, time update.
    """
    n_hyp, n_t = x_target.shape
    n_rest = x.shape[1] - n_t
    if len(x) != n_hyp or P.shape != (n_hyp, n_t + n_rest, n_t + n_rest):
        raise ValueError(f'covariances of shape {P.shape} and states of shape {x.shape} for '
                         f'{n_hyp} targets')
    if any(A.shape not in ((n_t, n_t), (n_hyp, n_t, n_t)) for A in (F, Q)):
        raise ValueError(f'a Jacobian of shape {F.shape} and a noise of shape {Q.shape} for '
                         f'{n_hyp} targets of {n_t} states')
    x[:, :n_t] = x_target
    decay = 1.0 if decay is None else decay
    # Copies of what is broadcast, as that is of no layout that the kernel is compiled for.
    _predict_bank(x, P, *(np.ascontiguousarray(A.reshape(-1, n_t, n_t), dtype=float)
                          for A in (F, Q)),
                  *(np.array(np.broadcast_to(v, n_rest), dtype=float) for v in (variance, decay)))


@njit(cache=True, error_model='numpy')
def _find_what_moves(F, moves):
    """Note the rows in which a Jacobian (n_t, n_t) is not that of what stays as it is."""
    for a in range(len(F)):
        moves[a] = F[a, a] != 1.0
        for c in range(len(F)):
            moves[a] |= c != a and F[a, c] != 0.0


@njit('void(float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], '
      'float64[::1], float64[::1])', cache=True, error_model='numpy', fastmath={'contract'})
def _predict_bank(x, P, F, Q, variance, decay):
    """Loop over the hypotheses; what is behind the target's states only decays and grows.

    `F` and `Q` are one for each, or one for all.
    """
    n_t, n_x = F.shape[1], x.shape[1]
    T, moves = np.empty((n_t, n_x)), np.zeros(n_t, np.bool_)
    fades = False
    for i in range(n_x - n_t):
        fades |= decay[i] != 1.0
    for p in range(len(x)):
        of_f, of_q = p % len(F), p % len(Q)
        if fades:
            for i in range(n_t, n_x):
                x[p, i] *= decay[i - n_t]
                for k in range(n_t, n_x):
                    P[p, i, k] *= decay[i - n_t] * decay[k - n_t]
                for a in range(n_t):
                    P[p, a, i] *= decay[i - n_t]
                    P[p, i, a] = P[p, a, i]
        for i in range(n_t, n_x):
            P[p, i, i] += variance[i - n_t]
        if p == 0 or len(F) > 1:
            _find_what_moves(F[of_f], moves)
        # T = F times the rows of the target; most of F is zero, and most rows stay as they are.
        for a in range(n_t):
            if moves[a]:
                T[a] = 0.0
                for c in range(n_t):
                    f = F[of_f, a, c]
                    if f != 0.0:
                        for i in range(n_x):
                            T[a, i] += f * P[p, c, i]
        for a in range(n_t):
            if moves[a]:
                for i in range(n_t, n_x):
                    P[p, a, i] = T[a, i]
                    P[p, i, a] = T[a, i]
                for b in range(n_t):
                    P[p, a, b] = T[a, b]
        # The same of their columns: F is applied from the right.
        for a in range(n_t):
            if moves[a]:
                for b in range(n_t):
                    T[a, b] = 0.0
                for c in range(n_t):
                    f = F[of_f, a, c]
                    if f != 0.0:
                        for b in range(n_t):
                            T[a, b] += P[p, b, c] * f
        for a in range(n_t):
            if moves[a]:
                for b in range(n_t):
                    P[p, b, a] = T[a, b]
        # Both triangles, so that no rounding makes it lopsided.
        for a in range(n_t):
            P[p, a, a] += Q[of_q, a, a]
            for b in range(a):
                P[p, a, b] = P[p, b, a] = 0.5 * (P[p, a, b] + P[p, b, a] + Q[of_q, a, b]
                                                 + Q[of_q, b, a])
