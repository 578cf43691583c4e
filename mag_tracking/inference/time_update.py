"""Kalman prediction, batched over hypotheses; the states are those of `inference.kalman`."""

import numpy as np
from numba import njit

from mag_tracking.arrays import BoolArray, CompileOptions, FloatArray
from mag_tracking.records import plain


def predict(x: FloatArray, P: FloatArray, x_target: FloatArray, F: FloatArray, Q: FloatArray,
            variance: float | FloatArray, decay: float | FloatArray | None = None) -> None:
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
    _predict_bank(x, P, plain(F).reshape(-1, n_t, n_t), plain(Q).reshape(-1, n_t, n_t),
                  *(np.array(np.broadcast_to(v, n_rest), dtype=float) for v in (variance, decay)))


_INLINE: CompileOptions = {'error_model': 'numpy', 'fastmath': {'contract'}, 'forceinline': True}


@njit(**_INLINE)
def _find_what_moves(F: FloatArray, f: int, moves: BoolArray) -> None:
    """Note the rows in which Jacobian `f` is not that of what stays as it is."""
    for a in range(len(moves)):
        moves[a] = F[f, a, a] != 1.0
        for c in range(len(moves)):
            moves[a] |= c != a and F[f, a, c] != 0.0


@njit(**_INLINE)
def _fade(x: FloatArray, P: FloatArray, p: int, n_t: int, decay: FloatArray) -> None:
    """Multiply the states behind the target's by `decay`."""
    for i in range(n_t, x.shape[1]):
        x[p, i] *= decay[i - n_t]
        for k in range(n_t, x.shape[1]):
            P[p, i, k] *= decay[i - n_t] * decay[k - n_t]
        for a in range(n_t):
            P[p, a, i] *= decay[i - n_t]
            P[p, i, a] = P[p, a, i]


@njit(**_INLINE)
def _move(P: FloatArray, p: int, F: FloatArray, f: int, moves: BoolArray, T: FloatArray) -> None:
    """P = F P F' for the target's states; most of F is zero, and most rows stay as they are."""
    n_t, n_x = len(moves), P.shape[1]
    for a in range(n_t):
        if moves[a]:
            T[a] = 0.0
            for c in range(n_t):
                if F[f, a, c] != 0.0:
                    for i in range(n_x):
                        T[a, i] += F[f, a, c] * P[p, c, i]
    for a in range(n_t):
        if moves[a]:
            for i in range(n_x):
                P[p, a, i] = T[a, i]
            for i in range(n_t, n_x):
                P[p, i, a] = T[a, i]
    # The same of the target's columns: F is applied from the right.
    for a in range(n_t):
        if moves[a]:
            T[a, :n_t] = 0.0
            for c in range(n_t):
                if F[f, a, c] != 0.0:
                    for b in range(n_t):
                        T[a, b] += P[p, b, c] * F[f, a, c]
    for a in range(n_t):
        if moves[a]:
            for b in range(n_t):
                P[p, b, a] = T[a, b]


@njit('void(float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], '
      'float64[::1], float64[::1])', cache=True, error_model='numpy', fastmath={'contract'})
def _predict_bank(x: FloatArray, P: FloatArray, F: FloatArray, Q: FloatArray, variance: FloatArray,
                  decay: FloatArray) -> None:
    """Loop over the hypotheses; what is behind the target's states only decays and grows.

    `F` and `Q` are one for each, or one for all.
    """
    n_t, n_x = F.shape[1], x.shape[1]
    T, moves = np.empty((n_t, n_x)), np.zeros(n_t, np.bool_)
    fades = False
    for i in range(n_x - n_t):
        fades |= decay[i] != 1.0
    for p in range(len(x)):
        f, q = p % len(F), p % len(Q)
        if fades:
            _fade(x, P, p, n_t, decay)
        for i in range(n_t, n_x):
            P[p, i, i] += variance[i - n_t]
        if p == 0 or len(F) > 1:
            _find_what_moves(F, f, moves)
        _move(P, p, F, f, moves, T)
        # Both triangles, so that no rounding makes it lopsided.
        for a in range(n_t):
            P[p, a, a] += Q[q, a, a]
            for b in range(a):
                P[p, a, b] = P[p, b, a] = 0.5 * (P[p, a, b] + P[p, b, a] + Q[q, a, b]
                                                 + Q[q, b, a])
