"""Provisional background before a quiet interval is long enough: the most frequent level so far.

In dense traffic no interval is quiet for seconds, and a sensor without a background is useless.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Block, stacked
from mag_tracking.calibration.frequent_level import (
    MIN_DURATION_RATIO,
    QuietLevel,
    most_frequent_level,
)

WAIT_RATIO = 2.0
"""Waiting time for a quiet interval, relative to its required length."""

MIN_BLOCKS = 12
"""Minimum number of blocks, independent of the rate of the sensor."""

MAX_BLOCKS = 240
"""Maximum number of blocks, the latest ones: a minute of the usual length."""

SEARCH_GROWTH = 1.1
"""Growth of the number of blocks after which the level is determined again."""

MIN_SEEN_S = 10.0
"""[s] Minimum total duration of a certain level, which must also be far longer than that of any
other."""

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution relative to its median absolute deviation."""


@dataclass(frozen=True)
class FrequentLevel:
    """The most frequent level of the latest blocks."""

    level: QuietLevel
    std: FloatArray
    """(3,) [T] Median distance of all blocks from the level, scaled to a standard deviation: a
    level observed for less than half of the time may not be the background. NaN = axis not
    reported."""
    is_certain: bool
    """Whether it was observed for long enough, and far longer than any other level."""

    @property
    def seen_s(self) -> float:
        """Total duration for which the level was observed [s]."""
        return self.level.n_blocks * self.level.block_s


class ProvisionalLevel:
    """Collects the blocks of a sensor and determines their most frequent level from time to time.

    Parameters
    ----------
    learn_s : float, s
        Required length of a quiet interval.
    """

    def __init__(self, learn_s: float) -> None:
        self._patience_s = WAIT_RATIO * learn_s
        self.clear()

    def clear(self) -> None:
        """Discard all blocks."""
        self._blocks: deque[Block] = deque(maxlen=MAX_BLOCKS)
        self._since_last, self._due = 0, MIN_BLOCKS

    def collect(self, block: Block) -> None:
        """Add the next block.

        Parameters
        ----------
        block : Block
        """
        self._blocks.append(block)
        self._since_last += 1

    def found(self, steps: FloatArray) -> FrequentLevel | None:
        """Most frequent level, if it is due.

        Parameters
        ----------
        steps : (3,) array, T
            Steps of the axes of the sensor; inf = unknown.

        Returns
        -------
        FrequentLevel or None
        """
        blocks = self._blocks
        if self._since_last < self._due or blocks[-1].time - blocks[0].time < self._patience_s:
            return None
        self._since_last, self._due = 0, max(1, int((SEARCH_GROWTH - 1.0) * len(blocks)))
        all_of = stacked(blocks)
        level = most_frequent_level(all_of, np.where(np.isfinite(steps), steps, 0.0), MAX_BLOCKS)
        if level is None:
            return None
        apart, known = np.full(3, np.nan), ~np.isnan(level.level)
        apart[known] = np.nanmedian(np.abs(all_of.mean[:, known] - level.level[known]), axis=0)
        is_certain = level.n_blocks * level.block_s >= MIN_SEEN_S \
            and level.n_blocks >= MIN_DURATION_RATIO * level.n_rival
        return FrequentLevel(level, MAD_TO_STD * apart, is_certain)
