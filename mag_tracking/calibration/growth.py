"""Growth rate of a field change, which distinguishes approaching from starting targets.

The field of a vehicle that approaches at constant speed grows with the inverse cube of its
distance: its relative growth accelerates. The change due to a vehicle that starts or stops grows
with the square of time: its relative growth decelerates. The test is an addition of this package.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mag_tracking.arrays import FloatArray

MAX_GAP = 2.5
"""Maximum interval between blocks, in median intervals; across a longer gap the growth is
unknown."""


@dataclass(frozen=True)
class Growth:
    """Durations of the four quarters in which the magnitude of a change grows by a factor q.

    If it grows with the inverse cube of a distance, each quarter takes q**(1/12) times as long as
    the next; if with the square of time, q**(1/8) times as long as the previous one.
    """

    quarters: tuple[float, ...]
    """(4,) [s] Duration of each quarter of the growth, on a logarithmic scale of the magnitude."""

    @property
    def early(self) -> float:
        """Duration of the first two quarters [s]."""
        return self.quarters[0] + self.quarters[1]

    @property
    def late(self) -> float:
        """Duration of the last two quarters [s]."""
        return self.quarters[2] + self.quarters[3]

    @property
    def duration(self) -> float:
        """Total duration [s]."""
        return self.early + self.late


def growth_of(time: FloatArray, size: FloatArray, low: float, high: float) -> Growth | None:
    """Measure the growth of `size` (k,) at increasing times (k,) in s, between `low` and `high`.

    It ends where `size` first exceeds `high` and starts where it was last below `low` before. None
    if it never exceeds `high`, was never below `low` before, or has a gap in between.
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
    return Growth(tuple(b - a for a, b in pairwise(times)))
