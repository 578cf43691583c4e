"""Backgrounds that are restored after a restart if the readings continue soon after."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.units import NS


@dataclass(frozen=True)
class StoredBackground:
    """The background of one sensor, as it is restored after a restart."""

    stamp_ns: int
    background: FloatArray
    """(3,) [T]; NaN = axis not reported."""
    covariance: FloatArray
    """(3, 3) [T^2] noise of one sample."""


def stored_background(background: RunningBackground, stamp_ns: int,
                      level: FloatArray) -> StoredBackground | None:
    """`StoredBackground` of a `RunningBackground` that is ready, or None.

    `level` (3,) [T] is the background at `stamp_ns`, the sensor's latest reading.
    """
    C = background.covariance
    assert C is not None
    # An axis that has only just begun to report has a level, but no noise yet.
    level = np.where(np.isnan(np.diagonal(C)), np.nan, level)
    return None if np.isnan(level).all() else StoredBackground(stamp_ns, level, C)


class BackgroundRestoration:
    """Stored backgrounds of sensors without a reading so far."""

    def __init__(self, longest_s: float) -> None:
        """`longest_s` [s]: maximum age of a stored background at the sensor's first reading."""
        self._longest_ns = longest_s * NS
        self._stored: dict[str, StoredBackground] = {}

    def __contains__(self, sensor: str) -> bool:
        return sensor in self._stored

    def offer(self, stored: Mapping[str, StoredBackground]) -> None:
        """Replace the stored backgrounds by {sensor: `StoredBackground`}."""
        self._stored = dict(stored)

    def forget(self, sensor: str) -> None:
        """Drop the stored background of `sensor`."""
        self._stored.pop(sensor, None)

    def restore(self, sensor: str, stamp_ns: int, background: RunningBackground) -> str:
        """Restore a background at the sensor's first reading if it is recent.

        Returns the event to be counted.
        """
        stored = self._stored.pop(sensor)
        if 0 < stamp_ns - stored.stamp_ns <= self._longest_ns:
            background.resume(stored.background, stored.covariance)
            return 'backgrounds resumed'
        return 'backgrounds of another time not resumed'
