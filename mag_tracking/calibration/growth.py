"""How fast a field grows: of what comes from afar, and of what starts beside a sensor.

The field of a vehicle that comes nearer evenly grows with the cube of its distance: ever faster.
That of one which starts, or comes to rest, is off its level by its way, the square of the time:
ever more slowly. The test is this package's own.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mag_tracking.arrays import FloatArray

MAX_GAP = 2.5
"""Where more than so many usual intervals are missing, the growth between them is not known."""


@dataclass(frozen=True)
class Growth:
    """How long a change takes to grow from one size to another.

    For a ratio q of the two sizes each quarter takes q**(1/12) times as long as the next one where
    the size grows with the cube of a distance, and the next one q**(1/8) times as long as it where
    the size grows with the square of the time.
    """

    quarters: tuple[float, ...]
    """(4,) [s] For each quarter of the growth, in the logarithm of the size."""

    @property
    def early(self) -> float:
        """[s] For the first two quarters."""
        return self.quarters[0] + self.quarters[1]

    @property
    def late(self) -> float:
        """[s] For the last two quarters."""
        return self.quarters[2] + self.quarters[3]

    @property
    def whole(self) -> float:
        """[s] For all of them."""
        return self.early + self.late


def growth_of(time: FloatArray, size: FloatArray, least: float, most: float) -> Growth | None:
    """How long a change takes to grow from a size to another.

    Parameters
    ----------
    time : (k,) array, s
        Rising.
    size : (k,) array
        Of the change, at those times.
    least, most : float
        It is timed to where it first exceeds `most`, from where it last was below `least` before.

    Returns
    -------
    Growth or None
        None where `size` never exceeds `most`, was never below `least` before, or is missing in
        between.
    """
    times, end, begin = [], int(np.flatnonzero(size > most).min(initial=len(size))), 0
    for level in np.geomspace(least, most, 5):
        i = int(np.flatnonzero(size[:end] <= level).max(initial=-1)) + 1
        if i == 0 or end == len(size):
            return None
        # Between the two it grows by a power; from nothing, at once.
        rate = np.log(size[i] / size[i - 1]) if size[i - 1] > 0.0 else np.inf
        times.append(float(time[i] - np.log(size[i] / level) / rate * (time[i] - time[i - 1])))
        begin = begin or i
    if np.diff(time[begin - 1:end + 1]).max() > MAX_GAP * np.median(np.diff(time)):
        return None
    return Growth(tuple(b - a for a, b in pairwise(times)))
