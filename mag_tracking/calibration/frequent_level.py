"""The most frequent level of a sensor: its background, where targets are often near."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.blocks import Blocks, line_through, pooled_covariance
from mag_tracking.calibration.resolution import TOGGLE

CALM = 3.0
"""A block is calm where its standard deviation is at most this many times that of the quietest
fifth of the blocks: while a target moves by, the field changes within a block."""

WIDTH = 4.0
"""Blocks are of one level where their means differ by at most this many of their standard
deviations on each axis."""

MIN_WIDTH = 5e-9
"""[T] Drift makes them differ, too."""

REPORTED = 0.5
"""An axis counts where it is reported in more than this share of the blocks."""

MIN_BLOCKS = 4
"""Fewer blocks of one level are no background."""

APART = 3.0
"""In widths: what differs by less from a level is no other level, but that with a target far away.
"""

MORE = 4.0
"""The level of the beginning is replaced by one that lasts longer by this factor: what stood there
at first has left."""

AT_ONCE = 64
"""Blocks that are compared with all others at once; with more of them it takes much memory."""


@dataclass(frozen=True)
class QuietLevel:
    """The most frequent level of a sensor."""

    n_blocks: int
    """Blocks of that level."""
    n_rival: int
    """Blocks of the most frequent level among the others."""
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

    def is_at(self, level: FloatArray) -> bool:
        """Whether another level, (3,) [T], is about this one."""
        return not bool((np.abs(self.level - level) > APART * self.width).any())


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
        None where fewer than `MIN_BLOCKS` have one level.
    """
    n = np.maximum(blocks.n, 1.0)
    variance = np.einsum('kii->ki', blocks.scatter) / np.maximum(n - 1.0, 1.0)
    variance = np.where(blocks.n > 1, np.maximum(variance, steps**2 / 12.0), np.nan)
    if np.isnan(variance).all():
        return None
    # An axis that hardly ever reports would rule out the blocks without it.
    known = (~np.isnan(variance)).mean(axis=0) > REPORTED
    if not known.any():
        return None
    quietest = np.nanquantile(variance[:, known], 0.2, axis=0)
    calm = (variance[:, known] <= CALM**2 * quietest).all(axis=1)
    width = np.full(3, np.nan)
    width[known] = np.maximum(WIDTH * np.sqrt(quietest / np.median(n[:, known], axis=0)),
                              np.maximum(TOGGLE * steps[known], MIN_WIDTH))
    rows = np.flatnonzero(calm)
    if len(rows) < MIN_BLOCKS:
        return None
    means = blocks.mean[rows][:, known]
    densest = _densest(means, width[known])
    chosen = rows[densest]
    if len(chosen) < MIN_BLOCKS:
        return None
    centre = np.median(means[densest], axis=0)
    others = means[(np.abs(means - centre) > APART * width[known]).any(axis=1)]
    time = blocks.time[chosen]
    first = chosen[time <= time[0] + (time[-1] - time[0]) * most / len(chosen)][:most]
    early = Blocks(*(values[first] for values in blocks))
    covariance = pooled_covariance(Blocks(*(values[chosen] for values in blocks)))
    if covariance is None:
        return None
    _, mean, _ = line_through(early)
    n_rival = len(_densest(others, width[known])) if len(others) else 0
    return QuietLevel(len(chosen), n_rival, float(time[0]), float(time[-1]), mean, covariance,
                      float(np.median(np.diff(blocks.time))), width)


def _densest(means: FloatArray, width: FloatArray) -> IntArray:
    """Rows of (n, k) `means` that are within `width` (k,) of the one with the most such rows."""
    best: BoolArray = np.zeros(len(means), dtype=bool)
    for first in range(0, len(means), AT_ONCE):
        near: BoolArray = np.ones((len(means[first:first + AT_ONCE]), len(means)), dtype=bool)
        for axis, widest in zip(means.T, width, strict=True):
            near &= np.abs(axis[first:first + AT_ONCE, None] - axis) <= widest
        most = near[np.argmax(np.count_nonzero(near, axis=1))]
        best = most if np.count_nonzero(most) > np.count_nonzero(best) else best
    centre = np.median(means[best], axis=0)
    return np.flatnonzero((np.abs(means - centre) <= width).all(axis=1))
