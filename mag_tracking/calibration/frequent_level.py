"""Most frequent level of a sensor, which serves as its background if targets are often nearby."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.blocks import Blocks, line_through, pooled_covariance
from mag_tracking.calibration.resolution import TOGGLE_TOLERANCE

MAX_CALM_RATIO = 3.0
"""Maximum standard deviation within a block, relative to the 20 % quantile of all blocks. Blocks
above this limit are excluded, because a passing target changes the field within a block."""

LEVEL_WIDTH = 4.0
"""Maximum difference between the mean of a block and its level, in standard deviations of a mean,
per axis."""

MIN_WIDTH = 5e-9
"""[T] Minimum tolerance of a level, which allows for drift."""

MIN_REPORTED_FRACTION = 0.5
"""An axis is evaluated if more than this fraction of the blocks contain it."""

MIN_BLOCKS = 4
"""Minimum number of blocks of a level."""

MIN_LEVEL_DISTANCE = 3.0
"""Minimum distance of another level, in widths. A distant target may change a level by less."""

MIN_DURATION_RATIO = 4.0
"""Minimum duration of a level that replaces the initial level, relative to the duration of the
initial level. Such a level indicates that a target present at the start has left."""

BATCH_SIZE = 64
"""Number of blocks that are compared with all other blocks in one operation, to limit memory."""


@dataclass(frozen=True)
class MostFrequentLevel:
    """The most frequent level of a sensor."""

    n_blocks: int
    """Number of blocks at the level."""
    n_rival: int
    """Number of blocks at the second most frequent level."""
    begin: float
    """[s] Time of the first block at the level."""
    end: float
    """[s] Time of the last block at the level."""
    level: FloatArray
    """(3,) [T] Mean of the earliest blocks at the level; NaN for an unreported axis."""
    covariance: FloatArray
    """(3, 3) [T²] Covariance of the readings within blocks; NaN for an unreported axis."""
    block_s: float
    """[s] Typical length of a block."""
    width: FloatArray
    """(3,) [T] Maximum difference between the mean of a block and the level."""

    def is_at(self, level: FloatArray) -> bool:
        """Whether a level (3,) T is the same within `MIN_LEVEL_DISTANCE` widths."""
        return not bool((np.abs(self.level - level) > MIN_LEVEL_DISTANCE * self.width).any())


def most_frequent_level(blocks: Blocks, steps: FloatArray, max_blocks: int
                        ) -> MostFrequentLevel | None:
    """Find the most frequent level of chronological blocks, from the earliest `max_blocks` at it.

    `steps` (3,) in T are the quantisation steps, 0 if unknown. None if no level has `MIN_BLOCKS`
    blocks, or the noise is unknown on all axes.
    """
    n = np.maximum(blocks.n, 1.0)
    variance = np.einsum('kii->ki', blocks.scatter) / np.maximum(n - 1.0, 1.0)
    variance = np.where(blocks.n > 1, np.maximum(variance, steps**2 / 12.0), np.nan)
    if np.isnan(variance).all():
        return None
    # An axis that is rarely reported would exclude the blocks without it.
    is_used = (~np.isnan(variance)).mean(axis=0) > MIN_REPORTED_FRACTION
    if not is_used.any():
        return None
    quietest = np.nanquantile(variance[:, is_used], 0.2, axis=0)
    is_calm = (variance[:, is_used] <= MAX_CALM_RATIO**2 * quietest).all(axis=1)
    width = np.full(3, np.nan)
    width[is_used] = np.maximum(LEVEL_WIDTH * np.sqrt(quietest / np.median(n[:, is_used], axis=0)),
                                np.maximum(TOGGLE_TOLERANCE * steps[is_used], MIN_WIDTH))
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
