"""Most frequent level of a sensor, its background if targets are often nearby.

In dense traffic no interval is quiet for several seconds, and a sensor without a background cannot
contribute to tracking. The level is provisional until a quiet interval is long enough.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration import core
from mag_tracking.calibration.blocks import Block, Blocks, line_through, pooled_covariance, stacked

MAX_CALM_RATIO = 3.0
"""Maximum std within a block, relative to the 20 % quantile of all blocks; a target exceeds it."""
LEVEL_WIDTH, MIN_WIDTH = 4.0, 5e-9
"""Maximum difference between a block and its level per axis, in standard deviations of a mean, and
at least [T], which allows for drift."""
MIN_REPORTED_FRACTION = 0.5
"""An axis is evaluated if more than this fraction of the blocks contain it."""
MIN_BLOCKS = 4
"""Minimum number of blocks of a level."""
MIN_LEVEL_DISTANCE = 3.0
"""Minimum distance of another level, in widths. A distant target may change a level by less."""
MIN_DURATION_RATIO = 4.0
"""Minimum duration of a level that replaces the initial level, relative to that of the latter."""
BATCH_SIZE = 64
"""Number of blocks that are compared with all other blocks in one operation, to limit memory."""
WAIT_RATIO = 2.0
"""Waiting time for a quiet interval, relative to its required length."""
MIN_SEARCHED_BLOCKS, MAX_BLOCKS, SEARCH_GROWTH = 12, 240, 1.1
"""Minimum and maximum number of searched blocks (a minute of the usual length), and factor by which
their number must grow between searches."""
MIN_OBSERVED_S = 10.0
"""[s] Minimum total duration of a level that is considered certain."""


@dataclass(frozen=True)
class MostFrequentLevel:
    """The most frequent level of a sensor."""

    n_blocks: int
    n_rival: int
    """Number of blocks at the second most frequent level."""
    begin: float
    end: float
    """[s] Times of the first and the last block at the level."""
    level: FloatArray
    """(3,) [T] Mean of the earliest blocks at the level; NaN for an unreported axis."""
    covariance: FloatArray
    """(3, 3) [T²] Covariance of the readings within blocks; NaN for an unreported axis."""
    block_s: float
    """[s] Typical length of a block."""
    width: FloatArray
    """(3,) [T] Maximum difference between the mean of a block and the level."""

    @property
    def observed_s(self) -> float:
        """Total duration for which the level was observed [s]."""
        return self.n_blocks * self.block_s

    @property
    def is_certain(self) -> bool:
        """Whether the level was observed long enough, and longer than any other level."""
        return self.observed_s >= MIN_OBSERVED_S \
            and self.n_blocks >= MIN_DURATION_RATIO * self.n_rival

    def is_at(self, level: FloatArray) -> bool:
        """Whether a level (3,) T is the same within `MIN_LEVEL_DISTANCE` widths."""
        return not bool((np.abs(self.level - level) > MIN_LEVEL_DISTANCE * self.width).any())


def most_frequent_level(blocks: Blocks, steps: FloatArray, max_blocks: int
                        ) -> MostFrequentLevel | None:
    """Find the most frequent level of chronological blocks, from the earliest `max_blocks` at it.

    `steps` (3,) in T are the quantisation steps, inf if unknown. None if no level has `MIN_BLOCKS`
    blocks, or the noise is unknown on all axes.
    """
    steps = np.where(np.isfinite(steps), steps, 0.0)
    n = np.maximum(blocks.n, 1.0)
    variance = np.einsum('kii->ki', blocks.scatter) / np.maximum(n - 1.0, 1.0)
    variance = np.where(blocks.n > 1, np.maximum(variance, steps**2 / 12.0), np.nan)
    # An axis that is rarely reported would exclude the blocks without it.
    is_used = (~np.isnan(variance)).mean(axis=0) > MIN_REPORTED_FRACTION
    if not is_used.any():
        return None
    quietest = np.nanquantile(variance[:, is_used], 0.2, axis=0)
    is_calm = (variance[:, is_used] <= MAX_CALM_RATIO**2 * quietest).all(axis=1)
    width = np.full(3, np.nan)
    width[is_used] = np.maximum(LEVEL_WIDTH * np.sqrt(quietest / np.median(n[:, is_used], axis=0)),
                                np.maximum(core.TOGGLE_TOLERANCE * steps[is_used], MIN_WIDTH))
    calm_rows = np.flatnonzero(is_calm)
    if len(calm_rows) < MIN_BLOCKS:
        return None
    means = blocks.mean[calm_rows][:, is_used]
    densest = _densest(means, width[is_used])
    level_rows = calm_rows[densest]
    if len(level_rows) < MIN_BLOCKS:
        return None
    centre = np.median(means[densest], axis=0)
    other_means = means[(np.abs(means - centre) > MIN_LEVEL_DISTANCE * width[is_used]).any(axis=1)]
    time = blocks.time[level_rows]
    early_rows = level_rows[
        time <= time[0] + (time[-1] - time[0]) * max_blocks / len(level_rows)][:max_blocks]
    early_blocks = Blocks(*(values[early_rows] for values in blocks))
    covariance = pooled_covariance(Blocks(*(values[level_rows] for values in blocks)))
    if covariance is None:
        return None
    _, mean, _ = line_through(early_blocks)
    n_rival = len(_densest(other_means, width[is_used])) if len(other_means) else 0
    return MostFrequentLevel(len(level_rows), n_rival, float(time[0]), float(time[-1]), mean,
                             covariance, float(np.median(np.diff(blocks.time))), width)


def _densest(means: FloatArray, width: FloatArray) -> IntArray:
    """Indices of the `means` (n, k) in the densest box of half-width `width` (k,)."""
    best: BoolArray = np.zeros(len(means), dtype=bool)
    for first in range(0, len(means), BATCH_SIZE):
        is_near: BoolArray = np.ones((len(means[first:first + BATCH_SIZE]), len(means)), dtype=bool)
        for axis, half_width in zip(means.T, width, strict=True):
            is_near &= np.abs(axis[first:first + BATCH_SIZE, None] - axis) <= half_width
        densest = is_near[np.argmax(np.count_nonzero(is_near, axis=1))]
        best = densest if np.count_nonzero(densest) > np.count_nonzero(best) else best
    centre = np.median(means[best], axis=0)
    return np.flatnonzero((np.abs(means - centre) <= width).all(axis=1))


class ProvisionalLevel:
    """Collects the blocks of a sensor and periodically determines their most frequent level."""

    def __init__(self, learn_s: float) -> None:
        self._min_duration_s = WAIT_RATIO * learn_s
        self.clear()

    def clear(self) -> None:
        """Discard all blocks."""
        self._blocks: deque[Block] = deque(maxlen=MAX_BLOCKS)
        self._n_new, self._n_required = 0, MIN_SEARCHED_BLOCKS

    def collect(self, block: Block) -> None:
        """Add the next block."""
        self._blocks.append(block)
        self._n_new += 1

    def frequent_level(self, steps: FloatArray) -> MostFrequentLevel | None:
        """Most frequent level; None if none is frequent enough, or too few blocks are new."""
        blocks = self._blocks
        if self._n_new < self._n_required \
                or blocks[-1].time - blocks[0].time < self._min_duration_s:
            return None
        self._n_new, self._n_required = 0, max(1, int((SEARCH_GROWTH - 1.0) * len(blocks)))
        return most_frequent_level(stacked(blocks), steps, MAX_BLOCKS)

    def std(self, frequent: MostFrequentLevel) -> FloatArray:
        """Uncertainty (3,) T of a frequent level: median distance of all blocks, as a std."""
        distance, is_known = np.full(3, np.nan), ~np.isnan(frequent.level)
        means = np.array([block.mean for block in self._blocks])[:, is_known]
        distance[is_known] = np.nanmedian(np.abs(means - frequent.level[is_known]), axis=0)
        return 1.4826 * distance
