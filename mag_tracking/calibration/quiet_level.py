"""Background of a sensor by its most frequent level, for recordings without a quiet beginning."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.background import RunningBackground, pooled_covariance
from mag_tracking.calibration.blocks import Block, Blocks, block_of, line_through, stacked
from mag_tracking.calibration.resolution import TOGGLE, corrected_steps, raw_steps

CALM = 3.0
"""A block is calm where its standard deviation is at most this many times that of the quietest
fifth of the blocks: while a target moves by, the field changes within a block."""

WIDTH = 4.0
"""Blocks are of one level where their means differ by at most this many of their standard
deviations on each axis."""

LEAST_WIDTH = 5e-9
"""[T] Drift makes them differ, too."""

LEAST_BLOCKS = 4
"""Fewer blocks of one level are no background."""

MORE = 4.0
"""The level of the beginning is replaced by one that lasts longer by this factor: what stood there
at first has left."""

NEAR = 8.0
MORE_NEAR = 1.5
"""A level that differs by less than so many standard deviations of a reading may be that of the
beginning with a target that came near: there this factor is enough."""

DRIFT = 3e-9
"""[T/s] of a background."""

FOLLOWING = 0.3
"""A level that drifts is that of the latest blocks, each with this share."""

MOST_BLOCKS = 4000
"""In a longer recording, an even selection of blocks is compared."""


@dataclass(frozen=True)
class QuietLevel:
    """The most frequent level of a sensor."""

    n_blocks: int
    """Blocks of that level."""
    begin: float
    """[s] of the first of them."""
    end: float
    """[s] of the last of them."""
    level: FloatArray
    """(3,) [T] in its earliest stretch; NaN = axis not reported."""
    covariance: FloatArray
    """(3, 3) [T^2] scatter of its readings; NaN = axis not reported."""
    block_s: float
    """[s] Usual length of a block."""
    width: FloatArray
    """(3,) [T] Blocks whose means differ by less are of one level."""


class BlockRecorder(RunningBackground):
    """Collects the blocks of a sensor and is never ready: the first pass over a recording."""

    def judge_block(self) -> None:
        """Keep the block that is complete."""
        if self._state['is_full']:
            self._blocks.append(block_of(self._state))
            self._state['is_full'] = False

    def forget(self) -> None:
        """Drop all blocks."""
        self._blocks: list[Block] = []
        super().forget()

    def quiet_level(self) -> QuietLevel | None:
        """The most frequent level of the sensor, or None where it has none."""
        if len(self._blocks) < LEAST_BLOCKS:
            return None
        every = 1 + len(self._blocks) // MOST_BLOCKS
        steps = corrected_steps(self._sensors)
        return most_frequent_level(stacked(self._blocks[::every]),
                                   np.where(np.isfinite(steps), steps, 0.0), self._most)

    def is_usual(self, beginning: FloatArray, found: QuietLevel) -> bool:
        """Whether the level of the beginning, (3,) [T], is that of the background.

        So it is where the field drifts from there to the most frequent level, or has that other
        level for hardly longer.
        """
        level, since, n = beginning, 0.0, 0
        for block in self._blocks:
            width = found.width + DRIFT * (block.time - since)
            # A comparison with NaN is false: an axis that is not reported differs from nothing.
            if (np.abs(block.mean - level) > width).any():
                continue
            level = level + FOLLOWING * np.where(np.isnan(level), 0.0, block.mean - level)
            since, n = block.time, n + 1
            if found.begin <= block.time <= found.end \
                    and not (np.abs(level - found.level) > found.width).any():
                return True
        # A target that comes near slowly moves the level by little; one that stands there, by more.
        noise = np.sqrt(found.covariance.diagonal() + (found.width / WIDTH)**2)
        is_near = not (np.abs(beginning - found.level) > NEAR * noise).any()
        return (MORE_NEAR if is_near else MORE) * n > found.n_blocks

    @property
    def steps(self) -> FloatArray:
        """(3,) [T] steps of each raw axis; inf where they were not seen."""
        steps = raw_steps(self._sensors)
        return np.where(steps > 0.0, steps, np.inf)


def most_frequent_level(blocks: Blocks, steps: FloatArray, most: int) -> QuietLevel | None:
    """The level that most blocks of a sensor have.

    Parameters
    ----------
    blocks : Blocks
        In order of time.
    steps : (3,) array, T
        Smallest change of each axis; 0 = unknown.
    most : int
        The level is that of at most so many blocks, the earliest ones.

    Returns
    -------
    QuietLevel or None
        None where fewer than `LEAST_BLOCKS` have one level.
    """
    n = np.maximum(blocks.n, 1.0)
    variance = np.einsum('kii->ki', blocks.scatter) / np.maximum(n - 1.0, 1.0)
    variance = np.where(blocks.n > 1, np.maximum(variance, steps**2 / 12.0), np.nan)
    if np.isnan(variance).all():
        return None
    known = ~np.isnan(variance).all(axis=0)
    quietest = np.nanquantile(variance[:, known], 0.2, axis=0)
    calm = (variance[:, known] <= CALM**2 * quietest).all(axis=1)
    width = np.full(3, np.nan)
    width[known] = np.maximum(WIDTH * np.sqrt(quietest / np.median(n[:, known], axis=0)),
                              np.maximum(TOGGLE * steps[known], LEAST_WIDTH))
    rows = np.flatnonzero(calm)
    if len(rows) < LEAST_BLOCKS:
        return None
    chosen = rows[_densest(blocks.mean[rows][:, known], width[known])]
    if len(chosen) < LEAST_BLOCKS:
        return None
    time = blocks.time[chosen]
    first = chosen[time <= time[0] + (time[-1] - time[0]) * most / len(chosen)][:most]
    early = Blocks(*(values[first] for values in blocks))
    covariance = pooled_covariance(Blocks(*(values[chosen] for values in blocks)))
    if covariance is None:
        return None
    _, mean, _ = line_through(early)
    return QuietLevel(len(chosen), float(time[0]), float(time[-1]), mean, covariance,
                      float(np.median(np.diff(blocks.time))), width)


def _densest(means: FloatArray, width: FloatArray) -> IntArray:
    """Rows of (n, k) `means` that are within `width` (k,) of the one with the most such rows."""
    best: BoolArray = np.zeros(len(means), dtype=bool)
    for mean in means:
        near = (np.abs(means - mean) <= width).all(axis=1)
        if near.sum() > best.sum():
            best = near
    centre = np.median(means[best], axis=0)
    return np.flatnonzero((np.abs(means - centre) <= width).all(axis=1))
