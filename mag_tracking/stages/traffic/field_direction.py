"""Check of the direction of a track by the rotation of the field at each sensor."""

from collections import deque

import numpy as np

from mag_tracking.inference.driving_direction import (
    MAX_CONFIDENCE,
    fused_log_odds,
    horizontal_field,
    rotation_of_pass,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.network.counting_line import Crossing
from mag_tracking.records import FieldFrame
from mag_tracking.units import NS

MAX_AGE_S = 70.0
"""[s] Maximum age of stored frames; more than the longest track that is smoothed."""

MIN_LATERAL = 1.5
"""[m] A sensor closer to the path than this does not observe the direction."""

MAX_ALONG = 12.0
"""[m] A sensor is not used if its closest point of approach is further than this from the
crossing."""

WINDOW_RATIO = 3.0
"""Half the window is the time in which the vehicle travels this multiple of the distance between
sensor and path."""

MIN_HALF_WINDOW_S, MAX_HALF_WINDOW_S = 0.5, 4.0
"""[s] Bounds of half the window."""

MAX_LOG_ODDS = float(np.log(MAX_CONFIDENCE / (1.0 - MAX_CONFIDENCE)))
"""Largest log odds from one sensor."""


class FieldDirection:
    """Error probability of a direction, from the latest frames.

    Parameters
    ----------
    network : SensorNetwork
    """

    def __init__(self, network: SensorNetwork) -> None:
        self._network = network
        self._frames: deque[FieldFrame] = deque()

    def add(self, frame: FieldFrame, since_ns: int) -> None:
        """Store a frame, and drop frames that no crossing needs any more.

        All frames are dropped if the time jumps back.

        Parameters
        ----------
        frame : FieldFrame
        since_ns : int, ns
            Crossings since this time may still be found.
        """
        if self._frames and frame.stamp_ns <= self._frames[-1].stamp_ns:
            self._frames.clear()
        self._frames.append(frame)
        oldest = max(since_ns - round(MAX_HALF_WINDOW_S * NS),
                     frame.stamp_ns - round(MAX_AGE_S * NS))
        while self._frames[0].stamp_ns < oldest:
            self._frames.popleft()

    def error_probability(self, crossing: Crossing) -> float:
        """Probability that the direction of a crossing is wrong.

        Parameters
        ----------
        crossing : Crossing

        Returns
        -------
        float
            NaN if the direction is not observable, or if the sensors contradict each other.
        """
        velocity = crossing.pose.velocity[:2]
        speed = float(np.hypot(*velocity))
        if not self._frames or speed < 0.1:
            return float('nan')
        u = velocity / speed
        r = self._network.positions[:, :2] - crossing.position[:2]
        along, left = r @ u, u[0] * r[:, 1] - u[1] * r[:, 0]
        odds, same_side = [], []
        for j in np.flatnonzero(
                (np.abs(left) >= MIN_LATERAL) & (np.abs(along) <= MAX_ALONG)).tolist():
            half = np.clip(WINDOW_RATIO * abs(left[j]) / speed,
                           MIN_HALF_WINDOW_S, MAX_HALF_WINDOW_S)
            found = self._log_odds(j, crossing.stamp_ns + round(along[j] / speed * NS),
                                   round(half * NS))
            if found is not None:
                odds.append(float(np.clip(found, -MAX_LOG_ODDS, MAX_LOG_ODDS)))
                # A sensor to the left of the path sees the vehicle move from right to left.
                same_side.append(bool(left[j] < 0.0))
        fused = fused_log_odds(odds, same_side)
        if not odds or len(odds) > 1 and abs(fused) < 0.5 * max(map(abs, odds)):
            return float('nan')
        return float(1.0 / (1.0 + np.exp(fused)))

    def _log_odds(self, j: int, middle_ns: int, half_ns: int) -> float | None:
        """Log odds of left to right at sensor `j`; None without two horizontal axes."""
        frames = [f for f in self._frames if abs(f.stamp_ns - middle_ns) <= half_ns]
        field = horizontal_field(np.array([f.field[j] for f in frames]).reshape(-1, 3),
                                 self._network.R_ws[j])
        known = ~np.isnan(field).any(axis=1)
        if not known.any():
            return None
        variance = [np.nanmean(np.diagonal(frames[k].covariance[j]))
                    for k in np.flatnonzero(known).tolist()]
        noise = float(np.sqrt(np.median(variance)))
        found = rotation_of_pass(field[known], noise, len(frames) // 4)
        return None if found is None else found.log_odds
