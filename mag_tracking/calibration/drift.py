"""Drift of a background, and detection of faster changes."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Block, Blocks

TYPICAL_DRIFT = 3e-9
"""[T/s] Typical drift of a background."""

STEEP_DRIFT = 1e-8
"""[T/s] Maximum drift of a background, reached by a sensor that is warming up. A faster change may
be due to an approaching target."""

MAX_AGE_S = 600.0
"""[s] Maximum age of a former level."""

MAX_DRIFT = 4.0
"""Maximum drift of a former level, in multiples of the tolerance of a block mean. With a wider
tolerance, any stopped vehicle would match a former level."""

MIN_SLOPE_STDS = 4.0
"""Number of standard deviations by which a slope must exceed `STEEP_DRIFT`."""


@dataclass(frozen=True)
class FormerLevel:
    """Level of the previous background."""

    until: float
    """[s] Time at which the level ceased to be the background."""
    level: FloatArray
    """(3,) [T] Field of the level."""
    observed_s: float
    """[s] Duration for which the level was observed."""

    def is_at(self, block: Block, limits: FloatArray) -> bool:
        """Whether a block is within `limits` (3,) T of this level and at most `MAX_AGE_S` later."""
        age = block.time - self.until
        tolerance = limits + np.minimum(TYPICAL_DRIFT * age, MAX_DRIFT * limits)
        # A comparison with NaN is false: an axis that is not reported does not differ.
        differs = bool((np.abs(block.mean - self.level) > tolerance).any())
        return age <= MAX_AGE_S and not differs


def is_steep(blocks: Blocks, slope: FloatArray, variance: FloatArray) -> bool:
    """Whether a line's slope (3,) T/s significantly exceeds `STEEP_DRIFT` on any axis.

    `variance` (3,) in T² is that of one reading; NaN for an unreported axis.
    """
    relative_time = blocks.time - blocks.time.mean()
    spread = (blocks.n * np.square(relative_time)[:, None]).sum(axis=0)
    std = np.sqrt(variance / np.where(spread > 0.0, spread, np.nan))
    # A comparison with NaN is false: an axis that is not reported has no slope.
    return bool((np.abs(slope) > STEEP_DRIFT + MIN_SLOPE_STDS * std).any())
