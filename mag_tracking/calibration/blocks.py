"""Summaries of short intervals of readings (blocks), windows of them, and lines through them."""

from collections import deque
from collections.abc import Iterable, Iterator
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


class QuietInterval:
    """Window of the latest quiet blocks.

    A block enters only after the guard time in s, so that the gradual onset of a target is
    excluded; until then it is `pending`.
    """

    def __init__(self, guard: float, max_blocks: int) -> None:
        self._guard = guard
        self._window = BlockWindow(max_blocks)
        self.pending: deque[Block] = deque()

    def __len__(self) -> int:
        return len(self._window)

    def clear(self) -> None:
        """Discard all blocks."""
        self._window.clear()
        self.pending.clear()

    def begin(self, blocks: Iterable[Block]) -> None:
        """Restart the interval with the given blocks."""
        self._window.clear()
        for block in blocks:
            self._window.append(block)

    def extend(self, block: Block) -> Iterator[Blocks]:
        """Queue the next quiet block, and yield the window after each block that enters it."""
        self.pending.append(block)
        while self.pending and self.pending[0].time <= block.time - self._guard:
            self._window.append(self.pending.popleft())
            yield self.blocks()

    def blocks(self) -> Blocks:
        """Blocks of the interval, in no particular order."""
        return self._window.blocks()

    def scatter(self) -> FloatArray:
        """Pooled variance (3,) T² of the readings within the blocks; NaN if unknown."""
        covariance = pooled_covariance(self.blocks()) if self else None
        return np.full(3, np.nan) if covariance is None else covariance.diagonal()


def line_of(blocks: Blocks) -> tuple[float, FloatArray, FloatArray, float]:
    """Linear trend as in `BackgroundLevel`: centre [s], mean [T], slope [T/s] and horizon [s].

    The drift is extrapolated for at most twice the duration of the blocks.
    """
    first, last = float(blocks.time.min()), float(blocks.time.max())
    return *line_through(blocks), last + 2.0 * (last - first)


class LearningWindow:
    """Window of the latest blocks, which provides candidates for the first quiet interval.

    `learn` [s] is the required duration of a quiet interval, `length` [s] that of a block. At most
    `max_blocks` blocks whose readings are all equal are stored.
    """

    def __init__(self, learn: float, length: float, max_blocks: int) -> None:
        # Measured between block centres; the blocks of a slow sensor may be longer than `length`.
        self._min_duration = learn - 1.5 * length
        self._constant_blocks: deque[Block] = deque(maxlen=max_blocks)
        self._recent: deque[Block] = deque()

    def clear(self) -> None:
        """Discard all blocks."""
        self._constant_blocks.clear()
        self._recent.clear()

    def segments(self, block: Block, is_stuck: bool) -> Iterator[deque[Block]]:
        """Add a block; yield the candidate intervals that are long enough, best first.

        `is_stuck` means that all readings of the block are equal.
        """
        self._recent.append(block)
        if is_stuck:
            # The steps are unknown until the first change, which may be due to a target.
            self._constant_blocks.append(block)
        elif self._constant_blocks \
                and self._constant_blocks[-1].time - self._constant_blocks[0].time \
                >= self._min_duration:
            yield self._constant_blocks
        while len(self._recent) > 3 and block.time - self._recent[1].time >= self._min_duration:
            self._recent.popleft()
        if len(self._recent) >= 3 and block.time - self._recent[0].time >= self._min_duration:
            yield self._recent
