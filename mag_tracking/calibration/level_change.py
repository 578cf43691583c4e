"""Whether a vehicle has come or left where the field has changed for good, by the arrow of time.

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
from mag_tracking.calibration.growth import growth_of

SMALL = 0.3
"""A change is small at its beginning, and at its end, up to this share of its size."""

FELT = 3.0
"""Standard deviations of the mean of a block, on each axis: so much is felt of a change."""

DECIDED = 0.8
"""Binary logarithm of both ratios together from which on it is decided: it is 0 where both ends are
alike."""

MIN_GROWTH = 3.5
"""Both ends can be seen of a change that is small up to so many times what is felt."""

STALLS = 0.5
"""The growth stalls where one quarter of it takes this share of its time, and a block, at least. By
theory 0.3 to 0.54, where the size grows to 4 to 300 times as much, half of it within few blocks."""

SLOW_START = 0.9
"""At the near end the first half of the growth takes less than this share of the second one. By
theory 0.7 to 0.24, at the far end 1.3 to 2.6."""

MIN_BLOCKS = 2.0
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
    """Size of the change, in standard deviations of one reading."""
    has_departed: bool | None
    """Whether a vehicle that made the earlier level has left; False: one that makes the later level
    has come; None: unknown."""


ChangeEvaluator: TypeAlias = Callable[[LevelChange], bool | None]
"""Takes the `LevelChange` of a sensor; whether a vehicle has left, as `has_departed` there."""


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
    n_axes, n_readings = np.count_nonzero(~np.isnan(after)), np.median(blocks.n[blocks.n > 0.0])
    felt = FELT * float(np.sqrt(n_axes / n_readings))
    end = int(np.flatnonzero(off_after > felt).max(initial=-1)) + 1
    since = origin + float(blocks.time[min(end, len(blocks.time) - 1)])
    # While the latest blocks are on their way to a level, its end seems shorter than it is.
    is_there = not (off_after[-n_steady:] > felt).any()
    arrow = _arrow(blocks.time, off_before, off_after, felt, SMALL * size) if is_there else 0.0
    return LevelChange(since, size, None if abs(arrow) < DECIDED else arrow > 0.0)


def _size(off: FloatArray) -> FloatArray:
    """Norm over the axes that are reported."""
    size: FloatArray = np.sqrt(np.nansum(np.square(off), axis=-1))
    return size


def _arrow(time: FloatArray, off_before: FloatArray, off_after: FloatArray, felt: float,
           small: float) -> float:
    """Binary logarithm by which the change is small for longer, and grows faster, at its last end.

    It is 0 where the growth at one end stalls, as it does when a second vehicle comes up to a first
    one, and where neither end is that of a vehicle that starts or stops.

    Parameters
    ----------
    time : (k,) array, s
    off_before, off_after : (k,) array
        Sizes of what is off either level, in deviations of one reading.
    felt, small : float
        From which size on an end is looked at, and up to which.
    """
    length = float(np.median(np.diff(time)))
    first = growth_of(time, off_before, felt, small)
    last = growth_of(-time[::-1], off_after[::-1], felt, small)
    if small < MIN_GROWTH * felt or first is None or last is None \
            or max(first.whole, last.whole) < MIN_BLOCKS * length \
            or any(max(end.quarters) > STALLS * end.whole + length for end in (first, last)):
        return 0.0
    # It is not known where within a block an end is.
    longer = (last.whole + 0.5 * length) / (first.whole + 0.5 * length)
    rise, fall = ((end.early + 0.25 * length) / (end.late + 0.25 * length)
                  for end in (first, last))
    starts_slowly = (rise if longer > 1.0 else fall) < SLOW_START
    return float(np.log2(longer * fall / rise)) if starts_slowly else 0.0


NO_CHANGE = LevelChange(np.nan, 0.0, None)
"""Takes the place of an earlier change that is over."""


class SharedChanges:
    """The latest `LevelChange` of each sensor of a network."""

    def __init__(self) -> None:
        self._latest: dict[int, LevelChange] = {}

    def evaluate_change(self, sensor: int, change: LevelChange) -> bool | None:
        """Whether a vehicle has left a `sensor`, by this change and those of the others.

        A change that is not clear is judged by the largest one at the same time.
        """
        self._latest[sensor] = change
        if change.size >= CLEAR_SIZE and change.has_departed is not None:
            return change.has_departed
        together = [other for other in self._latest.values() if other.has_departed is not None
                    and abs(other.since - change.since) < TOGETHER_S]
        return max(together, key=lambda other: other.size).has_departed if together else None
