"""The stretch of quiet blocks that a background is fitted to."""

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
    """The latest quiet blocks, a while behind the present: a target comes near gradually.

    Attributes
    ----------
    pending : deque of Block
        Those that wait.
    """

    def __init__(self, guard: float, most: int) -> None:
        """It stays `guard` [s] behind the present; `most` blocks are kept."""
        self._guard = guard
        self._window = BlockWindow(most)
        self.pending: deque[Block] = deque()

    def __len__(self) -> int:
        return len(self._window)

    def clear(self) -> None:
        """Drop all blocks."""
        self._window.clear()
        self.pending.clear()

    def begin(self, blocks: Iterable[Block]) -> None:
        """Begin with `blocks`."""
        self._window.clear()
        for block in blocks:
            self._window.append(block)

    def extend(self, block: Block) -> Iterator[Blocks]:
        """Take the next quiet block; all `Blocks` after each one that has waited for long enough.
        """
        self.pending.append(block)
        while self.pending and self.pending[0].time <= block.time - self._guard:
            self._window.append(self.pending.popleft())
            yield self.blocks()

    def blocks(self) -> Blocks:
        """The `Blocks`, in no order."""
        return self._window.blocks()

    def scatter(self) -> FloatArray:
        """(3,) [T^2] variance within the blocks; NaN = unknown."""
        found = pooled_covariance(self.blocks()) if self else None
        return np.full(3, np.nan) if found is None else found.diagonal()


def line_of(blocks: Blocks) -> tuple[float, FloatArray, FloatArray, float]:
    """Line through blocks, as `BackgroundLevel` has it.

    The drift holds for at most twice as long as the stretch that it is of.
    """
    first, last = float(blocks.time.min()), float(blocks.time.max())
    return *line_through(blocks), last + 2.0 * (last - first)
