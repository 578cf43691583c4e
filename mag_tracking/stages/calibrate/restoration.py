"""Backgrounds that are kept for a restart, and taken up where the readings go on soon after."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.units import NS


@dataclass(frozen=True)
class Kept:
    """The background of one sensor, to go on from after a restart."""

    stamp_ns: int
    background: FloatArray
    """(3,) [T]; NaN = axis not reported."""
    covariance: FloatArray
    """(3, 3) [T^2] noise of one sample."""


def to_keep(background: RunningBackground, stamp_ns: int, level: FloatArray) -> Kept | None:
    """What is to be kept of a `RunningBackground` that is ready: `Kept`, or None.

    `level` (3,) [T] is what it says of `stamp_ns`, the latest reading.
    """
    C = background.covariance
    assert C is not None
    # An axis that has only just begun to report has a level, but no noise yet.
    level = np.where(np.isnan(np.diagonal(C)), np.nan, level)
    return None if np.isnan(level).all() else Kept(stamp_ns, level, C)


class BackgroundRestoration:
    """What was kept of sensors of which nothing has come yet."""

    def __init__(self, longest_s: float) -> None:
        """`longest_s` [s]: a first reading that comes later is of another time."""
        self._longest_ns = longest_s * NS
        self._kept: dict[str, Kept] = {}

    def __contains__(self, sensor: str) -> bool:
        return sensor in self._kept

    def offer(self, kept: Mapping[str, Kept]) -> None:
        """{sensor: `Kept`}, in place of what was offered before."""
        self._kept = dict(kept)

    def forget(self, sensor: str) -> None:
        """What was kept of `sensor` is of no use any more."""
        self._kept.pop(sensor, None)

    def take_up(self, sensor: str, stamp_ns: int, background: RunningBackground) -> str:
        """The first reading of `sensor` decides; what is to be counted of it.

        Its `RunningBackground` goes on from what was kept, if that is of a moment before.
        """
        kept = self._kept.pop(sensor)
        if 0 < stamp_ns - kept.stamp_ns <= self._longest_ns:
            background.resume(kept.background, kept.covariance)
            return 'backgrounds resumed'
        return 'backgrounds of another time not resumed'
