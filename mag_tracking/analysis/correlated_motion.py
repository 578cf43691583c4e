"""Speed and direction of a target from the delays between sensors, without a model of the target.

If a target passes two sensors one after the other at about the same distance, both measure the same
field with a delay. Distance over delay is the speed; the sign of the delay is the direction. The
result does not depend on the moment, shape or length of the target and is therefore an independent
check of tracks and fits. Offsets between the sensors' clocks bias the delay and are not included in
its standard deviation.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.geometry import cross_matrix
from mag_tracking.inference.least_squares import model_error_covariance
from mag_tracking.network.sensor_network import MIN_DELAY_BASELINE
from mag_tracking.physics.bounds import ADVICE, MAX_SPEED, TOO_FAST

MIN_CORRELATION = 0.97
"""Minimum fraction of the energy of one field that is explained by the other, delayed field."""
MIN_PEAK = 0.7
"""Minimum height of a correlation maximum relative to the highest maximum."""
N_COARSE = 512
"""Number of field samples in the search for correlation maxima."""
MAX_PAIRS = 12
"""Maximum number of pairs of sensors; the closest pairs are compared."""
SCALE_STD, GAIN_STD, ROTATION_STD = 0.05, 0.02, np.deg2rad(2.0)
"""Prior standard deviations of the differences between the fields at two sensors: common scale
(distance to the target), gain of each axis, and rotation [rad] about each axis of a sensor that is
mounted carefully."""
MIN_DELAY = 3.0
"""Minimum delay in standard deviations; a smaller delay is not significant."""
RELATIVE_KERNEL_WIDTH, MAX_DELAY_SHIFT = 0.3, 4.0
"""Width of the smoothing kernel relative to the RMS duration of the field, and maximum shift of a
delay during the refinement in these widths; a larger shift leads to a different maximum."""
MAX_GAUSS_NEWTON_STEPS = 20
"""Maximum number of steps of the refinement, which usually converges earlier."""
MAX_PRIOR_CHI2 = 22.5
"""Maximum joint chi-square of rotation, scale and gains of equal fields (probability 0.001)."""
MIN_DIFFERENCE_STDS, MIN_RELATIVE_DIFFERENCE = 3.0, 0.1
"""Minimum difference of contradicting speeds: in standard deviations, and relative to the speed."""
MIN_COSINE = 0.3
"""Minimum cosine of the angle between the heading and the line through both sensors. At a smaller
cosine, the target crosses the line, and its speed is not compared."""
MIN_SAMPLES = 10
"""Minimum number of readings of each sensor."""
MAX_READINGS = 1_000_000
"""Maximum number of resampled readings of a pair. A pair that requires more, due to irregular
timestamps, is rejected."""


@dataclass(frozen=True)
class PairDelay:
    """Delay between two sensors, `first` and `second` in the network."""

    first: int
    second: int
    delay: float
    """Delay of the second sensor after the first [s]."""
    delay_std: float
    """Standard deviation of `delay` [s]."""
    similarity: float
    """Fraction of the energy of the second field that is explained by the delayed first field."""


@dataclass(frozen=True)
class CorrelatedMotion:
    """Velocity estimated from the delays between sensors, or a reason why there is no estimate."""

    reason: str = 'not evaluated'
    """Reason why there is no estimate; empty if there is an estimate."""
    speed: float = np.nan
    """[m/s]"""
    speed_std: float = np.nan
    heading: float = np.nan
    """[rad], anticlockwise from x."""
    heading_std: float = np.nan
    """NaN if the sensors are on one line, along which the target is then assumed to move."""
    similarity: float = np.nan
    """Largest `similarity` of the compared pairs."""
    pairs: tuple[PairDelay, ...] = ()
    """Pairs of sensors that measure the same field."""


def correlated_motion(data: PassData) -> CorrelatedMotion:
    """Estimate the velocity of a target from the delays between the sensors that it passed."""
    if len(data.sensors) < 2:
        return CorrelatedMotion('one sensor: a delay requires two sensors')
    positions = data.network.positions[:, :2]
    pairs = list(combinations(data.sensors.tolist(), 2))
    distance = np.array([np.linalg.norm(positions[i] - positions[j]) for i, j in pairs])
    nearest = [k for k in np.argsort(distance, kind='stable') if distance[k] > MIN_DELAY_BASELINE]
    delays = [d for d in (_estimate_delay(data, *pairs[k]) for k in nearest[:MAX_PAIRS])
              if d is not None]
    if not delays:
        return CorrelatedMotion('no pair of separate sensors has simultaneous readings of a '
                                'varying field on a common axis')
    best_similarity = max(d.similarity for d in delays)
    similar_pairs = tuple(d for d in delays if d.similarity >= MIN_CORRELATION)
    if not similar_pairs:
        return CorrelatedMotion(f'the sensors measure different fields (similarity '
                                f'{max(best_similarity, 0.0):.0%}): the target did not pass them '
                                'one after the other at the same distance',
                                similarity=best_similarity)
    if all(abs(d.delay) < MIN_DELAY * d.delay_std for d in similar_pairs):
        return CorrelatedMotion('the sensors measure the same field at the same time',
                                similarity=best_similarity, pairs=similar_pairs)
    return _fit_velocity(data, similar_pairs, best_similarity)


def contradicts_delays(speed: tuple[float, float], heading: tuple[float, float],
                       delay: CorrelatedMotion) -> bool:
    """Whether a speed and a heading, each with its std, contradict the delays between the sensors.

    On a path oblique to the line through the sensors, the delay is shorter than along the line. A
    path almost perpendicular to it, or an unknown value, never contradicts the delays. A
    significantly opposite heading always does.
    """
    if delay.reason or not np.isfinite([*speed, *heading]).all():
        return False
    angle = abs(np.angle(np.exp(1j * (heading[0] - delay.heading))))
    if angle > 0.5 * np.pi:
        return bool(angle - 0.5 * np.pi > MIN_DIFFERENCE_STDS * heading[1])
    cosine = np.cos(angle) if np.isnan(delay.heading_std) else 1.0
    if cosine < MIN_COSINE:
        return False
    # Standard deviation of the apparent speed along the line, including the heading error.
    std = np.hypot(speed[1], speed[0] * np.tan(angle) * heading[1]) / cosine
    difference = abs(speed[0] / cosine - delay.speed)
    return bool(difference > MIN_DIFFERENCE_STDS * np.hypot(std, delay.speed_std)
                and difference > MIN_RELATIVE_DIFFERENCE * delay.speed)


def _fit_velocity(data: PassData, pairs: Sequence[PairDelay],
                  similarity: float) -> CorrelatedMotion:
    """Fit a velocity to the delays of the pairs by least squares."""
    positions = data.network.positions[:, :2]
    d = np.array([positions[p.second] - positions[p.first] for p in pairs])
    tau, std = (np.array([getattr(p, n) for p in pairs]) for n in ('delay', 'delay_std'))
    _, singular_values, Vt = np.linalg.svd(d / std[:, None], full_matrices=False)
    is_collinear = len(singular_values) < 2 or singular_values[1] < 0.1 * singular_values[0]
    A = d @ Vt[:1].T if is_collinear else d
    covariance = np.linalg.inv((A / std[:, None] ** 2).T @ A)
    slowness = covariance @ (A.T @ (tau / std**2))
    residuals, dof = (tau - A @ slowness) / std, len(tau) - A.shape[1]
    # If the delays are inconsistent, their standard deviations are too small.
    covariance *= max(1.0, float(residuals @ residuals) / dof) if dof else 1.0
    norm = float(np.linalg.norm(slowness))
    if norm * MAX_SPEED < 1.0:
        return CorrelatedMotion(f'{TOO_FAST}; {ADVICE}', similarity=similarity, pairs=tuple(pairs))
    unit_slowness = slowness / norm
    norm_std = float(np.sqrt(unit_slowness @ covariance @ unit_slowness))
    direction = Vt[0] * unit_slowness[0] if is_collinear else unit_slowness
    heading_std = np.nan
    if not is_collinear:
        normal = np.array([-unit_slowness[1], unit_slowness[0]])
        heading_std = float(np.sqrt(normal @ covariance @ normal)) / norm
    return CorrelatedMotion('', 1.0 / norm, norm_std / norm**2,
                            float(np.arctan2(direction[1], direction[0])), heading_std, similarity,
                            tuple(pairs))


class _SensorReadings:
    """Readings of one sensor in the world frame, or in the sensor frame if an axis is missing."""

    def __init__(self, data: PassData, j: int, R: FloatArray, axes: IntArray) -> None:
        sensor_mask = data.sensor == j
        field = data.field[sensor_mask]
        is_complete = np.isfinite(field[:, axes]).all(axis=1)
        self.t = data.t[sensor_mask][is_complete]
        self.field = (field[is_complete] @ R.T if len(axes) == 3 else field[is_complete])[:, axes]
        # The covariance of an excluded reading may be NaN.
        variance = np.einsum('nii->ni', data.covariance[sensor_mask][is_complete])[:, axes]
        self.noise = float(np.sqrt(variance.min(axis=0).mean())) if is_complete.any() else 0.0

    def smoothed(self, t: FloatArray, width: float) -> FloatArray:
        """Field (n, k) at evenly spaced times `t` (n,), smoothed by a Gaussian of `width` [s]."""
        # Deferred: the import takes 0.25 s, and replays rarely need it.
        from scipy.ndimage import gaussian_filter1d

        resampled = np.stack([np.interp(t, self.t, v) for v in self.field.T], axis=1)
        return gaussian_filter1d(resampled, width / (t[1] - t[0]), axis=0)


@dataclass(frozen=True)
class _SmoothedPair:
    """Smoothed fields (n, k) [T] of two sensors at common times `t` (n,) [s].

    Smoothing, by a kernel of `width` [s], does not change the delay. `slope` (n, k) [T/s] is the
    derivative of `first`; `noise` [T] is the std of the difference between two readings.
    """

    t: FloatArray
    first: FloatArray
    slope: FloatArray
    second: FloatArray
    width: float
    noise: float


def _resampled_pair(data: PassData, i: int, j: int) -> _SmoothedPair | None:
    """Resample the readings of two sensors to common times; None if they are not comparable."""
    is_reported = [~np.isnan(data.field[data.sensor == k]).all(axis=0) for k in (i, j)]
    R = data.network.R_ws
    axes = np.flatnonzero(is_reported[0] & is_reported[1])
    if not len(axes) or len(axes) < 3 and not np.allclose(R[i], R[j], atol=ROTATION_STD):
        return None
    first, second = _SensorReadings(data, i, R[i], axes), _SensorReadings(data, j, R[j], axes)
    if min(len(first.t), len(second.t)) < MIN_SAMPLES or not min(first.noise, second.noise) > 0.0:
        return None
    begin, end = max(first.t[0], second.t[0]), min(first.t[-1], second.t[-1])
    step = min(float(np.median(np.diff(s.t))) for s in (first, second))
    if not 0.0 < step * MIN_SAMPLES < end - begin < step * MAX_READINGS:
        return None
    t = np.arange(begin, end, step)
    energy = np.square(first.smoothed(t, step) - np.median(first.field, axis=0)).sum(axis=1)
    if not energy.max() > 0.0:
        return None
    # Exclude the parts of a long window in which the field is weak.
    energy = np.where(energy > 0.1 * energy.max(), energy, 0.0)
    energy /= energy.sum()
    width = max(step, RELATIVE_KERNEL_WIDTH * float(np.sqrt(energy @ np.square(t - energy @ t))))
    smooth = first.smoothed(t, width)
    return _SmoothedPair(t, smooth, np.gradient(smooth, t, axis=0), second.smoothed(t, width),
                         width, float(np.hypot(first.noise, second.noise)))


def _estimate_delay(data: PassData, i: int, j: int) -> PairDelay | None:
    """Estimate the delay of sensor `j` after sensor `i`; None if they are not comparable."""
    pair = _resampled_pair(data, i, j)
    if pair is None:
        return None
    try:
        fits = [_refine_delay(pair, tau) for tau in _correlation_maxima(pair)]
    except np.linalg.LinAlgError:
        # If the first field is constant, the delay is arbitrary.
        return None
    delay, std, similarity = max(fits, key=lambda fit: fit[2])
    return PairDelay(i, j, delay, std, similarity)


def _correlation_maxima(pair: _SmoothedPair) -> list[float]:
    """Delays [s] of the highest maxima of the cross-correlation, at most five; [0.0] if none."""
    stride = max(1, len(pair.t) // N_COARSE)
    step = stride * (pair.t[1] - pair.t[0])
    a, b = (y[::stride] - np.median(y, axis=0) for y in (pair.first, pair.second))
    c = np.sum([np.correlate(y, x, 'full') for x, y in zip(a.T, b.T, strict=True)], axis=0)
    maxima = np.flatnonzero((c[1:-1] >= c[:-2]) & (c[1:-1] > c[2:])) + 1
    highest = sorted(maxima[c[maxima] >= MIN_PEAK * c.max()], key=lambda k: -c[k])[:5]
    return [float((k - (len(a) - 1)) * step) for k in highest] or [0.0]


def _refine_delay(pair: _SmoothedPair, tau: float) -> tuple[float, float, float]:
    """Refine a delay [s]; return the delay, its std [s] and the similarity.

    The second field is modelled by Gauss-Newton as the delayed first field with small rotation,
    scale and gain errors and another background. Implausible: infinite std and similarity 0.
    """
    k = pair.second.shape[1]
    theta = np.concatenate([[tau], np.zeros(2 * k + 3)])
    prior = np.zeros((len(theta), len(theta)))
    prior[1 + k:4 + k, 1 + k:4 + k] = np.eye(3) / ROTATION_STD**2
    prior[4 + k:, 4 + k:] = np.linalg.inv(SCALE_STD**2 * np.ones((k, k)) + GAIN_STD**2 * np.eye(k))
    # Samples at this spacing are nearly independent after the smoothing.
    stride = max(1, round(2.0 * pair.width / (pair.t[1] - pair.t[0])))
    is_overlap = (pair.t > pair.t[0] + max(tau, 0.0)) & (pair.t < pair.t[-1] + min(tau, 0.0))
    t, y = pair.t[is_overlap][::stride], pair.second[is_overlap][::stride]
    dof = y.size - len(theta)
    background = np.median(pair.second, axis=0)
    norm = np.linalg.norm(y - background)
    total_norm = np.linalg.norm(pair.second[::stride] - background)
    if dof <= 0 or not norm > 0.0 or norm < MIN_CORRELATION * total_norm:
        # With such a long delay, the two fields hardly overlap.
        return tau, np.inf, 0.0
    std = norm / np.sqrt(y.size)
    for _ in range(MAX_GAUSS_NEWTON_STEPS):
        residuals, J = _residuals(pair, t, y, theta)
        # Smoothing reduces noise, but not the quantisation error of a coarse sensor.
        std = max(float(np.linalg.norm(residuals)) / np.sqrt(dof), pair.noise, 1e-6 * norm)
        information = J.T @ J / std**2 + prior
        step = np.linalg.solve(information, J.T @ residuals / std**2 - prior @ theta)
        theta = theta + step
        if abs(theta[0] - tau) > pair.t[-1] - pair.t[0]:
            # The fit has diverged; more steps would overflow.
            return tau, np.inf, 0.0
        if abs(step[0]) < 1e-6 * pair.width:
            break
    if abs(theta[0] - tau) > MAX_DELAY_SHIFT * pair.width or theta @ prior @ theta > MAX_PRIOR_CHI2:
        return tau, np.inf, 0.0
    residuals, J = _residuals(pair, t, y, theta)
    return (float(theta[0]), _delay_std(t, J / std, residuals / std, prior),
            1.0 - max(0.0, float(residuals @ residuals) - dof * pair.noise**2) / float(norm**2))


def _delay_std(t: FloatArray, J: FloatArray, residuals: FloatArray, prior: FloatArray) -> float:
    """Standard deviation [s] of the delay, including the effect of model errors."""
    covariance: FloatArray = np.linalg.inv(J.T @ J + prior).astype(np.float64)
    shape = len(t), len(residuals) // len(t)
    covariance += model_error_covariance([t], [J.reshape(*shape, -1)], [residuals.reshape(shape)],
                                         covariance)
    return float(np.sqrt(covariance[0, 0]))


def _residuals(pair: _SmoothedPair, t: FloatArray, y: FloatArray,
               theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (n k,) [T] of the second field `y`, and derivatives of its model by `theta`."""
    k = y.shape[1]
    tau, background, angles, gain = theta[0], theta[1:1 + k], theta[1 + k:4 + k], theta[4 + k:]
    field, slope = (np.stack([np.interp(t - tau, pair.t, v) for v in values.T], axis=1)
                    for values in (pair.first, pair.slope))
    by_angle = -cross_matrix(field) if k == 3 else np.zeros((len(t), k, 3))
    rotated = field + by_angle @ angles
    J = np.concatenate([-slope[:, :, None] * (1.0 + gain)[:, None],
                        np.broadcast_to(np.eye(k), (len(t), k, k)), by_angle,
                        rotated[:, :, None] * np.eye(k)], axis=2)
    residuals = y - (1.0 + gain) * rotated - background
    return residuals.ravel(), J.reshape(residuals.size, -1)
