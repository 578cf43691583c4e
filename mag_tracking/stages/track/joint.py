"""Other explanations of the latest frames: when to search for them, and which to accept."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.sequential_tests import SlidingSum
from mag_tracking.stages.track.bank_filter import DETECTABLE_ENERGY, BankFilter
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.units import NS

FALSE_ALARM_PROBABILITY = 1e-3
"""Probability per test that noise alone triggers a comparison with other explanations."""
WINDOW_S, MIN_INTERVAL_S = 0.25, 0.15
"""[s] Duration of the tested frames, and minimum interval between comparisons."""
LONG_INTERVAL_S, INTERVAL_GROWTH = 0.3, 1.5
"""[s] Interval after which a long vehicle is compared with two, and its growth factor."""
ACCEPT_NATS, REPEATED_NATS, UNDECIDED_NATS = 10.0, 5.0, -5.0
"""[nats] Minimum log-odds of another explanation: to be accepted at once, to be accepted in two
successive comparisons, and to mark the track as doubtful if it is not accepted."""
IMPROBABLE, LONG_VEHICLE = 'improbable innovations', 'a long vehicle'
"""Reasons to compare a track with other explanations."""
CONFIDENT_NATS, IMPLAUSIBLE_NATS = 15.0, 60.0
"""[nats] Log-odds below which an explanation is doubtful for a limited time: high, because the
evidence treats model errors as independent between frames; and higher if a new vehicle crosses or
overtakes another, which is rarer than a flipped axis or a train with a similar field."""
CROSSING_COSINE, OVERTAKING_RATIO = 0.9, 1.8
"""Cosine of the angle below which vehicles cross, and maximum plausible speed ratio."""
MIN_MOVING_SPEED = 1.0
"""[m/s] Minimum speed of vehicles whose directions are compared."""


class NewTargetEvidence:
    """Decides when to compare a track with other explanations: if innovations are improbable, or at
    intervals, as a long vehicle may explain two short ones; and whether to accept."""

    def __init__(self) -> None:
        self._latest = SlidingSum(WINDOW_S)
        self._last_comparison_ns: int | None = None
        self._was_probable = False
        self._was_rejected = self._is_long = False
        self._long_interval_s = LONG_INTERVAL_S

    def add(self, nis: float, degrees_of_freedom: int, stamp_ns: int, rejected: bool,
            is_long: bool) -> None:
        """Add a frame with its normalised innovation squared `nis`; one `rejected` sensor of two
        (of more, the majority decides) triggers a comparison, and so does a best hypothesis that
        `is_long`."""
        self._latest.add(stamp_ns, [nis, degrees_of_freedom])
        self._was_rejected, self._is_long = rejected, is_long

    def due(self, stamp_ns: int) -> str | None:
        """Return the reason if a comparison is due, and restart the interval; else None."""
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


@dataclass(frozen=True)
class JointExplanation:
    """Joint hypotheses of all vehicles; the states of new or relocated vehicles come last."""

    bank: FilterBank
    """Hypotheses at the latest frame of the window."""
    window: Window
    """Window whose anchor contains the joint hypotheses."""
    bank_filter: BankFilter
    """Filter of the joint hypotheses."""
    log_odds: float
    """Log-odds of this explanation against the current track [nats]."""
    replaced: int | None
    """Index of the vehicle that the last vehicle, or the last two, replace, if any."""
    adds: bool
    """Whether the explanation has one vehicle more than the track."""

    def doubtful(self, n_one: int) -> tuple[int, ...]:
        """Indices of the vehicles, of `n_one` states each, that may be wrong: all if the log-odds
        are low for them; otherwise a relocated one, or two in one direction that replace one, which
        a long vehicle with large model errors resembles."""
        n = self.bank.label.shape[1] if self.bank.label.ndim > 1 else 1
        x = self.bank.x[self.bank.best()]
        velocity = np.array([x[k * n_one + 3:k * n_one + 5] for k in range(n)])
        is_implausible = self.adds and _are_implausible(velocity, 1 if self.replaced is None else 2)
        if self.log_odds < (IMPLAUSIBLE_NATS if is_implausible else CONFIDENT_NATS):
            return tuple(range(n))
        if self.replaced is None:
            return ()
        if not self.adds:
            return (n - 1,)
        return (n - 2, n - 1) if velocity[-2] @ velocity[-1] > 0.0 else ()

    def is_sensed_by_two(self) -> bool:
        """Whether at least two sensors sense each new vehicle."""
        n, best = self.bank.label.shape[1], self.bank.best()
        for i in range(n - (1 if self.replaced is None else 2), n):
            energy = sum(self.bank_filter.field_energies(i, path[best], frame) for path, frame in
                         zip(self.window.paths, self.window.frames, strict=True))
            if np.count_nonzero(energy > DETECTABLE_ENERGY) < 2:
                return False
        return True


def _are_implausible(velocity: FloatArray, n_new: int) -> bool:
    """Whether one of the last `n_new` vehicles crosses, or overtakes too fast."""
    speed = np.linalg.norm(velocity, axis=1)
    for i in range(len(velocity) - n_new, len(velocity)):
        for k in range(i):
            slower, faster = sorted((speed[i], speed[k]))
            cosine = velocity[i] @ velocity[k] / max(slower * faster, MIN_MOVING_SPEED**2)
            if slower >= MIN_MOVING_SPEED and (abs(cosine) < CROSSING_COSINE or
                                               cosine > 0.0 and faster > OVERTAKING_RATIO * slower):
                return True
    return False
