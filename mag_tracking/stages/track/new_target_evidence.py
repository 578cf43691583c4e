"""When a track is compared with other explanations of its frames, and which are believed."""

import numpy as np
from scipy.special import chdtrc

from mag_tracking.inference.sliding_sum import SlidingSum
from mag_tracking.units import NS

FALSE_ALARM = 1e-3
"""Probability below which the latest innovations are not noise, so that a new target is
sought."""

WINDOW_S, AGAIN_S = 0.25, 0.15
"""[s] The latest frames; and at least so much time is between two searches."""

LONG_AGAIN_S, LONGER = 0.3, 1.5
"""[s] A long vehicle is compared with two so long after the last comparison; then after so many
times as long."""

MIN_NATS, AGAIN_NATS, UNDECIDED_NATS = 10.0, 5.0, -5.0
"""Another explanation is believed if the frames are so much more probable with it; or, if less, by
two comparisons in turn. If they are not much less probable with it, the track is in doubt."""

ODD, LONG = 'improbable innovations', 'a long vehicle'
"""Why a track is compared with other explanations."""


class NewTargetEvidence:
    """Whether a track is to be compared with one of a vehicle more.

    That is so where the latest innovations are improbable. A long vehicle explains two short ones
    without any; it is compared from time to time.
    """

    def __init__(self) -> None:
        self._latest = SlidingSum(WINDOW_S)
        self._last_ns: int | None = None
        self._was_probable = False
        self._was_rejected = self._is_long = False
        self._long_wait_s = LONG_AGAIN_S

    def add(self, nis: float, degrees_of_freedom: int, stamp_ns: int, rejected: bool,
            is_long: bool) -> None:
        """Count a frame.

        Parameters
        ----------
        nis : float
            Normalised innovation squared.
        degrees_of_freedom : int
        stamp_ns : int
        rejected : bool
            One of two sensors was left out, which is as good as a large innovation. Where more
            agree, it is the sensor that is wrong.
        is_long : bool
            The best hypothesis is a long vehicle.
        """
        self._latest.add(stamp_ns, [nis, degrees_of_freedom])
        self._was_rejected, self._is_long = rejected, is_long

    def due(self, stamp_ns: int) -> str | None:
        """`ODD` or `LONG` if the track is to be compared now, else None."""
        total, freedom = self._latest.total
        since = np.inf if self._last_ns is None else (stamp_ns - self._last_ns) / NS
        reason = None
        if self._was_rejected or chdtrc(max(freedom, 1.0), total) <= FALSE_ALARM:
            reason = ODD if since >= AGAIN_S else None
        elif self._is_long and since >= self._long_wait_s:
            reason = LONG
            self._long_wait_s *= LONGER
        if reason is not None:
            self._last_ns = stamp_ns
        return reason

    def believes(self, log_odds: float) -> bool:
        """Whether another explanation is believed, given those compared before."""
        believes = log_odds > MIN_NATS or self._was_probable and log_odds > AGAIN_NATS
        self._was_probable = log_odds > AGAIN_NATS and not believes
        return believes
