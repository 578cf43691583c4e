"""Restoration of backgrounds after a short interruption of the readings."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.units import NS


@dataclass(frozen=True)
class StoredBackground:
    """Stored background of one sensor, to be restored after a restart."""

    stamp_ns: int
    background: FloatArray
    """Background, (3,) T, sensor frame. NaN for an axis that is not reported."""
    covariance: FloatArray
    """Noise covariance of one sample, (3, 3) T², sensor frame."""


def stored_background(background: RunningBackground, stamp_ns: int,
                      level: FloatArray) -> StoredBackground | None:
    """Convert a known background with `level` (3,) [T] at `stamp_ns` to its stored form.

    None if no axis has both a level and a noise variance.
    """
    C = background.covariance
    assert C is not None
    # An axis that has just started to report has a level but no noise variance yet.
    level = np.where(np.isnan(np.diagonal(C)), np.nan, level)
    return None if np.isnan(level).all() else StoredBackground(stamp_ns, level, C)


class BackgroundRestoration:
    """Restores the stored background of each sensor at its first reading.

    Parameters
    ----------
    max_gap_s : float
        Maximum age of a stored background at the first reading of its sensor [s].
    """

    def __init__(self, max_gap_s: float) -> None:
        self._max_gap_ns = max_gap_s * NS
        self._stored: dict[str, StoredBackground] = {}

    def __contains__(self, sensor: str) -> bool:
        return sensor in self._stored

    def set_stored(self, stored: Mapping[str, StoredBackground]) -> None:
        """Replace all stored backgrounds; the keys are the sensors."""
        self._stored = dict(stored)

    def forget(self, sensor: str) -> None:
        """Drop the stored background of a sensor."""
        self._stored.pop(sensor, None)

    def restore(self, sensor: str, stamp_ns: int, background: RunningBackground) -> str:
        """Restore the stored background of a sensor at its first reading, unless it is outdated.

        `background` receives it. Return the outcome, as a key of `Calibrate.counts`.
        """
        stored = self._stored.pop(sensor)
        if 0 < stamp_ns - stored.stamp_ns <= self._max_gap_ns:
            background.resume(stored.background, stored.covariance)
            return 'backgrounds restored'
        return 'outdated backgrounds not restored'
