"""Counting lines on the ground, and where and when a track crosses one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.units import NS

Pose: TypeAlias = Track | SmoothedPose

MIN_SPEED = 1.0
"""[m/s] A slower vehicle may stop before the line, and is not extrapolated to it."""

EXTRAPOLATED_S = 1.0
"""[s] A track that begins or ends this close to a line is extrapolated to it."""


@dataclass(frozen=True)
class Line:
    """A counting line."""

    name: str
    point: FloatArray
    """(2,) [m] its middle."""
    along: FloatArray
    """(2,) unit vector of the forward direction, across the line."""
    half_width: float
    """[m]"""

    def forward(self, position: FloatArray) -> float:
        """[m] of a position (3,) beyond the line, in its forward direction."""
        return float((position[:2] - self.point) @ self.along)

    def lateral(self, position: FloatArray) -> float:
        """[m] of a position (3,) to the left of the line's middle, seen in forward direction."""
        r = position[:2] - self.point
        return float(self.along[0] * r[1] - self.along[1] * r[0])


def lines_of(names: Sequence[str], headings_deg: Sequence[float], offsets: Sequence[float],
             half_widths: Sequence[float], centre: FloatArray) -> list[Line]:
    """The `Line`s of a network with a `centre` (2 or 3,) [m]."""
    out = []
    for name, heading, offset, half_width in zip(names, np.deg2rad(headings_deg), offsets,
                                                 half_widths, strict=True):
        along = np.array([np.cos(heading), np.sin(heading)])
        out.append(Line(name, centre[:2] + offset * along, along, half_width))
    return out


class Crossing(NamedTuple):
    """A crossing of a line by a track."""

    stamp_ns: int
    position: FloatArray
    """(3,) [m] on the line, world."""
    forward: bool
    pose: Pose
    """That of the track which is closest in time."""
    is_extrapolated: bool


class LinePath:
    """The poses of one track, one after the other, as far as a line needs them."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self._first: Pose | None = None
        self._last: Pose | None = None
        self._pair: tuple[Pose, Pose] | None = None

    @property
    def is_begun(self) -> bool:
        """Whether there is a pose."""
        return self._first is not None

    def add(self, pose: Pose) -> None:
        """Take the next pose."""
        if self._first is None:
            self._first = pose
        if self._last is not None and self._is_beyond(self._last) != self._is_beyond(pose):
            self._pair = self._last, pose
        self._last = pose

    def _is_beyond(self, pose: Pose) -> bool:
        """Whether a pose has crossed the line."""
        return self.line.forward(pose.position) >= 0.0

    def crossing(self) -> Crossing | None:
        """The last crossing; None for a track that ends on the side on which it began."""
        if self._first is None or self._last is None:
            return None
        found = self._interpolated() if self._is_beyond(self._first) != self._is_beyond(
            self._last) else self._extrapolated(self._first, self._last)
        if found is None or abs(self.line.lateral(found.position)) > self.line.half_width:
            return None
        return found

    def _interpolated(self) -> Crossing:
        """The crossing between two poses."""
        assert self._pair is not None
        before, after = self._pair
        s = [self.line.forward(p.position) for p in self._pair]
        share = s[0] / (s[0] - s[1])
        return Crossing(before.stamp_ns + round(share * (after.stamp_ns - before.stamp_ns)),
                        (1.0 - share) * before.position + share * after.position, s[1] > s[0],
                        before if share < 0.5 else after, False)

    def _extrapolated(self, first: Pose, last: Pose) -> Crossing | None:
        """A crossing shortly before the first pose, or shortly after the last one."""
        for pose, sign in ((first, -1.0), (last, 1.0)):
            speed = float(pose.velocity[:2] @ self.line.along)
            if abs(speed) < MIN_SPEED:
                continue
            t = -self.line.forward(pose.position) / speed
            if 0.0 <= sign * t <= EXTRAPOLATED_S:
                return Crossing(pose.stamp_ns + round(t * NS), pose.position + t * pose.velocity,
                                speed > 0.0, pose, True)
        return None
