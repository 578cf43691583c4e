"""Sequential tests of a track: Bayes factor of a target, and innovation consistency.

The normalised innovations squared (NIS) of a consistent filter are chi-square distributed; a
filter that allows for model errors has smaller NIS. A single frame is not conclusive.
"""

from collections import deque

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray
from mag_tracking.units import NS


class SlidingSum:
    """Sum of the values in a sliding window that ends at the latest frame."""

    def __init__(self, window_s: float) -> None:
        self._window_ns = round(window_s * NS)
        self._frames: deque[tuple[int, FloatArray]] = deque()

    def add(self, stamp_ns: int, value: ArrayLike) -> None:
        """Add the value of a frame."""
        self._frames.append((stamp_ns, np.asarray(value, dtype=float)))
        while self._frames[0][0] < stamp_ns - self._window_ns:
            self._frames.popleft()

    @property
    def total(self) -> FloatArray:
        """Sum of the values in the window; 0 before the first value."""
        total: FloatArray = np.sum([value for _, value in self._frames], axis=0)
        return total


BAYES_FACTOR_WINDOW_S = 1.0
"""Length of the sliding window of `TargetBayesFactor.is_recently_disfavoured` [s]."""
MIN_LOG_RATIO = -30.0
"""Log Bayes factor [nats] at or below which a track cannot become a target again."""


class TargetBayesFactor:
    """Bayes factor of a target against an alternative explanation, updated by each frame.

    `log_ratio` [nats] is its logarithm over the whole track.
    """

    def __init__(self) -> None:
        self.log_ratio = 0.0
        self._is_known, self._was_favoured = True, False
        self._disfavoured_since_ns: int | None = None
        self._recent_sum = SlidingSum(BAYES_FACTOR_WINDOW_S)

    def add(self, log_ratio: float, stamp_ns: int, min_bayes_factor: float) -> None:
        """Add the log-density [nats] of a frame with a target minus that with the alternative.

        The alternative is favoured at or below the reciprocal of `min_bayes_factor`.
        """
        if not np.isfinite(log_ratio):
            self._is_known = False
            return
        self.log_ratio += log_ratio
        self._was_favoured = self._was_favoured or self.is_favoured(min_bayes_factor)
        if self.log_ratio > -np.log(min_bayes_factor):
            self._disfavoured_since_ns = None
        elif self._disfavoured_since_ns is None:
            self._disfavoured_since_ns = stamp_ns
        self._recent_sum.add(stamp_ns, log_ratio)

    def would_be_favoured(self, log_ratio: float, min_bayes_factor: float) -> bool:
        """Whether a target is favoured if the log-likelihood increases by `log_ratio` [nats]."""
        return self._is_known and self.log_ratio > MIN_LOG_RATIO \
            and self.log_ratio + log_ratio >= float(np.log(min_bayes_factor))

    def is_favoured(self, min_bayes_factor: float) -> bool:
        """Whether the Bayes factor of the whole track favours a target."""
        return self._is_known and self.log_ratio >= float(np.log(min_bayes_factor))

    def is_recently_disfavoured(self, min_bayes_factor: float) -> bool:
        """Whether the Bayes factor of the latest second favours the alternative."""
        return bool(self._recent_sum.total < -np.log(min_bayes_factor))

    def disfavoured_s(self, stamp_ns: int) -> float:
        """Time for which the Bayes factor of the whole track has favoured the alternative."""
        # The field of a stopped vehicle, which was favoured earlier, is as smooth.
        if self._was_favoured or self._disfavoured_since_ns is None or not self._is_known:
            return 0.0
        return (stamp_ns - self._disfavoured_since_ns) / NS


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
        """Add the NIS of each sensor in a frame (NaN if missing) and its number of axes."""
        values = np.stack([np.nan_to_num(nis), np.where(np.isnan(nis), 0, n_axes)])
        values = np.column_stack([values, values.sum(axis=1)])
        self._total += values
        self._recent_sum.add(stamp_ns, values)

    @property
    def excess(self) -> float:
        """Largest significant ratio of actual to predicted innovation variance in the window."""
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
        """Flag the sums of NIS (n_sensors + 1,) above the threshold."""
        probability = np.append(np.full(self._n_sensors, FALSE_ALARM_PROBABILITY / self._n_sensors),
                                FALSE_ALARM_PROBABILITY)
        nis, dof = values
        with np.errstate(invalid='ignore'):
            exceeds: FloatArray = nis > np.where(
                dof > 0, chdtri(np.maximum(dof, 1.0), probability), np.inf)
        return exceeds
