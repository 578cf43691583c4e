"""How much better a target explains the frames of a track than something else does."""

from collections import deque

import numpy as np

from mag_tracking.units import NS

WINDOW_S = 1.0
"""[s] Over the latest frames a target may fall behind by the ratio that it has to lead by."""


class Explanation:
    """Log of the Bayes factor of a target against something else.

    Attributes
    ----------
    log_ratio : float
        Over the whole track.
    """

    def __init__(self) -> None:
        self.log_ratio = 0.0
        self._largest = -np.inf
        self._behind_since_ns: int | None = None
        self._recent: deque[tuple[int, float]] = deque()

    def add(self, log_ratio: float, stamp_ns: int) -> None:
        """Count a frame: its log-density with a target less that with something else."""
        self.log_ratio += log_ratio
        self._largest = max(self._largest, self.log_ratio)
        self._recent.append((stamp_ns, log_ratio))
        while self._recent[0][0] < stamp_ns - WINDOW_S * NS:
            self._recent.popleft()

    def is_doubtful(self, ratio: float) -> bool:
        """Whether a target does not explain the frames `ratio` times better than something else."""
        least = float(np.log(ratio))
        latest = sum(value for _, value in self._recent)
        return self.log_ratio < least or latest < -least

    def unexplained_s(self, ratio: float, stamp_ns: int) -> float:
        """[s] for which something else has explained the track `ratio` times better.

        0 where a target once did: it may have stopped, and is then as smooth as anything. To be
        asked with every frame.
        """
        least = float(np.log(ratio))
        if self.log_ratio > -least or self._largest >= least:
            self._behind_since_ns = None
            return 0.0
        if self._behind_since_ns is None:
            self._behind_since_ns = stamp_ns
        return (stamp_ns - self._behind_since_ns) / NS
