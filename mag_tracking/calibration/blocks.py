"""Summaries of short intervals of readings (blocks), windows of them, and lines through them."""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.records import plain

MAX_VARIANCE_RATIO = 100.0
"""Maximum variance of a block relative to the quietest one; a target within it causes more."""


class Block(NamedTuple):
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


def line_through(blocks: Blocks) -> tuple[float, FloatArray, FloatArray]:
    """Weighted least-squares line through block means: mean time [s], value there, slope [T/s]."""
    centre = float(blocks.time.mean())
    return centre, *core.line_through(
        plain(blocks.time), plain(blocks.n), plain(blocks.mean), centre)


def stacked(blocks: Iterable[Block]) -> Blocks:
    """Convert blocks to arrays."""
    return Blocks(*(np.array(values, dtype=float) for values in zip(*blocks, strict=True)))


def has_noisy_block(blocks: Blocks, step_variance: FloatArray) -> bool:
    """Whether the variance of a block, at least `step_variance` (3,) T², far exceeds others."""
    n = blocks.n
    variance = np.where(n > 1, np.einsum('kii->ki', blocks.scatter) / np.maximum(n - 1, 1), np.nan)
    variance = np.maximum(variance, step_variance)
    reported = variance[:, ~np.isnan(variance).all(axis=0)]
    return bool((np.nanmax(reported, axis=0)
                 > MAX_VARIANCE_RATIO * np.nanmin(reported, axis=0)).any())


def pooled_covariance(blocks: Blocks) -> FloatArray | None:
    """Noise covariance (3, 3) T² from the scatter within all blocks; NaN for an axis with too few
    samples, None if all axes have too few."""
    return core.pooled_covariance(plain(blocks.scatter), plain(blocks.n))


class QuietInterval:
    """Ring buffer of the latest quiet blocks, as arrays, to which a background is fitted; a block
    is `pending` for the guard time in s, to exclude the gradual onset of a target."""

    def __init__(self, guard: float, max_blocks: int) -> None:
        self._guard = guard
        self._window = Blocks(np.zeros(max_blocks), np.zeros((max_blocks, 3)),
                              np.zeros((max_blocks, 3, 3)), np.zeros((max_blocks, 3)))
        self.pending: deque[Block] = deque()
        self._count = 0

    def __len__(self) -> int:
        return min(self._count, len(self._window.time))

    def clear(self) -> None:
        """Discard all blocks."""
        self.begin(())
        self.pending.clear()

    def begin(self, blocks: Iterable[Block]) -> None:
        """Restart the interval with the given blocks."""
        self._count = 0
        for block in blocks:
            self._append(block)

    def _append(self, block: Block) -> None:
        """Append a block; if the interval is full, it replaces the oldest block."""
        i = self._count % len(self._window.time)
        time, mean, scatter, n = self._window
        time[i], mean[i], scatter[i], n[i] = block
        self._count += 1

    def extend(self, block: Block) -> Iterator[Blocks]:
        """Queue the next quiet block, and yield the interval after each block that enters it."""
        self.pending.append(block)
        while self.pending and self.pending[0].time <= block.time - self._guard:
            self._append(self.pending.popleft())
            yield self.blocks()

    def blocks(self) -> Blocks:
        """Blocks of the interval, in no particular order."""
        return Blocks(*(values[:len(self)] for values in self._window))


class LearningWindow:
    """Window of the latest blocks, which provides candidates for the first quiet interval.

    `learn` [s] is the required duration, `length` [s] that of a block; at most `max_blocks` blocks
    of equal readings are stored.
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
        """Add a block; yield the candidate intervals that are long enough, best first."""
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
