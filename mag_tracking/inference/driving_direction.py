"""Driving direction from the sense of rotation of a target's horizontal field.

Viewed from the sensor, a target that moves from left to right rotates the field clockwise, and a
target that moves from right to left rotates it anticlockwise, whatever the moment of the target.
This is exact for a target at the height of the sensor. A sensor in the lane does not observe the
direction.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr, ndtr

from mag_tracking.arrays import FloatArray

LAG_FRACTION = 0.35
"""Default lag as a fraction of the full width at half maximum of the signal energy; near the
optimum for passes at constant speed (PHD15 Paper B eq. (19))."""
MIN_SAMPLES = 8
"""Minimum number of samples in a window."""
MAX_CONFIDENCE = 0.98
"""Upper limit of the probability of a direction. The sign of the correlation is exact only for a
target at the height of the sensor. For 0.6 % of random moments, the field rotates in the opposite
direction if the target is above the sensor by half its lateral distance, and for 2.2 % if it is
above by the whole distance."""
MAX_VERTICAL_COSINE = 0.2
"""Maximum direction cosine to a horizontal axis of a missing axis that counts as vertical."""


class FieldRotation(NamedTuple):
    """Statistic of the sense of rotation of a field, treated as normally distributed."""

    correlation: float
    """Correlation of the horizontal axes, T²; negative for a target moving left to right."""
    variance: float
    """Variance of the correlation, T⁴."""

    @property
    def error_probability(self) -> float:
        """Probability that the sign of the correlation is wrong; PHD15 Paper B eq. (17), (18)."""
        return float(ndtr(-abs(self.correlation) / np.sqrt(self.variance)))

    @property
    def left_to_right(self) -> float:
        """Probability that the target moves from left to right, for equal priors."""
        return float(ndtr(-self.correlation / np.sqrt(self.variance)))

    @property
    def log_odds(self) -> float:
        """Log-odds [nats] of left to right against right to left, for equal priors."""
        z = self.correlation / np.sqrt(self.variance)
        return float(log_ndtr(-z) - log_ndtr(z))


def field_rotation(field: FloatArray, noise_std: float, lag: int) -> FieldRotation:
    """Correlation of the horizontal axes at a lag, with a variance of at least that of noise alone.

    `field` (n, 2) [T] is the field in x, y (z up) without the background; its first and last `lag`
    samples must not contain the target. `noise_std` [T] is per axis. PHD15 Paper B eq. (5), (11),
    (16).
    """
    n = len(field) - 2 * lag
    if lag < 1 or n < 1:
        raise ValueError(f'lag: expected 1 to {(len(field) - 1) // 2} samples, got {lag}')
    current, delayed = field[lag:-lag], field[2 * lag:]
    correlation = float(np.sum(current[:, 0] * delayed[:, 1] - current[:, 1] * delayed[:, 0])) / lag
    floor = 2.0 * n / lag**2 * noise_std**4
    estimate = noise_std**2 / lag**2 * float(np.sum(np.square(delayed - field[:-2 * lag]))) - floor
    return FieldRotation(correlation, max(estimate, floor))


def lag_of(field: FloatArray, noise_std: float, max_lag: int) -> int:
    """Lag that matches the width of a pass, 0 if the field does not exceed the noise; `max_lag` is
    the number of samples of the window before the pass and after it."""
    window = 1 + len(field) // 20
    energy = np.convolve(np.sum(field**2, axis=1) - 2.0 * noise_std**2, np.ones(window), 'same')
    # Another target at an end of the window extends the span of strong samples, but hardly their
    # number.
    width = np.count_nonzero(energy > 0.5 * energy.max())
    if not width:
        return 0
    return int(np.clip(round(LAG_FRACTION * width), 1, max(1, min(max_lag, len(field) // 4))))


def fused_log_odds(log_odds: Iterable[float], same_side: Iterable[bool]) -> float:
    """Sum the log-odds of left to right of sensors with independent errors; left and right are
    exchanged on the other side of the road, PHD15 Paper B eq. (20)-(23)."""
    return float(sum(value if is_same_side else -value
                     for value, is_same_side in zip(log_odds, same_side, strict=True)))


def horizontal_field(field: FloatArray, R_ws: FloatArray) -> FloatArray:
    """Horizontal field (n, 2) in the world frame from readings (n, 3) in the sensor frame; a
    missing axis (NaN) that is nearly vertical is ignored."""
    out: FloatArray = np.zeros((len(field), 2))
    for a in range(3):
        missing = np.isnan(field[:, a])
        for b in range(2):
            part = R_ws[b, a] * field[:, a]
            out[:, b] += np.where(
                missing, 0.0 if abs(R_ws[b, a]) < MAX_VERTICAL_COSINE else np.nan, part)
    return out


def rotation_of_pass(field: FloatArray, noise_std: float, n_quiet: int) -> FieldRotation | None:
    """`field_rotation` at the lag that matches the width of a pass.

    None if the window is too short or the field does not exceed the noise. `n_quiet` samples of the
    window precede the pass, and as many follow it. The prior of the correlation is uniform, so the
    direction of a target below the noise is overconfident.
    """
    lag = lag_of(field, noise_std, n_quiet) if len(field) >= MIN_SAMPLES else 0
    return field_rotation(field, noise_std, lag) if lag else None
