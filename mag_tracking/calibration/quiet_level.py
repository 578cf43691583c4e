"""Background of a sensor by its most frequent level, for recordings without a quiet beginning."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.blocks import Block, block_of, stacked
from mag_tracking.calibration.drift import TYPICAL_DRIFT
from mag_tracking.calibration.frequent_level import (
    MIN_BLOCKS,
    MORE,
    WIDTH,
    QuietLevel,
    most_frequent_level,
)
from mag_tracking.calibration.resolution import corrected_steps, raw_steps

NEAR = 8.0
MORE_NEAR = 1.5
"""A level that differs by less than so many standard deviations of a reading may be that of the
beginning with a target that came near: there this factor is enough."""

FOLLOWING = 0.3
"""A level that drifts is that of the latest blocks, each with this share."""

MAX_BLOCKS = 4000
"""In a longer recording, an even selection of blocks is compared."""


class BlockRecorder(RunningBackground):
    """Collects the blocks of a sensor and is never ready: the first pass over a recording."""

    def evaluate_block(self) -> None:
        """Keep the block that is complete."""
        if self._state['is_full']:
            self._blocks.append(block_of(self._sensors))
            self._state['is_full'] = False

    def forget(self) -> None:
        """Drop all blocks."""
        self._blocks: list[Block] = []
        super().forget()

    def quiet_level(self, since: float = 0.0) -> QuietLevel | None:
        """The most frequent level of the sensor `since` a time [s], or None where it has none."""
        blocks = [block for block in self._blocks if block.time >= since]
        if len(blocks) < MIN_BLOCKS:
            return None
        every = 1 + len(blocks) // MAX_BLOCKS
        steps = corrected_steps(self._sensors)
        return most_frequent_level(stacked(blocks[::every]),
                                   np.where(np.isfinite(steps), steps, 0.0), self._max_blocks)

    def is_known_level(self, initial: FloatArray, found: QuietLevel) -> bool:
        """Whether the level of the beginning, (3,) [T], is that of the background.

        So it is where the field drifts from there to the most frequent level, or has that other
        level for hardly longer.
        """
        level, since, n = initial, 0.0, 0
        for block in self._blocks:
            width = found.width + TYPICAL_DRIFT * (block.time - since)
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
        is_near = not (np.abs(initial - found.level) > NEAR * noise).any()
        return (MORE_NEAR if is_near else MORE) * n > found.n_blocks

    def has_returned(self, initial: FloatArray, found: QuietLevel, since: float) -> bool:
        """Whether blocks `since` a time [s] have the level of the beginning, (3,) [T], again, as
        wide as the level that was `found`.
        """
        off = [np.abs(b.mean - initial) > found.width for b in self._blocks if b.time >= since]
        return sum(not o.any() for o in off) >= MIN_BLOCKS

    @property
    def steps(self) -> FloatArray:
        """(3,) [T] steps of each raw axis; inf where they were not seen."""
        steps = raw_steps(self._sensors)
        return np.where(steps > 0.0, steps, np.inf)
