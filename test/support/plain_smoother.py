"""Backward pass of a smoother in NumPy, batched over hypotheses: an oracle.

It has the form of Bryson and Frazier: later measurements are carried backwards as a vector l and a
matrix L, so that a state filtered as (x, P) is smoothed to x + P l, with covariance P - P L P. No
covariance is inverted, so singular covariances need no special treatment. Source: Bierman 1973,
Fixed interval smoothing with discrete measurements (modified Bryson-Frazier), applied sensor by
sensor like `plain_kalman.update`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from support.plain_kalman import Gains


@dataclass(frozen=True)
class Step:
    """State of a filter at one time."""

    x: FloatArray
    """(n_hyp, n_x) States after the update."""
    P: FloatArray
    """(n_hyp, n_x, n_x) Covariances."""
    gains: Gains | None
    """Gains of the update; None without an update."""
    F: FloatArray | None = None
    """(n_t, n_t) or (n_hyp, n_t, n_t) Jacobian of the propagation to this time; None for the first
    step."""
    decay: FloatArray | None = None
    """(n_x - n_t,) Factors of the other states; None for the first step."""


def smoothed_states(steps: Sequence[Step]) -> list[FloatArray]:
    """[(n_hyp, n_x)] states at each of the `steps`, in order of time, given all measurements."""
    for step in steps:
        if step.gains is not None and step.gains.G.shape[::3] != step.x.shape:
            raise ValueError(f'gains {step.gains.G.shape} of states {step.x.shape}')
    after, out = np.zeros_like(steps[-1].x), []
    for step in reversed(steps):
        out.append(step.x + np.einsum('pik,pk->pi', step.P, after))
        if step.gains is not None:
            _adjoint_of_update(after, step.gains)
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


def _adjoint_of_update(after, gains):
    """Carry `after` (n_hyp, n_x) back over an update, in place, sensor by sensor."""
    for j in range(gains.G.shape[1] - 1, -1, -1):
        v = gains.z[:, j] - np.einsum('pai,pi->pa', gains.G[:, j], after)
        after += np.einsum('pab,pbi,pa->pi', gains.W[:, j], gains.A[:, j], v)


def _before(step, after):
    """Phi' `after` (n_hyp, n_x, m), where Phi is the propagation to `step`."""
    n_t = step.F.shape[-1]
    return np.concatenate([np.swapaxes(step.F, -1, -2) @ after[:, :n_t],
                           step.decay[:, None] * after[:, n_t:]], axis=1)


def _information_before_update(after, gains):
    """Carry `after` (n_hyp, n_x, n_x) back over an update, sensor by sensor."""
    for j in range(gains.G.shape[1] - 1, -1, -1):
        G, W_A = gains.G[:, j], gains.W[:, j] @ gains.A[:, j]
        kept = np.eye(after.shape[1]) - np.swapaxes(G, 1, 2) @ W_A
        after = np.swapaxes(kept, 1, 2) @ after @ kept + np.swapaxes(W_A, 1, 2) @ W_A
    return after
