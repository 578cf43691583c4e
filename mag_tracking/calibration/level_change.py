"""Classification of a lasting level change as the arrival or departure of a vehicle.

The field of a vehicle that approaches at constant speed grows with the inverse cube of its
distance: its relative growth accelerates. The change due to a vehicle that starts or stops grows
with the square of time: its relative growth decelerates. The far end of a change (distant vehicle)
therefore lasts longer than the near end (vehicle at the sensor). The test is an addition of this
package.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.blocks import Blocks

MAX_GAP = 2.5
"""Maximum interval between blocks, in median intervals."""
MAX_SMALL_FRACTION = 0.3
"""Maximum magnitude of the evaluated ends of a change, as a fraction of the total magnitude."""
DETECTION_STDS = 3.0
"""Detection limit of a change in standard deviations of the mean of a block, per axis."""
MIN_ASYMMETRY = 0.8
"""Minimum asymmetry of a change for a decision, as a binary logarithm; 0 for equal ends."""
MIN_GROWTH = 3.5
"""Minimum ratio of the largest evaluated magnitude to the detection limit."""
MAX_QUARTER_FRACTION = 0.5
"""Maximum duration of a quarter, less one block, relative to the growth time; longer is a stall.
The theoretical fraction is 0.3 to 0.54 for growth by a factor of 4 to 300."""
MAX_START_RATIO = 0.9
"""Maximum ratio of the first to the second half of the growth time at the near end. The theoretical
ratio is 0.7 to 0.24 at the near end and 1.3 to 2.6 at the far end."""
MIN_BLOCKS = 2.0
"""Minimum duration of the longer end in blocks; a step is neither an arrival nor a departure."""
CLEAR_SIZE = 60.0
"""Minimum magnitude, in std of one reading, of a change that is classified alone."""
MAX_TIME_DIFFERENCE_S = 3.0
"""[s] Maximum time between the starts of the new levels at sensors near the same target."""


def growth_of(time: FloatArray, size: FloatArray, low: float, high: float) -> FloatArray | None:
    """Durations (4,) [s] of the quarters, on a logarithmic scale, of a growth from `low` to `high`.

    If `size` (k,), at increasing times (k,) in s, grows by a factor q with the inverse cube of a
    distance, each quarter takes q**(1/12) times as long as the next; if with the square of time,
    q**(1/8) times as long as the previous one. The growth ends where `size` first exceeds `high`
    and starts where it was last below `low` before. None if it never exceeds `high`, was never
    below `low` before, or has a gap in between.
    """
    times, end, begin = [], int(np.flatnonzero(size > high).min(initial=len(size))), 0
    for level in np.geomspace(low, high, 5):
        i = int(np.flatnonzero(size[:end] <= level).max(initial=-1)) + 1
        if i == 0 or end == len(size):
            return None
        # Interpolate on a logarithmic scale; growth from zero is instantaneous.
        rate = np.log(size[i] / size[i - 1]) if size[i - 1] > 0.0 else np.inf
        times.append(float(time[i] - np.log(size[i] / level) / rate * (time[i] - time[i - 1])))
        begin = begin or i
    if np.diff(time[begin - 1:end + 1]).max() > MAX_GAP * np.median(np.diff(time)):
        return None
    return np.diff(times)


@dataclass(frozen=True)
class LevelChange:
    """A change from one steady level to another."""

    since: float
    """[s] Start of the later level, in the time common to all sensors."""
    size: float
    """Magnitude of the change in standard deviations of one reading."""
    has_departed: bool | None
    """True: a vehicle that caused the earlier level has departed. False: one that causes the later
    level has arrived. None: unknown."""


ChangeEvaluator: TypeAlias = Callable[[LevelChange], bool | None]
"""Function that classifies the `LevelChange` of a sensor like `LevelChange.has_departed`."""


def level_change(blocks: Blocks, n_steady: int, before: FloatArray, noise_std: FloatArray,
                 origin: float) -> LevelChange:
    """Evaluate a change to a steady level from chronological blocks that begin at the old level.

    The last `n_steady` blocks are at the later level. `before` (k, 3) in T is the earlier level at
    the times of the blocks; `noise_std` (3,) in T is that of one reading. NaN marks an unreported
    axis. `origin` in s is the zero of the block times in the time common to all sensors.
    """
    after = np.average(blocks.mean[-n_steady:], axis=0)
    distance_before, distance_after = (
        _magnitude((blocks.mean - level) / noise_std) for level in (before, after))
    size = float(_magnitude((after - before[-1]) / noise_std))
    n_axes, n_readings = np.count_nonzero(~np.isnan(after)), np.median(blocks.n[blocks.n > 0.0])
    detection_limit = DETECTION_STDS * float(np.sqrt(n_axes / n_readings))
    end = int(np.flatnonzero(distance_after > detection_limit).max(initial=-1)) + 1
    since = origin + float(blocks.time[min(end, len(blocks.time) - 1)])
    # If the latest blocks still approach the level, the change is not complete.
    is_complete = not (distance_after[-n_steady:] > detection_limit).any()
    asymmetry = _asymmetry(blocks.time, distance_before, distance_after, detection_limit,
                           MAX_SMALL_FRACTION * size) if is_complete else 0.0
    return LevelChange(since, size, None if abs(asymmetry) < MIN_ASYMMETRY else asymmetry > 0.0)


def _magnitude(difference: FloatArray) -> FloatArray:
    """Euclidean norms (...) of differences (..., 3) over the reported axes."""
    size: FloatArray = np.sqrt(np.nansum(np.square(difference), axis=-1))
    return size


def _asymmetry(time: FloatArray, distance_before: FloatArray, distance_after: FloatArray,
               detection_limit: float, largest: float) -> float:
    """Binary logarithm of the asymmetry between the ends of a change; positive for a departure.

    Zero if the growth stalls at one end, or neither end matches a starting or stopping vehicle. The
    distances (k,) from the two levels are in std of a reading; the ends are evaluated from
    `detection_limit` to `largest`.
    """
    block_length = float(np.median(np.diff(time)))
    first = growth_of(time, distance_before, detection_limit, largest)
    last = growth_of(-time[::-1], distance_after[::-1], detection_limit, largest)
    if largest < MIN_GROWTH * detection_limit or first is None or last is None:
        return 0.0
    quarters = np.array([first, last])
    halves = quarters.reshape(2, 2, 2).sum(axis=2)
    durations = halves.sum(axis=1)
    if durations.max() < MIN_BLOCKS * block_length or (
            quarters.max(axis=1) > MAX_QUARTER_FRACTION * durations + block_length).any():
        return 0.0
    # The position of an end within a block is unknown.
    duration_ratio = np.divide(*(durations[::-1] + 0.5 * block_length))
    rise, fall = np.divide(*(halves.T + 0.25 * block_length))
    starts_slowly = (rise if duration_ratio > 1.0 else fall) < MAX_START_RATIO
    return float(np.log2(duration_ratio * fall / rise)) if starts_slowly else 0.0


NO_CHANGE = LevelChange(np.nan, 0.0, None)
"""`LevelChange` of a sensor whose level does not change."""


class SharedChanges:
    """Latest `LevelChange` of each sensor of a network, for a joint classification."""

    def __init__(self) -> None:
        self._latest_changes: dict[int, LevelChange] = {}

    def evaluate_change(self, sensor: int, change: LevelChange) -> bool | None:
        """Store a sensor's change; return whether a vehicle has departed (None: unknown), for a
        change that is not clear from the largest simultaneous change."""
        self._latest_changes[sensor] = change
        if change.size >= CLEAR_SIZE and change.has_departed is not None:
            return change.has_departed
        candidates = [other for other in self._latest_changes.values()
                      if other.has_departed is not None
                      and abs(other.since - change.since) < MAX_TIME_DIFFERENCE_S]
        return max(candidates, key=lambda other: other.size).has_departed if candidates else None
