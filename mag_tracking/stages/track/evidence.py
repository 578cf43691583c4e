"""Whether a running track is to be believed, and whether it is still there."""

import numpy as np

from mag_tracking.records import Track
from mag_tracking.stages.track.settings import TrackSettings

LONGEST_SINGLE_SENSOR_S = 0.5
"""[s] A track that one sensor of several has supported alone for longer stays ambiguous."""

LEAST_WATCHED = 0.5
"""A track that begins with less than this share of its lookback is ambiguous."""


class TrackEvidence:
    """Evidence for a target, and what speaks against its track."""

    def __init__(self, doubted: bool) -> None:
        """`doubted`: all of the track may be wrong, as the target was not seen approaching."""
        self.doubted = doubted
        self._log_odds = 0.0
        self._single_sensor_s = 0.0
        self._n_misfits = 0
        self._best_spread = np.inf

    def add(self, log_likelihood_ratio: float) -> None:
        """Count a frame: its log-likelihood with a target less that without one."""
        self._log_odds += log_likelihood_ratio

    def doubt(self) -> None:
        """From now on all of the track may be wrong."""
        self.doubted = True

    def support(self, by_one_sensor: bool, dt: float) -> None:
        """Count `dt` [s] for which one sensor of several supported the track, or more did.

        A single sensor tells neither the scale nor the mirror image, and the other sensors do not
        always correct the error when they are back.
        """
        self._single_sensor_s += dt if by_one_sensor else 0.0
        self.doubted = self.doubted or self._single_sensor_s > LONGEST_SINGLE_SENSOR_S

    @property
    def existence(self) -> float:
        """Probability that there is a target."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self._log_odds, -700.0, 700.0))))

    @property
    def is_doubtful(self) -> bool:
        """Whether the field contradicted the track at its end, or all of it may be wrong."""
        return self._n_misfits > 0 or self.doubted

    def reason_to_end(self, track: Track, settings: TrackSettings) -> str | None:
        """Why the track is over after its pose `track`; None while it goes on."""
        misfit = track.nis > settings.end_nis * track.degrees_of_freedom
        self._n_misfits = self._n_misfits + 1 if misfit else 0
        if self._n_misfits > 1:
            return 'lost its target'
        spread = float(np.trace(track.covariance[:2, :2])) ** 0.5
        if spread > settings.end_std > self._best_spread:
            return 'out of reach'
        self._best_spread = min(self._best_spread, spread)
        return None
