"""Summaries of short intervals of readings (blocks), to which the background line is fitted."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.records import plain

MAX_VARIANCE_RATIO = 100.0
"""Maximum ratio of the variance of a block to the variance of the quietest block. A target that
passes within a block, as in the long blocks of a slow sensor, causes a higher ratio. Noise and
coarse steps cause much lower ratios."""


@dataclass(frozen=True)
class Block:
    """Time, mean and scatter of the readings in a short interval."""

    time: float
    """[s] Mean time of the readings."""
    mean: FloatArray
    """(3,) [T] Mean field; NaN for an unreported axis."""
    scatter: FloatArray
    """(3, 3) [T²] Scatter matrix: sum of the outer products of the deviations from the mean."""
    n: FloatArray
    """(3,) Number of samples per axis."""


def block_of(sensors: StructArray) -> Block:
    """Summarise the latest complete block of a sensor, (1,) SENSOR array."""
    return Block(*core.block_moments(sensors))


class Blocks(NamedTuple):
    """Sequence of k blocks; the fields are those of `Block`, stacked."""

    time: FloatArray
    mean: FloatArray
    scatter: FloatArray
    n: FloatArray


class BlockWindow:
    """Ring buffer of the latest blocks, stored as arrays to speed up line fits."""

    def __init__(self, max_blocks: int) -> None:
        self._time, self._n = np.zeros(max_blocks), np.zeros((max_blocks, 3))
        self._mean, self._scatter = np.zeros((max_blocks, 3)), np.zeros((max_blocks, 3, 3))
        self.clear()

    def __len__(self) -> int:
        return min(self._count, len(self._time))

    def clear(self) -> None:
        """Remove all blocks."""
        self._count = 0

    def append(self, block: Block) -> None:
        """Append a block; if the window is full, it replaces the oldest block."""
        i = self._count % len(self._time)
        self._time[i], self._mean[i], self._scatter[i] = block.time, block.mean, block.scatter
        self._n[i] = block.n
        self._count += 1

    def blocks(self) -> Blocks:
        """Stored blocks, in no particular order."""
        k = len(self)
        return Blocks(self._time[:k], self._mean[:k], self._scatter[:k], self._n[:k])


def line_through(blocks: Blocks) -> tuple[float, FloatArray, FloatArray]:
    """Weighted least-squares line through block means: mean time [s], value there, slope [T/s].

    The value is NaN for an axis that no block reports.
    """
    centre = float(blocks.time.mean())
    return centre, *core.line_through(
        plain(blocks.time), plain(blocks.n), plain(blocks.mean), centre)


def stacked(blocks: Iterable[Block]) -> Blocks:
    """Convert blocks to arrays."""
    return Blocks(*(np.array(values, dtype=float) for values in zip(*(
        (b.time, b.mean, b.scatter, b.n) for b in blocks), strict=True)))


def has_noisy_block(blocks: Blocks, step_variance: FloatArray) -> bool:
    """Whether the variance of a block far exceeds that of the quietest block, on any axis.

    `step_variance` (3,) in T² is the quantisation variance, the least variance compared.
    """
    n = blocks.n
    variance = np.where(n > 1, np.einsum('kii->ki', blocks.scatter) / np.maximum(n - 1, 1), np.nan)
    variance = np.maximum(variance, step_variance)
    reported = variance[:, ~np.isnan(variance).all(axis=0)]
    return bool((np.nanmax(reported, axis=0)
                 > MAX_VARIANCE_RATIO * np.nanmin(reported, axis=0)).any())


def pooled_covariance(blocks: Blocks) -> FloatArray | None:
    """Noise covariance (3, 3) T² from the scatter within blocks, pooled over all blocks.

    NaN for an axis with too few samples; None if all axes have too few.
    """
    return core.pooled_covariance(plain(blocks.scatter), plain(blocks.n))
