"""Bayes factor of a target against an alternative explanation, over the frames of a track."""

import numpy as np

from mag_tracking.inference.sliding_sum import SlidingSum
from mag_tracking.units import NS

WINDOW_S = 1.0
"""Length of the sliding window of `TargetBayesFactor.is_recently_disfavoured` [s]."""

MIN_LOG_RATIO = -30.0
"""Log Bayes factor [nats] at or below which a track cannot become a target again, regardless of its
fit."""


class TargetBayesFactor:
    """Bayes factor of a target against an alternative explanation, updated by each frame.

    Attributes
    ----------
    log_ratio : log Bayes factor over the whole track, nats
    """

    def __init__(self) -> None:
        self.log_ratio = 0.0
        self._is_known, self._was_favoured = True, False
        self._disfavoured_since_ns: int | None = None
        self._recent_sum = SlidingSum(WINDOW_S)

    def add(self, log_ratio: float, stamp_ns: int, min_bayes_factor: float) -> None:
        """Add the log-density [nats] of a frame with a target minus that with the alternative.

        The alternative is favoured at or below the reciprocal of `min_bayes_factor`. After a
        `log_ratio` that is not finite, the Bayes factor remains unknown, and a target is never
        favoured.
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
        """Whether a target would be favoured if the log-likelihood of the track increased by
        `log_ratio` [nats]; False if the Bayes factor is unknown, or at or below `MIN_LOG_RATIO`."""
        return self._is_known and self.log_ratio > MIN_LOG_RATIO \
            and self.log_ratio + log_ratio >= float(np.log(min_bayes_factor))

    def is_favoured(self, min_bayes_factor: float) -> bool:
        """Whether the Bayes factor of the whole track favours a target."""
        return self._is_known and self.log_ratio >= float(np.log(min_bayes_factor))

    def is_recently_disfavoured(self, min_bayes_factor: float) -> bool:
        """Whether the Bayes factor of the latest `WINDOW_S` favours the alternative."""
        return bool(self._recent_sum.total < -np.log(min_bayes_factor))

    def disfavoured_s(self, stamp_ns: int) -> float:
        """Time for which the Bayes factor of the whole track has favoured the alternative.

        0 if the Bayes factor is unknown. 0 also if a target was favoured earlier, because the field
        of a stopped vehicle is as smooth as the alternative.
        """
        if self._was_favoured or self._disfavoured_since_ns is None or not self._is_known:
            return 0.0
        return (stamp_ns - self._disfavoured_since_ns) / NS
