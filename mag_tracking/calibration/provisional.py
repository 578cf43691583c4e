"""Provisional background: the most frequent level until a quiet interval is long enough.

In dense traffic no interval is quiet for several seconds, and a sensor without a background cannot
contribute to tracking.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Block, stacked
from mag_tracking.calibration.frequent_level import (
    MIN_DURATION_RATIO,
    MostFrequentLevel,
    most_frequent_level,
)

WAIT_RATIO = 2.0
"""Waiting time for a quiet interval, relative to its required length."""

MIN_BLOCKS = 12
"""Minimum number of blocks for the first search, independent of the rate of the sensor."""

MAX_BLOCKS = 240
"""Maximum number of stored blocks: a minute of blocks of the usual length."""

SEARCH_GROWTH = 1.1
"""Factor by which the number of blocks must grow before the level is determined again."""

MIN_OBSERVED_S = 10.0
"""[s] Minimum total duration of a level that is considered certain. It must also be at least
`MIN_DURATION_RATIO` times the duration of any other level."""

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution relative to its median absolute deviation."""


@dataclass(frozen=True)
class FrequentLevel:
    """The most frequent level of the latest blocks."""

    level: MostFrequentLevel
    std: FloatArray
    """(3,) [T] Uncertainty of the level: median distance of all blocks from the level, scaled to a
    standard deviation. It is large for a level observed for less than half of the time. NaN for an
    unreported axis."""
    is_certain: bool
    """Whether the level was observed for at least `MIN_OBSERVED_S`, and at least
    `MIN_DURATION_RATIO` times as long as any other level."""

    @property
    def observed_s(self) -> float:
        """Total duration for which the level was observed [s]."""
        return self.level.n_blocks * self.level.block_s


class ProvisionalLevel:
    """Collects the blocks of a sensor and periodically determines their most frequent level."""

    def __init__(self, learn_s: float) -> None:
        self._min_duration_s = WAIT_RATIO * learn_s
        self.clear()

    def clear(self) -> None:
        """Discard all blocks."""
        self._blocks: deque[Block] = deque(maxlen=MAX_BLOCKS)
        self._n_new, self._n_required = 0, MIN_BLOCKS

    def collect(self, block: Block) -> None:
        """Add the next block."""
        self._blocks.append(block)
        self._n_new += 1

    def frequent_level(self, steps: FloatArray) -> FrequentLevel | None:
        """Most frequent level; None if none is frequent enough, or too few blocks are new.

        `steps` (3,) in T are the quantisation steps; inf if unknown.
        """
        blocks = self._blocks
        if self._n_new < self._n_required \
                or blocks[-1].time - blocks[0].time < self._min_duration_s:
            return None
        self._n_new, self._n_required = 0, max(1, int((SEARCH_GROWTH - 1.0) * len(blocks)))
        arrays = stacked(blocks)
        level = most_frequent_level(arrays, np.where(np.isfinite(steps), steps, 0.0), MAX_BLOCKS)
        if level is None:
            return None
        distance, is_known = np.full(3, np.nan), ~np.isnan(level.level)
        distance[is_known] = np.nanmedian(
            np.abs(arrays.mean[:, is_known] - level.level[is_known]), axis=0)
        is_certain = level.n_blocks * level.block_s >= MIN_OBSERVED_S \
            and level.n_blocks >= MIN_DURATION_RATIO * level.n_rival
        return FrequentLevel(level, MAD_TO_STD * distance, is_certain)
