"""A background before a quiet stretch was long enough: the most frequent level so far.

In dense traffic no stretch is quiet for seconds, and a sensor without a background is of no use.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Block, stacked
from mag_tracking.calibration.frequent_level import MORE, QuietLevel, most_frequent_level

PATIENCE = 2.0
"""A quiet stretch is waited for so many times as long as it has to be."""

MIN_BLOCKS = 12
"""It takes so many blocks, however slow the sensor."""

MAX_BLOCKS = 240
"""The level is that of the latest blocks, a minute of the usual length."""

GROWTH = 1.1
"""It is found again when there are so many times as many blocks."""

SEEN_S = 10.0
"""[s] A level is certain once it was seen for so long in all, and far longer than any other."""

TO_DEVIATION = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class FrequentLevel:
    """The most frequent level of the latest blocks."""

    level: QuietLevel
    deviation: FloatArray
    """(3,) [T] Median distance of all the blocks from it, as a standard deviation: a level seen for
    less than half of the time may be that of something else. NaN = axis not reported."""
    is_certain: bool
    """Whether it was seen for long enough, and far longer than any other level."""

    @property
    def seen_s(self) -> float:
        """[s] For how long it was seen, in all."""
        return self.level.n_blocks * self.level.block_s


class ProvisionalLevel:
    """Collects the blocks of a sensor and finds their most frequent level now and then."""

    def __init__(self, learn_s: float) -> None:
        """`learn_s` [s]: length of a quiet stretch that would be enough."""
        self._patience_s = PATIENCE * learn_s
        self.clear()

    def clear(self) -> None:
        """Begin again."""
        self._blocks: deque[Block] = deque(maxlen=MAX_BLOCKS)
        self._since_last, self._due = 0, MIN_BLOCKS

    def collect(self, block: Block) -> None:
        """Take the next block."""
        self._blocks.append(block)
        self._since_last += 1

    def found(self, steps: FloatArray) -> FrequentLevel | None:
        """The most frequent level, if it is time to look for it.

        Parameters
        ----------
        steps : (3,) array, T
            By which the axes of the sensor change; inf = unknown.
        """
        blocks = self._blocks
        if self._since_last < self._due or blocks[-1].time - blocks[0].time < self._patience_s:
            return None
        self._since_last, self._due = 0, max(1, int((GROWTH - 1.0) * len(blocks)))
        all_of = stacked(blocks)
        level = most_frequent_level(all_of, np.where(np.isfinite(steps), steps, 0.0), MAX_BLOCKS)
        if level is None:
            return None
        apart, known = np.full(3, np.nan), ~np.isnan(level.level)
        apart[known] = np.nanmedian(np.abs(all_of.mean[:, known] - level.level[known]), axis=0)
        is_certain = level.n_blocks * level.block_s >= SEEN_S \
            and level.n_blocks >= MORE * level.n_rival
        return FrequentLevel(level, TO_DEVIATION * apart, is_certain)
