"""How a background drifts, and what drifts faster."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Block, Blocks

DRIFT = 3e-9
"""[T/s] Usual drift of a background."""

STEEP = 1e-8
"""[T/s] A sensor that is warming drifts so. What drifts faster may be a target that comes near."""

FORGOTTEN_S = 600.0
"""[s] A level that was the background so long ago is no longer remembered."""

MAX_DRIFT = 4.0
"""By at most so many of the limits of a block such a level may have drifted meanwhile: with a wider
tolerance any vehicle that halts would seem to be it."""

SIGNIFICANT = 4.0
"""Standard deviations by which a drift is faster."""


@dataclass(frozen=True)
class FormerLevel:
    """The level that was the background before the present one."""

    until: float
    """[s]"""
    level: FloatArray
    """(3,) [T]"""
    seen_s: float
    """[s] For how long it was seen."""

    def is_at(self, block: Block, limits: FloatArray) -> bool:
        """Whether a block has this level, with `limits` (3,) [T] for its mean."""
        since = block.time - self.until
        tolerance = limits + np.minimum(DRIFT * since, MAX_DRIFT * limits)
        # A comparison with NaN is false: an axis that is not reported differs from nothing.
        is_off = bool((np.abs(block.mean - self.level) > tolerance).any())
        return since <= FORGOTTEN_S and not is_off


def is_steep(blocks: Blocks, slope: FloatArray, variance: FloatArray) -> bool:
    """Whether a line through blocks is steeper than a background drifts, on any axis.

    Parameters
    ----------
    blocks : Blocks
    slope, variance : (3,) array, T/s and T^2
        Of the line, and of one reading; NaN = axis not reported.
    """
    since = blocks.time - blocks.time.mean()
    spread = (blocks.n * np.square(since)[:, None]).sum(axis=0)
    std = np.sqrt(variance / np.where(spread > 0.0, spread, np.nan))
    # A comparison with NaN is false: an axis that is not reported has no slope.
    return bool((np.abs(slope) > STEEP + SIGNIFICANT * std).any())
