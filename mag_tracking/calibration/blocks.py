"""Summaries of short stretches of readings, which a background is fitted to."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True)
class Block:
    """Summary of one short stretch."""

    time: float
    """[s], centre."""
    mean: np.ndarray
    """(3,) [T]; NaN = axis not reported."""
    scatter: np.ndarray
    """(3, 3) [T^2], sum of squared deviations."""
    n: np.ndarray
    """(3,) samples per axis."""


class Blocks(NamedTuple):
    """Many, as arrays: time (k,), mean (k, 3), scatter (k, 3, 3), n (k, 3); as in `Block`."""

    time: np.ndarray
    mean: np.ndarray
    scatter: np.ndarray
    n: np.ndarray


class BlockWindow:
    """The latest blocks, as arrays: a line is put through them as often as one comes."""

    def __init__(self, most):
        """`most` are kept."""
        self._time, self._n = np.zeros(most), np.zeros((most, 3))
        self._mean, self._scatter = np.zeros((most, 3)), np.zeros((most, 3, 3))
        self.clear()

    def __len__(self):
        return min(self._count, len(self._time))

    def clear(self):
        """Without any block."""
        self._count = 0

    def append(self, block):
        """The latest; it takes the place of the oldest."""
        i = self._count % len(self._time)
        self._time[i], self._mean[i], self._scatter[i] = block.time, block.mean, block.scatter
        self._n[i] = block.n
        self._count += 1

    def blocks(self):
        """The `Blocks`, in no order."""
        k = len(self)
        return Blocks(self._time[:k], self._mean[:k], self._scatter[:k], self._n[:k])


def stacked(blocks):
    """`Blocks` of a list of `Block`s."""
    return Blocks(*(np.array(values, dtype=float) for values in zip(*(
        (b.time, b.mean, b.scatter, b.n) for b in blocks), strict=True)))
