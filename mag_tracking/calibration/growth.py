"""How fast a field grows: of what comes from afar, and of what starts beside a sensor.

The field of a vehicle that comes nearer evenly grows with the cube of its distance: ever faster.
That of one which starts, or comes to rest, is off its level by its way, the square of the time:
ever more slowly. The test is this package's own.
"""

from itertools import pairwise

import numpy as np

from mag_tracking.arrays import FloatArray


def time_to_grow(size: FloatArray, least: float, most: float) -> tuple[float, float] | None:
    """How long a change takes to grow to the geometric mean of two sizes, and from there on.

    Parameters
    ----------
    size : (k,) array
        Of the change, at even times.
    least, most : float
        It is timed to where it first exceeds `most`, from where it last was below `least` before.

    Returns
    -------
    (float, float) or None
        In intervals, between the times; None where `size` never exceeds `most`, or was never below
        `least` before. For a ratio q of the sizes the second is to the first as 1 to q**(1/6) where
        the size grows with the cube of a distance, and as q**(1/4) to 1 with the square of a time.
    """
    times, end = [], int(np.flatnonzero(size > most).min(initial=len(size)))
    for level in (least, np.sqrt(least * most), most):
        i = int(np.flatnonzero(size[:end] <= level).max(initial=-1)) + 1
        if i == 0 or end == len(size):
            return None
        # Between the two it grows by a power; from nothing, at once.
        growth = np.log(size[i] / size[i - 1]) if size[i - 1] > 0.0 else np.inf
        times.append(i - float(np.log(size[i] / level) / growth))
    early, late = (b - a for a, b in pairwise(times))
    return early, late
