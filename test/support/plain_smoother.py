"""Backward pass of a smoother in NumPy, batched over hypotheses, as an oracle.

The modified Bryson-Frazier form is used: a vector l and a matrix L propagate the information of
later measurements backwards. A filtered state (x, P) is smoothed to x + P l with covariance
P - P L P. No covariance is inverted, so singular covariances need no special treatment. Source:
Bierman 1973, Fixed interval smoothing with discrete measurements. Like `plain_kalman.update`, it is
applied sensor by sensor.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from support.plain_kalman import Gains


@dataclass(frozen=True)
class Step:
    """State of a filter after the step at one time."""

    x: FloatArray
    """States after the update, (n_hyp, n_x)."""
    P: FloatArray
    """Covariances after the update, (n_hyp, n_x, n_x)."""
    gains: Gains | None
    """Gains of the update; None without an update."""
    F: FloatArray | None = None
    """Jacobian of the propagation to this time, (n_t, n_t) or (n_hyp, n_t, n_t). None for the first
    step."""
    decay: FloatArray | None = None
    """Decay factors of the states beyond n_t, (n_x - n_t,). None for the first step."""


def smoothed_states(steps: Sequence[Step]) -> list[FloatArray]:
    """Smoothed states (n_hyp, n_x) at each of the chronological `steps`."""
    for step in steps:
        if step.gains is not None and step.gains.G.shape[::3] != step.x.shape:
            raise ValueError(f'gains of shape {step.gains.G.shape} do not match states of shape '
                             f'{step.x.shape}')
    after, out = np.zeros_like(steps[-1].x), []
    for step in reversed(steps):
        out.append(step.x + np.einsum('pik,pk->pi', step.P, after))
        if step.gains is not None:
            _adjoint_of_update(after, step.gains)
        if step.F is not None:
            after = _before(step, after[:, :, None])[:, :, 0]
    return out[::-1]


def smoothed_covariances(steps: Sequence[Step]) -> list[FloatArray]:
    """Smoothed covariances (n_hyp, n_x, n_x) at each of the chronological `steps`."""
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
    """Propagate l, `after` (n_hyp, n_x), backwards through an update, in place, sensor by
    sensor."""
    for j in range(gains.G.shape[1] - 1, -1, -1):
        v = gains.z[:, j] - np.einsum('pai,pi->pa', gains.G[:, j], after)
        after += np.einsum('pab,pbi,pa->pi', gains.W[:, j], gains.A[:, j], v)


def _before(step, after):
    """Phi' times `after` (n_hyp, n_x, m), where Phi propagates states to the time of `step`."""
    n_t = step.F.shape[-1]
    return np.concatenate([np.swapaxes(step.F, -1, -2) @ after[:, :n_t],
                           step.decay[:, None] * after[:, n_t:]], axis=1)


def _information_before_update(after, gains):
    """Propagate L, `after` (n_hyp, n_x, n_x), backwards through an update, sensor by sensor."""
    for j in range(gains.G.shape[1] - 1, -1, -1):
        G, W_A = gains.G[:, j], gains.W[:, j] @ gains.A[:, j]
        update = np.eye(after.shape[1]) - np.swapaxes(G, 1, 2) @ W_A
        after = np.swapaxes(update, 1, 2) @ after @ update + np.swapaxes(W_A, 1, 2) @ W_A
    return after
