"""Innovation consistency: whether the innovations of a track match their covariance, over time.

The normalised innovations squared (NIS) of a consistent filter are chi-square distributed; a
filter that allows for model errors has smaller NIS. A single frame is not conclusive. The test
covers the frames of a short window and the whole track, for the network as a whole and for each
sensor.
"""

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.sliding_sum import SlidingSum

WINDOW_S = 0.5
"""[s] Length of the window of latest frames that are tested together."""

FALSE_ALARM_PROBABILITY = 1e-3
"""False-alarm probability of a test of the network, and of the tests of all sensors together."""


class InnovationConsistency:
    """Chi-square test of the innovations of a track ([BarShalom01]_ section 5.4.2)."""

    def __init__(self, n_sensors: int) -> None:
        self._n_sensors = n_sensors
        # (2, n_sensors + 1): NIS and degrees of freedom, of each sensor and of the network.
        self._total = np.zeros((2, n_sensors + 1))
        self._recent_sum = SlidingSum(WINDOW_S)

    def add(self, nis: FloatArray, n_axes: FloatArray, stamp_ns: int) -> None:
        """Add the NIS of each sensor in a frame (NaN if missing) and its number of measured
        axes."""
        values = np.stack([np.nan_to_num(nis), np.where(np.isnan(nis), 0, n_axes)])
        values = np.column_stack([values, values.sum(axis=1)])
        self._total += values
        self._recent_sum.add(stamp_ns, values)

    @property
    def excess(self) -> float:
        """Largest significant ratio of actual to predicted innovation variance in the window; 1 if
        the innovations of the network and of each sensor are consistent."""
        recent = self._recent_sum.total
        fails = self._fails(recent)
        with np.errstate(invalid='ignore', divide='ignore'):
            ratio = np.where(fails, recent[0] / recent[1], 1.0)
        return float(ratio.max())

    @property
    def fails(self) -> bool:
        """Whether the innovations of the network or a sensor fail the test over the whole track."""
        return bool(self._fails(self._total).any())

    def _fails(self, values: FloatArray) -> FloatArray:
        """Flag the sums of NIS (n_sensors + 1,) above the threshold; `values` are sums and degrees
        of freedom."""
        probability = np.append(np.full(self._n_sensors, FALSE_ALARM_PROBABILITY / self._n_sensors),
                                FALSE_ALARM_PROBABILITY)
        nis, dof = values
        with np.errstate(invalid='ignore'):
            exceeds: FloatArray = nis > np.where(
                dof > 0, chdtri(np.maximum(dof, 1.0), probability), np.inf)
        return exceeds
