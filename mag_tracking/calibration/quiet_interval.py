"""Interval of quiet blocks to which a background is fitted."""

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import (
    Block,
    Blocks,
    BlockWindow,
    line_through,
    pooled_covariance,
)


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
