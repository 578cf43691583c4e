"""Whether the innovations of a track are as large as its filter states, over time.

The normalised innovations squared of a consistent filter are chi-square; those of a filter that
allows for model errors are smaller. A single frame says little. Tested are the frames of a short
window, and all of the track; the whole network, and each sensor.

Source: Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and
Navigation, section 5.4.2.
"""

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.sliding_sum import SlidingSum

WINDOW_S = 0.5
"""[s] Latest frames that are tested together."""

FALSE_ALARM = 1e-3
"""Probability that the innovations of a consistent filter fail one test."""


class InnovationConsistency:
    """Innovations of a track against their chi-square law."""

    def __init__(self, n_sensors: int) -> None:
        self._n_sensors = n_sensors
        # (2, n_sensors + 1): normalised innovations squared and degrees of freedom, of each sensor
        # and of all.
        self._total = np.zeros((2, n_sensors + 1))
        self._latest = SlidingSum(WINDOW_S)

    def add(self, nis: FloatArray, n_axes: FloatArray, stamp_ns: int) -> None:
        """Count a frame.

        Parameters
        ----------
        nis : (n_sensors,) array
            Normalised innovation squared of each sensor; NaN = missing.
        n_axes : (n_sensors,) array
            Axes that each of them measured.
        stamp_ns : int
        """
        values = np.stack([np.nan_to_num(nis), np.where(np.isnan(nis), 0, n_axes)])
        values = np.column_stack([values, values.sum(axis=1)])
        self._total += values
        self._latest.add(stamp_ns, values)

    @property
    def excess(self) -> float:
        """How many times too large the variances of the latest innovations are; 1 = as stated."""
        latest = self._latest.total
        fails = self._fails(latest)
        with np.errstate(invalid='ignore', divide='ignore'):
            ratio = np.where(fails, latest[0] / latest[1], 1.0)
        return float(ratio.max())

    @property
    def fails(self) -> bool:
        """Whether the innovations of the track as a whole are too large."""
        return bool(self._fails(self._total).any())

    def _fails(self, values: FloatArray) -> FloatArray:
        """(n_sensors + 1,) whether sums (2, n_sensors + 1) exceed their law."""
        probability = np.append(np.full(self._n_sensors, FALSE_ALARM / self._n_sensors),
                                FALSE_ALARM)
        nis, freedom = values
        with np.errstate(invalid='ignore'):
            exceeds: FloatArray = nis > np.where(
                freedom > 0, chdtri(np.maximum(freedom, 1.0), probability), np.inf)
        return exceeds
