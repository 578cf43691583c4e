"""Background of a sensor from its most frequent level, if a recording does not start quietly."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration import core
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.background_level import TYPICAL_DRIFT
from mag_tracking.calibration.blocks import Block, block_of, stacked
from mag_tracking.calibration.frequent_level import (
    LEVEL_WIDTH,
    MIN_BLOCKS,
    MIN_DURATION_RATIO,
    MostFrequentLevel,
    most_frequent_level,
)
from mag_tracking.calibration.sensor_state import corrected_steps

NEAR_STDS = 8.0
"""Maximum change of the initial level by an approaching target, in std of a reading."""
NEAR_DURATION_RATIO = 1.5
"""Value that replaces `MIN_DURATION_RATIO` for levels that differ by at most `NEAR_STDS`."""
LEVEL_WEIGHT = 0.3
"""Weight of the latest block in the exponential average of a drifting level."""
MAX_BLOCKS = 4000
"""Maximum number of blocks to compare; in a longer recording, an even selection is used."""


class BlockRecorder(RunningBackground):
    """Estimator that collects blocks but estimates no background, for a prescan of a recording."""

    def evaluate_block(self) -> None:
        """Store the latest complete block, unless it has been stored already."""
        if self._state['is_full']:
            self._blocks.append(block_of(self._sensors))
            self._state['is_full'] = False

    def forget(self) -> None:
        """Discard all blocks."""
        self._blocks: list[Block] = []
        super().forget()

    def quiet_level(self, since: float = 0.0) -> MostFrequentLevel | None:
        """Most frequent level from `since` s on; None if unknown."""
        blocks = [block for block in self._blocks if block.time >= since]
        if len(blocks) < MIN_BLOCKS:
            return None
        return most_frequent_level(stacked(blocks[::1 + len(blocks) // MAX_BLOCKS]),
                                   corrected_steps(self._sensors), self._max_blocks)

    def is_known_level(self, initial: FloatArray, found: MostFrequentLevel) -> bool:
        """Whether the field drifts from the initial level (3,) T of a recording to the most
        frequent level, or is there for not much longer."""
        level, previous_time, n = initial, 0.0, 0
        for block in self._blocks:
            width = found.width + TYPICAL_DRIFT * (block.time - previous_time)
            # A comparison with NaN is false: an axis that is not reported does not differ.
            if (np.abs(block.mean - level) > width).any():
                continue
            level = level + LEVEL_WEIGHT * np.where(np.isnan(level), 0.0, block.mean - level)
            previous_time, n = block.time, n + 1
            if found.begin <= block.time <= found.end \
                    and not (np.abs(level - found.level) > found.width).any():
                return True
        # An approaching target changes the level slightly; a stationary target changes it more.
        noise_std = np.sqrt(found.covariance.diagonal() + (found.width / LEVEL_WIDTH)**2)
        is_near = not (np.abs(initial - found.level) > NEAR_STDS * noise_std).any()
        return (NEAR_DURATION_RATIO if is_near else MIN_DURATION_RATIO) * n > found.n_blocks

    def has_returned(self, initial: FloatArray, found: MostFrequentLevel, since: float) -> bool:
        """Whether `MIN_BLOCKS` blocks from `since` s on are at `initial`, within `found.width`."""
        is_different = [np.abs(b.mean - initial) > found.width
                        for b in self._blocks if b.time >= since]
        return sum(not o.any() for o in is_different) >= MIN_BLOCKS

    @property
    def steps(self) -> FloatArray:
        """Quantisation steps of the raw axes, (3,) T; inf if unknown."""
        steps = core.steps_of(self._sensors, False)
        return np.where(steps > 0.0, steps, np.inf)
