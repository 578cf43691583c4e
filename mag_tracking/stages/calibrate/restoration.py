"""Backgrounds that are restored after a restart if the readings continue soon after it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.units import NS


@dataclass(frozen=True)
class StoredBackground:
    """Background of one sensor that is restored after a restart."""

    stamp_ns: int
    background: FloatArray
    """(3,) [T]; NaN = axis not reported."""
    covariance: FloatArray
    """(3, 3) [T^2] Noise of one sample."""


def stored_background(background: RunningBackground, stamp_ns: int,
                      level: FloatArray) -> StoredBackground | None:
    """Background of a sensor in the form that is stored.

    Parameters
    ----------
    background : RunningBackground
        A background that is ready.
    stamp_ns : int, ns
        Timestamp of the latest reading of the sensor.
    level : (3,) array, T
        Background at `stamp_ns`.

    Returns
    -------
    StoredBackground or None
        None if no axis has both a level and a noise.
    """
    C = background.covariance
    assert C is not None
    # An axis that has only just started to report has a level, but no noise yet.
    level = np.where(np.isnan(np.diagonal(C)), np.nan, level)
    return None if np.isnan(level).all() else StoredBackground(stamp_ns, level, C)


class BackgroundRestoration:
    """Stored backgrounds of the sensors that have not yet delivered a reading.

    Parameters
    ----------
    max_gap_s : float, s
        Maximum age of a stored background at the first reading of its sensor.
    """

    def __init__(self, max_gap_s: float) -> None:
        self._max_gap_ns = max_gap_s * NS
        self._stored: dict[str, StoredBackground] = {}

    def __contains__(self, sensor: str) -> bool:
        return sensor in self._stored

    def offer(self, stored: Mapping[str, StoredBackground]) -> None:
        """Replace the stored backgrounds.

        Parameters
        ----------
        stored : mapping of str to StoredBackground
            Background of each sensor.
        """
        self._stored = dict(stored)

    def forget(self, sensor: str) -> None:
        """Drop the stored background of a sensor.

        Parameters
        ----------
        sensor : str
        """
        self._stored.pop(sensor, None)

    def restore(self, sensor: str, stamp_ns: int, background: RunningBackground) -> str:
        """Restore a background at the first reading of its sensor if it is recent.

        Parameters
        ----------
        sensor : str
        stamp_ns : int, ns
            Timestamp of the first reading.
        background : RunningBackground
            Receives the stored background.

        Returns
        -------
        str
            Event to be counted.
        """
        stored = self._stored.pop(sensor)
        if 0 < stamp_ns - stored.stamp_ns <= self._max_gap_ns:
            background.resume(stored.background, stored.covariance)
            return 'backgrounds restored'
        return 'outdated backgrounds not restored'
