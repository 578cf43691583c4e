"""A background before a quiet stretch was long enough: the most frequent level so far.

In dense traffic no stretch is quiet for seconds, and a sensor without a background is of no use.
"""

from collections import deque

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Block, stacked
from mag_tracking.calibration.frequent_level import MORE, QuietLevel, most_frequent_level

PATIENCE = 2.0
"""A quiet stretch is waited for so many times as long as it has to be."""

LEAST_BLOCKS = 12
"""It takes so many blocks, however slow the sensor."""

MOST_BLOCKS = 240
"""The level is that of the latest blocks, a minute of the usual length."""

GROWTH = 1.1
"""It is found again when there are so many times as many blocks."""

SEEN_S = 10.0
"""[s] A level is certain once it was seen for so long in all, and far longer than any other."""

TO_DEVIATION = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


class ProvisionalLevel:
    """Collects the blocks of a sensor and finds their most frequent level now and then."""

    def __init__(self, learn_s: float) -> None:
        """`learn_s` [s]: length of a quiet stretch that would be enough."""
        self._patience_s = PATIENCE * learn_s
        self.clear()

    def clear(self) -> None:
        """Begin again."""
        self._blocks: deque[Block] = deque(maxlen=MOST_BLOCKS)
        self._since_last, self._due = 0, LEAST_BLOCKS

    def add(self, block: Block, steps: FloatArray) -> tuple[QuietLevel, FloatArray, bool] | None:
        """The next block of a sensor whose axes change by `steps` (3,) [T], inf = unknown.

        Returns
        -------
        level : QuietLevel
            All of it is None where it is too soon, or no level was found.
        deviation : (3,) array, T
            Of the level, which may be that of something that stands there; NaN = axis not reported.
        is_certain : bool
            Whether the level is the background.
        """
        self._blocks.append(block)
        self._since_last += 1
        if self._since_last < self._due or block.time - self._blocks[0].time < self._patience_s:
            return None
        self._since_last, self._due = 0, max(1, int((GROWTH - 1.0) * len(self._blocks)))
        blocks = stacked(self._blocks)
        found = most_frequent_level(blocks, np.where(np.isfinite(steps), steps, 0.0), MOST_BLOCKS)
        if found is None:
            return None
        apart = np.full(3, np.nan)
        known = ~np.isnan(found.level)
        apart[known] = np.nanmedian(np.abs(blocks.mean[:, known] - found.level[known]), axis=0)
        is_certain = found.n_blocks * found.block_s >= SEEN_S \
            and found.n_blocks >= MORE * found.n_rival
        return found, TO_DEVIATION * apart, is_certain
