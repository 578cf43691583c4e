"""Check of a vehicle's direction by the rotation of the field at each sensor."""

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
"""[s] Maximum age of stored frames; longer than any smoothed track."""

MIN_LATERAL = 1.5
"""[m] Minimum distance of a sensor from the path. A closer sensor does not observe the
direction."""

MAX_ALONG = 12.0
"""[m] Maximum distance along the path between the crossing and the closest point of approach to a
sensor."""

WINDOW_RATIO = 3.0
"""Distance that the vehicle travels in half the window, relative to the distance between sensor and
path."""

MIN_HALF_WINDOW_S, MAX_HALF_WINDOW_S = 0.5, 4.0
"""[s] Bounds of half the duration of the window."""

MAX_LOG_ODDS = float(np.log(MAX_CONFIDENCE / (1.0 - MAX_CONFIDENCE)))
"""Largest log odds from one sensor."""


class FieldDirection:
    """Estimates, from the latest frames, the probability that a crossing direction is wrong."""

    def __init__(self, network: SensorNetwork) -> None:
        self._network = network
        self._frames: deque[FieldFrame] = deque()

    def add(self, frame: FieldFrame, since_ns: int) -> None:
        """Store a frame, and drop frames not needed for crossings from `since_ns` on.

        If time jumps back, all earlier frames are dropped.
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
            half_window_s = np.clip(WINDOW_RATIO * abs(left[j]) / speed,
                                    MIN_HALF_WINDOW_S, MAX_HALF_WINDOW_S)
            log_odds = self._log_odds(j, crossing.stamp_ns + round(along[j] / speed * NS),
                                      round(half_window_s * NS))
            if log_odds is not None:
                odds.append(float(np.clip(log_odds, -MAX_LOG_ODDS, MAX_LOG_ODDS)))
                # From a sensor to the left of the path, the vehicle moves from right to left.
                same_side.append(bool(left[j] < 0.0))
        fused = fused_log_odds(odds, same_side)
        if not odds or len(odds) > 1 and abs(fused) < 0.5 * max(map(abs, odds)):
            return float('nan')
        return float(1.0 / (1.0 + np.exp(fused)))

    def _log_odds(self, j: int, middle_ns: int, half_ns: int) -> float | None:
        """Log odds of motion from left to right as seen from sensor `j`; None if unobservable."""
        frames = [f for f in self._frames if abs(f.stamp_ns - middle_ns) <= half_ns]
        field = horizontal_field(np.array([f.field[j] for f in frames]).reshape(-1, 3),
                                 self._network.R_ws[j])
        is_measured = ~np.isnan(field).any(axis=1)
        if not is_measured.any():
            return None
        variance = [np.nanmean(np.diagonal(frames[k].covariance[j]))
                    for k in np.flatnonzero(is_measured).tolist()]
        noise = float(np.sqrt(np.median(variance)))
        rotation = rotation_of_pass(field[is_measured], noise, len(frames) // 4)
        return None if rotation is None else rotation.log_odds
