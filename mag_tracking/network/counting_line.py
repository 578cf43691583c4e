"""Counting lines on the ground, and the crossings of a line by a track."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.units import NS

Pose: TypeAlias = Track | SmoothedPose
"""Filtered or smoothed pose of a track."""
MIN_SPEED = 1.0
"""Minimum speed for extrapolation to a line [m/s]. Slower vehicles may stop before the line."""
MAX_EXTRAPOLATION_S = 1.0
"""Maximum extrapolation time from the beginning or end of a track to a line [s]."""


@dataclass(frozen=True)
class CountingLine:
    """A line on the ground at which vehicles are counted: midpoint (2,) [m], unit vector (2,) of
    the forward direction across the line, and half of its length [m]; world frame."""

    name: str
    point: FloatArray
    direction: FloatArray
    half_width: float

    def forward_distance(self, position: FloatArray) -> float:
        """Signed distance [m] of a world position (2,) or (3,); positive beyond the line."""
        return float((position[:2] - self.point) @ self.direction)

    def lateral_offset(self, position: FloatArray) -> float:
        """Offset [m] of a world position from the midpoint; positive left, facing forward."""
        r = position[:2] - self.point
        return float(self.direction[0] * r[1] - self.direction[1] * r[0])


def counting_lines(names: Sequence[str], headings_deg: Sequence[float], offsets: Sequence[float],
                   half_widths: Sequence[float], centre: FloatArray) -> list[CountingLine]:
    """Create counting lines from their forward directions, anticlockwise from x, and their
    distances [m] from the centre of the network in this direction."""
    out = []
    for name, heading, offset, half_width in zip(names, np.deg2rad(headings_deg), offsets,
                                                 half_widths, strict=True):
        direction = np.array([np.cos(heading), np.sin(heading)])
        out.append(CountingLine(name, centre[:2] + offset * direction, direction, half_width))
    return out


class Crossing(NamedTuple):
    """A crossing of a line by a track, at a position (3,) m, world frame."""

    stamp_ns: int
    position: FloatArray
    forward: bool
    """Whether the track moved in the forward direction of the line."""
    pose: Pose
    """Pose of the track that is closest in time."""
    is_extrapolated: bool
    """Whether the track begins after the crossing or ends before it."""


class CrossingDetector:
    """Detects the crossing of a line by one track."""

    def __init__(self, line: CountingLine) -> None:
        self.line = line
        self._first_pose: Pose | None = None
        self._last_pose: Pose | None = None
        self._crossing_poses: tuple[Pose, Pose] | None = None

    @property
    def has_pose(self) -> bool:
        """Whether a pose has been added."""
        return self._first_pose is not None

    def add(self, pose: Pose) -> None:
        """Add the next pose of the track, in chronological order."""
        if self._first_pose is None:
            self._first_pose = pose
        if self._last_pose is not None \
                and self._is_beyond(self._last_pose) != self._is_beyond(pose):
            self._crossing_poses = self._last_pose, pose
        self._last_pose = pose

    def _is_beyond(self, pose: Pose) -> bool:
        """Whether a pose is on or beyond the line."""
        return self.line.forward_distance(pose.position) >= 0.0

    def crossing(self) -> Crossing | None:
        """Last crossing of the line; None without one, or if it is beside the line segment.

        If the track begins and ends on the same side, a crossing is extrapolated from its first or
        last pose within `MAX_EXTRAPOLATION_S`.
        """
        if self._first_pose is None or self._last_pose is None:
            return None
        crossing = self._interpolate() if self._is_beyond(self._first_pose) != self._is_beyond(
            self._last_pose) else self._extrapolate(self._first_pose, self._last_pose)
        if crossing is None or abs(
                self.line.lateral_offset(crossing.position)) > self.line.half_width:
            return None
        return crossing

    def _interpolate(self) -> Crossing:
        """Interpolate the crossing between the poses before and after the line."""
        assert self._crossing_poses is not None
        before, after = self._crossing_poses
        distances = [self.line.forward_distance(p.position) for p in self._crossing_poses]
        fraction = distances[0] / (distances[0] - distances[1])
        return Crossing(before.stamp_ns + round(fraction * (after.stamp_ns - before.stamp_ns)),
                        (1.0 - fraction) * before.position + fraction * after.position,
                        distances[1] > distances[0], before if fraction < 0.5 else after, False)

    def _extrapolate(self, first: Pose, last: Pose) -> Crossing | None:
        """Extrapolate a crossing; None below `MIN_SPEED` or beyond `MAX_EXTRAPOLATION_S`."""
        for pose, sign in ((first, -1.0), (last, 1.0)):
            speed = float(pose.velocity[:2] @ self.line.direction)
            if abs(speed) < MIN_SPEED:
                continue
            t = -self.line.forward_distance(pose.position) / speed
            if 0.0 <= sign * t <= MAX_EXTRAPOLATION_S:
                return Crossing(pose.stamp_ns + round(t * NS), pose.position + t * pose.velocity,
                                speed > 0.0, pose, True)
        return None
