"""Hypotheses at the beginning of a window: vehicles that are known there, and others that come."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.geometry import overlap
from mag_tracking.stages.track.bank_filter import BankFilter

WIDTH, OVERHANG, DEPTH_STD = 1.5, 1.0, 1.0
"""[m] Two bodies are in each other's way that are less than so much apart across their heading; by
so much they are longer than their rows together; and by so much their paths may be off."""


@dataclass(frozen=True)
class PathHypothesis:
    """A hypothesis of some vehicles, with the path to linearise it along."""

    x: FloatArray
    """(n_x,) at the beginning of the window."""
    P: FloatArray
    """(n_x, n_x)"""
    path: FloatArray
    """(n, n_x)"""
    label: tuple[int, ...]
    """The arrival of each vehicle."""
    kind: tuple[int, ...]
    log_w: float


@dataclass(frozen=True)
class WindowStart(PathHypothesis):
    """Known vehicles, and others that were sought."""

    n_new: int
    """So many vehicles were sought: the last ones."""
    replaced: int | None
    """As of `Joint`."""

    @property
    def are_new(self) -> range:
        """Places of the vehicles that were sought."""
        return range(len(self.kind) - self.n_new, len(self.kind))


@dataclass(frozen=True)
class KnownVehicles(PathHypothesis):
    """Vehicles beside which others are sought."""

    filter: BankFilter | None
    """The filter of so many vehicles; None where there are none."""


def inserted(P: FloatArray, block: FloatArray, at: int) -> FloatArray:
    """The covariance `P` (n, n) with an independent `block` (k, k) from row `at` on."""
    n, k = len(P), len(block)
    rows = np.append(np.arange(at), np.arange(at + k, n + k))
    out = np.zeros((n + k, n + k))
    out[rows[:, None], rows] = P
    out[at:at + k, at:at + k] = block
    return out


def in_order_of(first: FloatArray, pair: FloatArray) -> FloatArray:
    """A pair of paths (2, 7), the nearer one of the `first` pair's first coming first."""
    away = np.linalg.norm(pair[:, None, :2] - first[:, :2], axis=2)
    return pair if away[0, 0] + away[1, 1] <= away[0, 1] + away[1, 0] else pair[::-1].copy()


def labels_of(labels: Sequence[tuple[int, ...]]) -> IntArray:
    """(n,) or (n, n_targets) as of a `FilterBank`."""
    out = np.array(labels)
    return out[:, 0].copy() if out.shape[1] == 1 else out


def overlap_depth(path: FloatArray, n_one: int, n_targets: int, length: int | None) -> float:
    """[m] by how much two vehicles of a `path` (n, n_x) are in each other at most.

    Each has `n_one` states, of which `length` is the column of its length; None: all are points.
    """
    x = path[:, :n_one * n_targets].reshape(len(path), n_targets, n_one)
    depth = 0.0
    for i in range(n_targets):
        for k in range(i):
            need = OVERHANG + (0.0 if length is None else
                               0.5 * (np.abs(x[:, i, length]) + np.abs(x[:, k, length])))
            pair = x[:, [i, k]].swapaxes(0, 1)
            depth = max(depth, float(overlap(pair[:, :, :2], pair[:, :, 3:5], need, WIDTH).max()))
    return depth
