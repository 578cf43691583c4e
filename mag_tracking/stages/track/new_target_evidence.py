"""Criteria for comparing a track with other explanations, and for accepting an explanation."""

import numpy as np
from scipy.special import chdtrc

from mag_tracking.inference.sequential_tests import SlidingSum
from mag_tracking.units import NS

FALSE_ALARM_PROBABILITY = 1e-3
"""Probability per test that noise alone triggers a comparison with other explanations."""

WINDOW_S, MIN_INTERVAL_S = 0.25, 0.15
"""Duration of the tested frames, and minimum interval between any comparison and the next one that
improbable innovations trigger [s]."""

LONG_INTERVAL_S, INTERVAL_GROWTH = 0.3, 1.5
"""Interval after which a long vehicle is compared with two vehicles [s], and factor by which this
interval grows with each comparison."""

ACCEPT_NATS, REPEATED_NATS, UNDECIDED_NATS = 10.0, 5.0, -5.0
"""Minimum log-odds of another explanation [nats]: to be accepted at once, to be accepted in two
successive comparisons, and to mark the track as doubtful if it is not accepted."""

IMPROBABLE, LONG_VEHICLE = 'improbable innovations', 'a long vehicle'
"""Reasons to compare a track with other explanations."""


class NewTargetEvidence:
    """Decides when to compare a track with other explanations, and whether to accept one.

    A comparison is due when the latest innovations are improbable. A model of one long vehicle may
    explain two short vehicles without improbable innovations. A track of a long vehicle is
    therefore also compared at intervals.
    """

    def __init__(self) -> None:
        self._latest = SlidingSum(WINDOW_S)
        self._last_comparison_ns: int | None = None
        self._was_probable = False
        self._was_rejected = self._is_long = False
        self._long_interval_s = LONG_INTERVAL_S

    def add(self, nis: float, degrees_of_freedom: int, stamp_ns: int, rejected: bool,
            is_long: bool) -> None:
        """Add a frame with its normalised innovation squared `nis`.

        One `rejected` sensor of two triggers a comparison like improbable innovations do. With more
        sensors, the majority shows that the rejected sensor is faulty. `is_long` refers to the best
        hypothesis.
        """
        self._latest.add(stamp_ns, [nis, degrees_of_freedom])
        self._was_rejected, self._is_long = rejected, is_long

    def due(self, stamp_ns: int) -> str | None:
        """Return `IMPROBABLE` or `LONG_VEHICLE` if a comparison is due, and restart the interval;
        else None."""
        total, freedom = self._latest.total
        elapsed_s = np.inf if self._last_comparison_ns is None \
            else (stamp_ns - self._last_comparison_ns) / NS
        reason = None
        if self._was_rejected or chdtrc(max(freedom, 1.0), total) <= FALSE_ALARM_PROBABILITY:
            reason = IMPROBABLE if elapsed_s >= MIN_INTERVAL_S else None
        elif self._is_long and elapsed_s >= self._long_interval_s:
            reason = LONG_VEHICLE
            self._long_interval_s *= INTERVAL_GROWTH
        if reason is not None:
            self._last_comparison_ns = stamp_ns
        return reason

    def accepts(self, log_odds: float) -> bool:
        """Record a comparison, and return whether the other explanation, with its log-odds [nats]
        against the track, is accepted: immediately, or in two successive comparisons."""
        accepts = log_odds > ACCEPT_NATS or self._was_probable and log_odds > REPEATED_NATS
        self._was_probable = log_odds > REPEATED_NATS and not accepts
        return accepts
