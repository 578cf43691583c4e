"""Hypotheses at the start of a window: known and new vehicles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.geometry import overlap
from mag_tracking.stages.track.bank_filter import BankFilter

OVERLAP_WIDTH, OVERHANG, DEPTH_STD = 1.5, 1.0, 1.0
"""[m] Lateral distance below which two vehicles overlap, minimum longitudinal gap between their
rows of dipoles, and standard deviation of the overlap depth due to uncertain paths."""


@dataclass(frozen=True)
class PathHypothesis:
    """A hypothesis of several vehicles, with the path along which it is linearised."""

    x: FloatArray
    """(n_x,) State at the start of the window."""
    P: FloatArray
    """(n_x, n_x) Covariance at the start of the window."""
    path: FloatArray
    """(n, n_x) States at the frames of the window."""
    label: tuple[int, ...]
    """Index of the arrival direction of each vehicle."""
    kind: tuple[int, ...]
    log_w: float


@dataclass(frozen=True)
class WindowStart(PathHypothesis):
    """Hypothesis of known and new vehicles, at the start of a window."""

    n_new: int
    """Number of new vehicles, which are the last ones."""
    replaced: int | None
    """As in `JointExplanation`."""

    @property
    def new_indices(self) -> range:
        """Indices of the new vehicles."""
        return range(len(self.kind) - self.n_new, len(self.kind))


@dataclass(frozen=True)
class KnownVehicleHypothesis(PathHypothesis):
    """Hypothesis of the known vehicles in a search for new vehicles."""

    filter: BankFilter | None
    """Filter for this number of vehicles; None if no vehicle is known."""


def inserted(P: FloatArray, block: FloatArray, at: int) -> FloatArray:
    """Covariance (n + k, n + k) with an independent `block` (k, k) inserted into `P` at row
    `at`."""
    n, k = len(P), len(block)
    rows = np.append(np.arange(at), np.arange(at + k, n + k))
    out = np.zeros((n + k, n + k))
    out[rows[:, None], rows] = P
    out[at:at + k, at:at + k] = block
    return out


def in_order_of(first: FloatArray, pair: FloatArray) -> FloatArray:
    """Pair of paths (2, 7) in the order that matches another pair best, by distance."""
    d = np.linalg.norm(pair[:, None, :2] - first[:, :2], axis=2)
    return pair if d[0, 0] + d[1, 1] <= d[0, 1] + d[1, 0] else pair[::-1].copy()


def labels_of(labels: Sequence[tuple[int, ...]]) -> IntArray:
    """Labels of each vehicle, for each hypothesis, in the shape required by `FilterBank`, (n,) or
    (n, n_targets)."""
    out = np.array(labels)
    return out[:, 0].copy() if out.shape[1] == 1 else out


def overlap_depth(path: FloatArray, n_one: int, n_targets: int, length_column: int | None) -> float:
    """Maximum depth by which any two vehicles overlap along a joint path (n, n_x), m.

    Each vehicle has `n_one` states, with its length at `length_column`, which is None if all
    vehicles are points.
    """
    x = path[:, :n_one * n_targets].reshape(len(path), n_targets, n_one)
    depth = 0.0
    for i in range(n_targets):
        for k in range(i):
            gap = OVERHANG + (0.0 if length_column is None else
                              0.5 * (np.abs(x[:, i, length_column])
                                     + np.abs(x[:, k, length_column])))
            pair = x[:, [i, k]].swapaxes(0, 1)
            depth = max(depth, float(overlap(
                pair[:, :, :2], pair[:, :, 3:5], gap, OVERLAP_WIDTH).max()))
    return depth
