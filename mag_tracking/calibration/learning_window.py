"""Blocks of a sensor whose background is not known yet."""

from collections import deque
from collections.abc import Iterator

from mag_tracking.calibration.blocks import Block


class LearningWindow:
    """Collects blocks until there is a quiet interval of sufficient length.

    Parameters
    ----------
    learn : float, s
        Required length of a quiet interval.
    length : float, s
        Length of a block.
    max_blocks : int
        Maximum number of constant blocks that are kept.
    """

    def __init__(self, learn: float, length: float, max_blocks: int) -> None:
        # Measured between block centres; the blocks of a slow sensor may be longer than `length`.
        self._min_duration = learn - 1.5 * length
        self._constant: deque[Block] = deque(maxlen=max_blocks)
        self._changing: deque[Block] = deque()

    def clear(self) -> None:
        """Discard all blocks."""
        self._constant.clear()
        self._changing.clear()

    def segments(self, block: Block, is_stuck: bool) -> Iterator[deque[Block]]:
        """Add a block and yield the intervals that are long enough, the best one first.

        Parameters
        ----------
        block : Block
        is_stuck : bool
            Whether all readings of the block are equal.

        Yields
        ------
        deque of Block
        """
        self._changing.append(block)
        if is_stuck:
            # The steps are unknown until the first change, which may be due to a target.
            self._constant.append(block)
        elif self._constant \
                and self._constant[-1].time - self._constant[0].time >= self._min_duration:
            yield self._constant
        while len(self._changing) > 3 and block.time - self._changing[1].time >= self._min_duration:
            self._changing.popleft()
        if len(self._changing) >= 3 and block.time - self._changing[0].time >= self._min_duration:
            yield self._changing
