"""Blocks of a sensor whose background is not known yet."""

from collections import deque
from collections.abc import Iterator

from mag_tracking.calibration.blocks import Block


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
