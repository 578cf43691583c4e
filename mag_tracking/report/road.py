"""Outline of the road, inferred from the paths of vehicles and the positions of the sensors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mag_tracking.arrays import BoolArray, FloatArray

ComplexArray: TypeAlias = NDArray[np.complex128]

LANE_WIDTH_M = 3.5
SHOULDER_M = 1.0
"""Distance of the edge of the road from a sensor beside it [m]."""
MAX_ANGLE = np.radians(15.0)
"""Maximum angle between the road and a vehicle that follows it [rad]."""
MIN_STEP_M = 0.25
"""Minimum distance of consecutive points of a path [m]; the direction of shorter steps is noise."""
BEYOND_M = 100.0
"""Length by which the road continues beyond all paths and sensors [m]."""


@dataclass(frozen=True)
class Road:
    """Outline of a road with side roads; empty if no vehicle has passed."""

    areas: Sequence[FloatArray] = ()
    """Polygons, each (n, 2) m, world frame."""
    markings: Sequence[FloatArray] = ()
    """Lines between the lanes, each (2, 2) m, world frame."""


def road_of(sensors: FloatArray, paths: Sequence[FloatArray]) -> Road:
    """Infer the road on which vehicles have passed a network, from positions [m, world frame].

    The carriageway is straight and as wide as the paths along it, and fills the space between
    sensors on both sides. A path that leaves it is surrounded by a side road.
    """
    paths = [path for path in map(_thinned, paths) if len(path) > 2]
    if not paths:
        return Road()
    centre = sensors.mean(axis=0)
    axis = _axis(sensors, centre, paths)
    across = np.array([-axis[1], axis[0]])
    follows = [_follows(path, axis) for path in paths]
    beyond = BEYOND_M + max(float(np.abs(p - centre).max()) for p in (sensors, *paths))
    lateral = np.concatenate([((p[1:] + p[:-1])[f] / 2 - centre) @ across
                              for p, f in zip(paths, follows, strict=True)])
    areas, markings = [], []
    if len(lateral):
        low, high = _edges(lateral, (sensors - centre) @ across)
        ends = centre + beyond * np.array([[-1.0], [1.0]]) * axis
        areas.append(np.vstack([ends + low * across, (ends + high * across)[::-1]]))
        if high - low > 1.5 * LANE_WIDTH_M:
            markings.append(ends + 0.5 * (low + high) * across)
    side_roads: list[FloatArray] = []
    for path, follow in zip(paths, follows, strict=True):
        side_roads += [part for part in _side_roads(path, follow, beyond)
                       if not _is_within(part, side_roads)]
    return Road([*areas, *map(_outline, side_roads)], markings)


def _thinned(path: FloatArray) -> FloatArray:
    """Points of a path that are at least `MIN_STEP_M` apart."""
    kept = [path[0]] if len(path) else []
    for point in path:
        if np.hypot(*(point - kept[-1])) >= MIN_STEP_M:
            kept.append(point)
    return np.array(kept).reshape(-1, 2)


def _axis(sensors: FloatArray, centre: FloatArray, paths: Sequence[FloatArray]) -> FloatArray:
    """Unit vector along the road: most frequent direction of the paths near the sensors."""
    scale = max(0.25 * float(np.ptp(sensors, axis=0).max()), LANE_WIDTH_M)
    steps = np.vstack([np.diff(path, axis=0) for path in paths]) @ np.array([1.0, 1j])
    distance = np.concatenate([np.hypot(*(path[1:] - centre).T) for path in paths])
    # Opposite directions are the same axis, so the angles are doubled.
    doubled = steps**2 / np.abs(steps) * np.exp(-0.5 * (distance / scale)**2)
    axis = max(np.exp(2j * np.radians(np.arange(0.0, 180.0, 5.0))),
               key=lambda direction: abs(_mean_near(doubled, direction, MAX_ANGLE)))
    for window in (MAX_ANGLE, MAX_ANGLE / 3.0):
        axis = _mean_near(doubled, axis, window)
    angle = 0.5 * float(np.angle(axis))
    return np.array([np.cos(angle), np.sin(angle)])


def _mean_near(doubled: ComplexArray, direction: complex, window: float) -> complex:
    """Sum of the steps, with doubled angles, that are within `window` [rad] of a direction."""
    return complex(doubled[np.abs(np.angle(doubled / direction)) < 2.0 * window].sum())


def _follows(path: FloatArray, axis: FloatArray) -> BoolArray:
    """Whether each step of a path (k, 2) is along the road, (k - 1,)."""
    steps = np.diff(path, axis=0)
    along: BoolArray = np.abs(steps @ axis) >= np.cos(MAX_ANGLE) * np.hypot(*steps.T)
    return along


def _edges(lateral: FloatArray, sensors: FloatArray) -> tuple[float, float]:
    """Edges of the carriageway [m] from lateral positions of vehicles and of the sensors."""
    low, high = np.percentile(lateral, [5.0, 95.0])
    right, left = sensors[sensors < low], sensors[sensors > high]
    if len(right) and len(left):
        return (min(float(right.max()) + SHOULDER_M, low - 0.5 * LANE_WIDTH_M),
                max(float(left.min()) - SHOULDER_M, high + 0.5 * LANE_WIDTH_M))
    return low - 0.5 * LANE_WIDTH_M, high + 0.5 * LANE_WIDTH_M


def _side_roads(path: FloatArray, follows: BoolArray, beyond: float) -> list[FloatArray]:
    """Parts of a path that leave the carriageway."""
    parts = []
    starts = np.flatnonzero(np.diff(follows.astype(int), prepend=1) < 0)
    ends = np.flatnonzero(np.diff(follows.astype(int), append=1) > 0)
    for first, last in zip(starts, ends, strict=True):
        part = path[first:last + 2]
        if np.hypot(*(part[-1] - part[0])) < LANE_WIDTH_M:
            continue
        # A side road continues beyond the first or last point of the path.
        if first == 0:
            part = np.vstack([part[0] - beyond * _unit(part[2] - part[0]), part])
        if last == len(follows) - 1:
            part = np.vstack([part, part[-1] + beyond * _unit(part[-1] - part[-3])])
        parts.append(part)
    return parts


def _is_within(part: FloatArray, side_roads: Sequence[FloatArray]) -> bool:
    """Whether a path is on a known side road; the points far beyond the path are ignored."""
    if not side_roads:
        return False
    known = np.vstack(side_roads)
    distance = np.hypot(*(part[1:-1, None] - known).transpose(2, 0, 1)).min(axis=1)
    return bool((distance < 0.5 * LANE_WIDTH_M).all())


def _outline(part: FloatArray) -> FloatArray:
    """Polygon of one lane around a path (n, 2)."""
    tangent = np.gradient(part, axis=0)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.hypot(*tangent.T)[:, None]
    return np.vstack([part + 0.5 * LANE_WIDTH_M * normal,
                      (part - 0.5 * LANE_WIDTH_M * normal)[::-1]])


def _unit(v: FloatArray) -> FloatArray:
    unit: FloatArray = v / np.hypot(*v)
    return unit
