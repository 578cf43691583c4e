"""Slopes of the line under a set of points, for the skew of a clock.

Source: Moon, Skelly & Towsley, 'Estimation and removal of clock skew from network
delay measurements', IEEE INFOCOM 1999; `device_clock` says how its use departs from it.
"""

import itertools
import math
from collections.abc import Sequence
from typing import TypeAlias

Point: TypeAlias = tuple[float, float]
"""(x, y)."""


def lower_hull(points: Sequence[Point]) -> list[Point]:
    """Corners of the lower convex hull, from left to right, of a sorted list of (x, y)."""
    hull: list[Point] = []
    for x, y in points:
        while len(hull) > 1:
            (u, v), (w, z) = hull[-2:]
            if (w - u) * (y - v) > (z - v) * (x - u):
                break
            hull.pop()
        hull.append((x, y))
    return hull


def likely_slopes(points: Sequence[Point]) -> tuple[float, float]:
    """Slopes of lines under the points that are about as likely as the best.

    Parameters
    ----------
    points : list of (x, y)
        Sorted, three or more, of more than one x.

    Returns
    -------
    low, high : float
        Equal if all points are on the closest line.

    Source: see the module; closest is Moon et al.'s (the hull's edge over the mean x).
    """
    hull = lower_hull(points)
    middle = sum(x for x, _ in points) / len(points)
    for (u, v), (x, y) in itertools.pairwise(hull):
        if x >= middle:
            slope = (y - v) / (x - u)
            height = v + slope * (middle - u)
            break
    # Two are on the line whatever the delays are; the median, because a stall is no delay.
    above = sorted(y - height - slope * (x - middle) for x, y in points)[2:]
    floor = height - above[len(above) // 2] / math.log(2.0) / len(points)
    low = max((y - floor) / (x - middle) for x, y in hull if x < middle)
    high = min((y - floor) / (x - middle) for x, y in hull if x > middle)
    return min(low, slope), max(high, slope)
