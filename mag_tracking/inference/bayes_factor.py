"""How much better a target explains the frames of a track than something else does."""

import numpy as np

from mag_tracking.inference.sliding_sum import SlidingSum
from mag_tracking.units import NS

WINDOW_S = 1.0
"""[s] Length of the latest frames, over which a target must not fall behind."""

MIN_LOG_RATIO = -30.0
"""[nats] Where something else explains a track so much better, it is no target at all."""


class TargetBayesFactor:
    """Log of the Bayes factor of a target against something else.

    Attributes
    ----------
    log_ratio : float
        Over the whole track.
    """

    def __init__(self) -> None:
        self.log_ratio = 0.0
        self._is_known, self._was_favoured = True, False
        self._disfavoured_since_ns: int | None = None
        self._latest = SlidingSum(WINDOW_S)

    def add(self, log_ratio: float, stamp_ns: int, ratio: float) -> None:
        """Count a frame.

        Parameters
        ----------
        log_ratio : float [nats]
            Log-density of the frame with a target, minus that with something else.
        stamp_ns : int
        ratio : float
            By which one of them has to lead.
        """
        if not np.isfinite(log_ratio):
            self._is_known = False
            return
        self.log_ratio += log_ratio
        self._was_favoured = self._was_favoured or self.is_favoured(ratio)
        if self.log_ratio > -np.log(ratio):
            self._disfavoured_since_ns = None
        elif self._disfavoured_since_ns is None:
            self._disfavoured_since_ns = stamp_ns
        self._latest.add(stamp_ns, log_ratio)

    def would_be_favoured(self, log_ratio: float, ratio: float) -> bool:
        """Whether a target would lead if it explained the track better by `log_ratio` [nats]; not
        where something else is far ahead."""
        return self._is_known and self.log_ratio > MIN_LOG_RATIO \
            and self.log_ratio + log_ratio >= float(np.log(ratio))

    def is_favoured(self, ratio: float) -> bool:
        """Whether a target explains the whole track `ratio` times better than something else."""
        return self._is_known and self.log_ratio >= float(np.log(ratio))

    def is_recently_disfavoured(self, ratio: float) -> bool:
        """Whether something else explains the latest frames `ratio` times better."""
        return bool(self._latest.total < -np.log(ratio))

    def disfavoured_s(self, stamp_ns: int) -> float:
        """[s] for which something else has led.

        0 where a target has led before: it may have stopped, and is then as smooth as anything.
        """
        if self._was_favoured or self._disfavoured_since_ns is None or not self._is_known:
            return 0.0
        return (stamp_ns - self._disfavoured_since_ns) / NS
