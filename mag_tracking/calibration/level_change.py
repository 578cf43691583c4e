"""Whether what has changed the field for good has come or left, by the arrow of time.

A vehicle comes from afar, where its field grows with the cube of its distance, and stops as slowly
as it brakes. One that stood there starts slowly, and its field fades with the cube of its distance.
So a change is small for longer at its far end than at its near one; and where it is small it grows
at the far end ever faster, at the near one ever more slowly. The test is this package's own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Blocks
from mag_tracking.calibration.growth import time_to_grow

SMALL = 0.3
"""A change is small at its beginning, and at its end, up to this share of its size."""

FELT = 3.0
"""Standard deviations of the mean of a block, on each axis: so much is felt of a change."""

DECIDED = 0.8
"""Of both ratios together, as a binary logarithm. 2 to 3 is usual, 0 where both ends are alike;
vehicles that start or brake with 1 to 4 m/s^2 were never beyond 0 on the wrong side."""

LEAST_GROWTH = 3.5
"""Both ends can be seen of a change that is small up to so many times what is felt."""

LEAST_BLOCKS = 2.0
"""The far end takes so many blocks at least: what jumps neither comes nor leaves."""

CLEAR_SIZE = 60.0
"""In standard deviations of one reading: a change of this size is judged alone, a smaller one also
by a larger one elsewhere."""

TOGETHER_S = 3.0
"""[s] Sensors whose new levels begin within this time are changed by the same thing."""


@dataclass(frozen=True)
class LevelChange:
    """A change from one steady level to another."""

    since: float
    """[s] When the later level began."""
    size: float
    """Of the change, in standard deviations of one reading."""
    has_left: bool | None
    """Whether what made the earlier level has left; False: what makes the later one has come;
    None: it cannot be told."""


Judge: TypeAlias = Callable[[LevelChange], bool | None]
"""Whether what changed a sensor has left or come, from its `LevelChange`."""


def level_change(blocks: Blocks, n_steady: int, before: FloatArray, noise_std: FloatArray,
                 origin: float) -> LevelChange:
    """Judge a change to a steady level.

    Parameters
    ----------
    blocks : Blocks
        From the earlier level on, in their order.
    n_steady : int
        So many of the last ones are of the later level.
    before : (k, 3) array, T
        Earlier level at their times; NaN = axis not reported.
    noise_std : (3,) array, T
        Of one reading.
    origin : float [s]
        Of the times of the blocks, on the clock of all sensors.
    """
    after = np.average(blocks.mean[-n_steady:], axis=0)
    off_before, off_after = (_size((blocks.mean - level) / noise_std) for level in (before, after))
    size = float(_size((after - before[-1]) / noise_std))
    felt = FELT * float(np.sqrt(np.count_nonzero(~np.isnan(after)) / np.nanmedian(blocks.n)))
    end = int(np.flatnonzero(off_after > felt).max(initial=-1)) + 1
    since = origin + float(blocks.time[min(end, len(blocks.time) - 1)])
    arrow = _arrow(off_before, off_after[::-1], felt, SMALL * size) or 0.0
    # While the latest blocks are on their way to a level, its end seems shorter than it is.
    is_there = not (off_after[-n_steady:] > felt).any()
    return LevelChange(since, size, True if arrow > DECIDED
                       else False if arrow < -DECIDED and is_there else None)


def _size(off: FloatArray) -> FloatArray:
    """Norm over the axes that are reported."""
    size: FloatArray = np.sqrt(np.nansum(np.square(off), axis=-1))
    return size


def _arrow(first: FloatArray, last: FloatArray, felt: float, small: float) -> float | None:
    """How much more the far end is the last one: binary logarithm of both ratios.

    `first` and `last` are the sizes of a change, block by block from either end.
    """
    if small < LEAST_GROWTH * felt:
        return None
    grows, fades = (time_to_grow(size, felt, small) for size in (first, last))
    if grows is None or fades is None or max(sum(grows), sum(fades)) < LEAST_BLOCKS:
        return None
    longer = (sum(fades) + 0.5) / (sum(grows) + 0.5)
    faster = (fades[0] + 0.25) / (fades[1] + 0.25) * (grows[1] + 0.25) / (grows[0] + 0.25)
    return float(np.log2(longer * faster))


class SharedChanges:
    """The latest `LevelChange` of each sensor of a network."""

    def __init__(self) -> None:
        self._latest: dict[int, LevelChange] = {}

    def judge(self, sensor: int, change: LevelChange) -> bool | None:
        """Whether what changed a `sensor` has left or come, by this change and those of others.

        A change that is not clear is judged by the largest one at the same time.
        """
        self._latest[sensor] = change
        if change.size >= CLEAR_SIZE and change.has_left is not None:
            return change.has_left
        together = [other for other in self._latest.values() if other.has_left is not None
                    and abs(other.since - change.since) < TOGETHER_S]
        return max(together, key=lambda other: other.size).has_left if together else None
