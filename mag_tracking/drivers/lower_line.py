"""Lower convex hull of points, and plausible slopes of the best line under them (clock skew).

Source: Moon, Skelly & Towsley, 'Estimation and removal of clock skew from network delay
measurements', IEEE INFOCOM 1999. `device_clock` lists the differences from this paper.
"""

import itertools
import math
from collections.abc import Sequence
from typing import TypeAlias

Point: TypeAlias = tuple[float, float]
"""Coordinates (x, y) of a point."""


def lower_hull(points: Sequence[Point]) -> list[Point]:
    """Vertices of the lower convex hull; points and vertices ascend in x, then y."""
    hull: list[Point] = []
    for x, y in points:
        while len(hull) > 1:
            (u, v), (w, z) = hull[-2:]
            if (w - u) * (y - v) > (z - v) * (x - u):
                break
            hull.pop()
        hull.append((x, y))
    return hull


def slope_range(points: Sequence[Point]) -> tuple[float, float]:
    """Smallest and largest slope about as likely as that of the best line under the points.

    The best line, according to Moon et al., is the edge of the lower convex hull at the mean of x.
    At least three points ascend in x, then y, with at least two values of x. Both slopes are equal
    if all points are on the best line.
    """
    hull = lower_hull(points)
    middle = sum(x for x, _ in points) / len(points)
    for (u, v), (x, y) in itertools.pairwise(hull):
        if x >= middle:
            slope = (y - v) / (x - u)
            height = v + slope * (middle - u)
            break
    # Two points are always on the line. The median is insensitive to stalls of the link.
    heights = sorted(y - height - slope * (x - middle) for x, y in points)[2:]
    floor = height - heights[len(heights) // 2] / math.log(2.0) / len(points)
    low = max((y - floor) / (x - middle) for x, y in hull if x < middle)
    high = min((y - floor) / (x - middle) for x, y in hull if x > middle)
    return min(low, slope), max(high, slope)
