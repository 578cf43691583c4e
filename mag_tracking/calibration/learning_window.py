"""Blocks of a sensor before its background is known."""

from collections import deque
from collections.abc import Iterator

from mag_tracking.calibration.blocks import Block


class LearningWindow:
    """Collects blocks until a quiet stretch of them is long enough."""

    def __init__(self, learn: float, length: float, most: int) -> None:
        """A stretch of `learn` [s], in blocks of `length` [s], of which `most` are kept."""
        # From centre to centre; the blocks of a slow sensor may be longer than `length`.
        self._enough = learn - 1.5 * length
        self._rested: deque[Block] = deque(maxlen=most)
        self._moved: deque[Block] = deque()

    def clear(self) -> None:
        """Begin again."""
        self._rested.clear()
        self._moved.clear()

    def segments(self, block: Block, is_stuck: bool) -> Iterator[deque[Block]]:
        """The stretches that are long enough with the next block, the best one first.

        `is_stuck` says whether no reading of it differs from another.
        """
        self._moved.append(block)
        if is_stuck:
            # Without a change nothing is known of the steps. The first one comes with a target.
            self._rested.append(block)
        elif self._rested and self._rested[-1].time - self._rested[0].time >= self._enough:
            yield self._rested
        while len(self._moved) > 3 and block.time - self._moved[1].time >= self._enough:
            self._moved.popleft()
        if len(self._moved) >= 3 and block.time - self._moved[0].time >= self._enough:
            yield self._moved
