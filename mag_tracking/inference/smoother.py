"""The backward pass of a smoother, batched over hypotheses.

In the form of Bryson and Frazier: what comes later is carried backwards as a vector l and a
matrix L, so that a state that was filtered as (x, P) is x + P l given everything, with covariance
P - P L P. No covariance is inverted, so states that are known exactly, or that are one, need no
care. Source: Bierman 1973, Fixed interval smoothing with discrete measurements (modified
Bryson-Frazier), here sensor by sensor as `kalman.update` goes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.kalman import Gains


@dataclass(frozen=True)
class Step:
    """What a filter did at one time."""

    x: FloatArray
    """(n_hyp, n_x) states after the update."""
    P: FloatArray
    """(n_hyp, n_x, n_x) their covariances."""
    gains: Gains | None
    """Of the update; None where there was none."""
    F: FloatArray | None = None
    """(n_t, n_t) or (n_hyp, n_t, n_t) Jacobian of the propagation to this time; None at the first
    one."""
    decay: FloatArray | None = None
    """(n_x - n_t,) what the other states were multiplied by, each on its own; None at the first
    one."""


def smoothed_states(steps: Sequence[Step]) -> list[FloatArray]:
    """States at each time given the measurements of all times.

    Parameters
    ----------
    steps : list of Step
        In the order of time. Where one has no gains nothing was measured.

    Returns
    -------
    list of (n_hyp, n_x)

    Raises ValueError where the gains are not of as many hypotheses and states as the steps.
    """
    for step in steps:
        if step.gains is not None and step.gains.G.shape[::3] != step.x.shape:
            raise ValueError(f'gains {step.gains.G.shape} of states {step.x.shape}')
    after, out = np.zeros_like(steps[-1].x), []
    for step in reversed(steps):
        out.append(step.x + np.einsum('pik,pk->pi', step.P, after))
        if step.gains is not None:
            g = step.gains
            _adjoint_of_update(after, g.H, g.n_own, g.G, g.z, g.W)
        if step.F is not None:
            after = _before(step, after[:, :, None])[:, :, 0]
    return out[::-1]


def smoothed_covariances(steps: Sequence[Step]) -> list[FloatArray]:
    """[(n_hyp, n_x, n_x)] covariances at each of the `steps`; see `smoothed_states`."""
    after, out = np.zeros_like(steps[-1].P), []
    for step in reversed(steps):
        P = step.P - step.P @ after @ step.P
        out.append(0.5 * (P + np.swapaxes(P, 1, 2)))
        if step.gains is not None:
            after = _information_before_update(after, step.gains)
        if step.F is not None:
            after = _before(step, np.swapaxes(_before(step, after), 1, 2))
    return out[::-1]


def _before(step: Step, after: FloatArray) -> FloatArray:
    """Phi' `after` (n_hyp, n_x, m), where Phi is the propagation to `step`, which has one."""
    assert step.F is not None and step.decay is not None
    n_t = step.F.shape[-1]
    return np.concatenate([np.swapaxes(step.F, -1, -2) @ after[:, :n_t],
                           step.decay[:, None] * after[:, n_t:]], axis=1)


def _information_before_update(after: FloatArray, gains: Gains) -> FloatArray:
    """(n_hyp, n_x, n_x): `after` carried back over an update, sensor by sensor."""
    n_sensors, n_t = gains.H.shape[1], gains.H.shape[3] - gains.n_own
    n_x = after.shape[1]
    rows, columns = np.tril_indices(3)
    for j in range(n_sensors - 1, -1, -1):
        W = np.zeros((len(after), 3, 3))
        W[:, rows, columns] = gains.W[:, j]
        H = np.zeros((len(after), 3, n_x))
        own = n_t + gains.n_own * j
        H[:, :, :n_t] = gains.H[:, j, :, :n_t]
        H[:, :, own:own + gains.n_own] = gains.H[:, j, :, n_t:]
        first = n_x - 3 * (n_sensors - j)
        H[:, :, first:first + 3] = np.eye(3)
        # A missing axis has no gain, and tells nothing.
        H[~gains.G[:, j].any(axis=2)] = 0.0
        W_H, G = W @ H, gains.G[:, j]
        back = np.swapaxes(W_H, 1, 2)
        kept = after - back @ (G @ after)
        after = kept - (kept @ np.swapaxes(G, 1, 2)) @ W_H + back @ W_H
    return after


@njit('void(float64[:,::1], float64[:,:,:,::1], int64, float64[:,:,:,::1], float64[:,:,::1], '
      'float64[:,:,::1])', cache=True, error_model='numpy')
def _adjoint_of_update(after: FloatArray, H: FloatArray, n_own: int, G: FloatArray, z: FloatArray,
                       W: FloatArray) -> None:
    """`after` (n_hyp, n_x) carried back over an update, in place, sensor by sensor."""
    n_hyp, n_sensors, n_x = H.shape[0], H.shape[1], after.shape[1]
    n_t = H.shape[3] - n_own
    for p in range(n_hyp):
        for j in range(n_sensors - 1, -1, -1):
            v0, v1, v2 = z[p, j, 0], z[p, j, 1], z[p, j, 2]
            for i in range(n_x):
                v0 -= G[p, j, 0, i] * after[p, i]
                v1 -= G[p, j, 1, i] * after[p, i]
                v2 -= G[p, j, 2, i] * after[p, i]
            u0 = W[p, j, 0] * v0 + W[p, j, 1] * v1 + W[p, j, 3] * v2
            u1 = W[p, j, 2] * v1 + W[p, j, 4] * v2
            u2 = W[p, j, 5] * v2
            for c in range(n_t + n_own):
                i = c if c < n_t else c + n_own * j
                after[p, i] += u0 * H[p, j, 0, c] + u1 * H[p, j, 1, c] + u2 * H[p, j, 2, c]
            first = n_x - 3 * (n_sensors - j)
            after[p, first] += u0
            after[p, first + 1] += u1
            after[p, first + 2] += u2
