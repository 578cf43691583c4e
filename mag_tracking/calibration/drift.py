"""How a background drifts, and what drifts faster."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Blocks

DRIFT = 3e-9
"""[T/s] Usual drift of a background."""

STEEP = 1e-8
"""[T/s] A sensor that is warming drifts so. What drifts faster may be a target that comes near."""

SIGNIFICANT = 4.0
"""Standard deviations by which a drift is faster."""


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
