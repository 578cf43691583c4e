"""Speed and direction of a target from the delays between sensors, without a model of the target.

Two sensors that a target passes one after the other at about the same distance measure the same
field with a delay. Distance over delay is the speed; the sign of the delay is the direction. The
result depends on neither moment, shape nor length of the target and is therefore an independent
check of tracks and fits. Sensors on different sides of a road measure different fields; there is
no delay between them, and the result contains a reason.

Offsets between the sensors' clocks add to the delay; its standard deviation does not include them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import model_error_covariance
from mag_tracking.network.sensor_network import MIN_DELAY_BASELINE

MIN_CORRELATION = 0.97
"""Minimum share of the energy of one field that the other field, delayed, must explain."""

MIN_PEAK = 0.7
"""Minimum height of a correlation maximum relative to the highest; lower maxima are ignored."""

N_COARSE = 512
"""Number of samples of the field in the search for the maxima."""

SCALE_STD, GAIN_STD, ROTATION_STD = 0.05, 0.02, np.deg2rad(2.0)
"""Prior standard deviations of the differences between the fields at two sensors: common scale
(distance to the target), gain of each axis, and rotation about each axis (mounting by a careful
installer)."""

MIN_DELAY = 3.0
"""Minimum delay in standard deviations; a smaller delay is not distinguishable from zero."""

SMOOTHING = 0.3
"""Width of the smoothing relative to the RMS duration of the field."""

MAX_SHIFT = 4.0
"""Maximum shift of a delay during the refinement, in widths of the smoothing. A larger shift
belongs to another maximum."""

MAX_PRIOR_CHI2 = 22.5
"""Maximum chi-square of rotation, scale and gains together; beyond it (probability 0.001) the
second field is a different one."""

MIN_DIFFERENCE_STDS, MIN_RELATIVE_DIFFERENCE = 3.0, 0.1
"""Two speeds contradict each other if they differ by more than this number of standard deviations,
and by more than this share."""

MIN_COSINE = 0.3
"""Minimum cosine of the angle between the heading and the line of the sensors; below it, the target
crosses the line."""

MAX_READINGS = 1_000_000
"""Maximum number of evenly spaced times of a pass. More would be due to irregular timestamps; the
pair is rejected."""

MAX_PAIRS = 12
"""Maximum number of pairs to compare; the closest ones are used."""

MIN_SAMPLES = 10
"""Minimum number of readings of each sensor."""

_STEPS = 20


@dataclass(frozen=True)
class PairDelay:
    """Delay between two sensors, given as rows of the network."""

    first: int
    second: int
    delay: float
    """Delay of the second sensor after the first [s]."""
    delay_std: float
    similarity: float
    """Share of the energy of the second field that the delayed first field explains."""


@dataclass(frozen=True)
class CorrelatedMotion:
    """Velocity from the delays between sensors, or the reason why it is missing."""

    reason: str = 'not evaluated'
    speed: float = np.nan
    """[m/s]"""
    speed_std: float = np.nan
    heading: float = np.nan
    """[rad] Anticlockwise from x."""
    heading_std: float = np.nan
    """[rad] NaN: the sensors are on one line, and the target is assumed to move along it."""
    similarity: float = np.nan
    """Largest `similarity` of the compared pairs."""
    pairs: tuple[PairDelay, ...] = ()


def correlated_motion(data: PassData) -> CorrelatedMotion:
    """Estimate the velocity of a target from the delays between the sensors that it passed.

    Parameters
    ----------
    data : PassData
        Readings around one pass.

    Returns
    -------
    CorrelatedMotion
    """
    if len(data.sensors) < 2:
        return CorrelatedMotion('one sensor: a delay needs two')
    found = [d for d in (_pair_delay(data, i, j) for i, j in _pairs(data)) if d is not None]
    if not found:
        return CorrelatedMotion('no pair of separate sensors has simultaneous readings of a field '
                                'on a common axis')
    best = max(d.similarity for d in found)
    similar = tuple(d for d in found if d.similarity >= MIN_CORRELATION)
    if not similar:
        return CorrelatedMotion(f'the sensors measure different fields (similarity '
                                f'{max(best, 0.0):.0%}): the target did not pass one after the '
                                'other at the same distance', similarity=best)
    if all(abs(d.delay) < MIN_DELAY * d.delay_std for d in similar):
        return CorrelatedMotion('the sensors measure the same field at the same time',
                                similarity=best, pairs=similar)
    return _motion(data, similar, best)


def contradicts_delays(speed: tuple[float, float], heading: tuple[float, float],
                       delay: CorrelatedMotion) -> bool:
    """Whether a speed and a heading contradict the delays between the sensors.

    A target that moves obliquely to the line of the sensors has a shorter delay than one that moves
    along it. If it moves nearly perpendicular to the line, or a value is unknown, there is no
    contradiction.

    Parameters
    ----------
    speed : (float, float), m/s
        Value and standard deviation.
    heading : (float, float), rad
        Value and standard deviation.
    delay : CorrelatedMotion

    Returns
    -------
    bool
    """
    if delay.reason or not np.isfinite([*speed, *heading]).all():
        return False
    off = abs(np.angle(np.exp(1j * (heading[0] - delay.heading))))
    if off > 0.5 * np.pi:
        return bool(off - 0.5 * np.pi > MIN_DIFFERENCE_STDS * heading[1])
    along = np.cos(off) if np.isnan(delay.heading_std) else 1.0
    if along < MIN_COSINE:
        return False
    # The speed that corresponds to the delay, and its uncertainty due to the heading.
    std = np.hypot(speed[1], speed[0] * np.tan(off) * heading[1]) / along
    apart = abs(speed[0] / along - delay.speed)
    return bool(apart > MIN_DIFFERENCE_STDS * np.hypot(std, delay.speed_std)
                and apart > MIN_RELATIVE_DIFFERENCE * delay.speed)


def _pairs(data: PassData) -> list[tuple[int, int]]:
    """Closest pairs of sensors."""
    place = data.network.positions[:, :2]
    pairs = list(combinations(data.sensors.tolist(), 2))
    apart = np.array([np.linalg.norm(place[i] - place[j]) for i, j in pairs])
    nearest = [k for k in np.argsort(apart, kind='stable') if apart[k] > MIN_DELAY_BASELINE]
    return [pairs[k] for k in nearest[:MAX_PAIRS]]


def _motion(data: PassData, pairs: Sequence[PairDelay], similarity: float) -> CorrelatedMotion:
    """Velocity that fits the delays of the pairs."""
    place = data.network.positions[:, :2]
    d = np.array([place[p.second] - place[p.first] for p in pairs])
    tau, std = (np.array([getattr(p, n) for p in pairs]) for n in ('delay', 'delay_std'))
    _, size, Vt = np.linalg.svd(d / std[:, None], full_matrices=False)
    on_line = len(size) < 2 or size[1] < 0.1 * size[0]
    A = d @ Vt[:1].T if on_line else d
    covariance = np.linalg.inv((A / std[:, None] ** 2).T @ A)
    slowness = covariance @ (A.T @ (tau / std**2))
    rest, freedom = (tau - A @ slowness) / std, len(tau) - A.shape[1]
    # Contradicting delays have larger errors than their standard deviations.
    covariance *= max(1.0, float(rest @ rest) / freedom) if freedom else 1.0
    slow = float(np.linalg.norm(slowness))
    along = slowness / slow
    slow_std = float(np.sqrt(along @ covariance @ along))
    vector = Vt[0] * along[0] if on_line else along
    heading_std = np.nan
    if not on_line:
        aside = np.array([-along[1], along[0]])
        heading_std = float(np.sqrt(aside @ covariance @ aside)) / slow
    return CorrelatedMotion('', 1.0 / slow, slow_std / slow**2,
                            float(np.arctan2(vector[1], vector[0])), heading_std, similarity,
                            tuple(pairs))


class _Series:
    """Smoothed readings of one sensor, in the world frame (or its own)."""

    def __init__(self, data: PassData, j: int, R: FloatArray, axes: IntArray) -> None:
        mine = data.sensor == j
        field = data.field[mine]
        whole = np.isfinite(field[:, axes]).all(axis=1)
        self.t = data.t[mine][whole]
        self.field = (field[whole] @ R.T if len(axes) == 3 else field[whole])[:, axes]
        # The covariance of a missing frame is missing as well.
        variance = np.einsum('nii->ni', data.covariance[mine][whole])[:, axes]
        self.noise = float(np.sqrt(variance.min(axis=0).mean())) if whole.any() else 0.0

    def smoothed(self, t: FloatArray, width: float) -> FloatArray:
        """Field (n, k) at even times `t` (n,), smoothed by a Gaussian of this width [s]."""
        # The import takes 0.25 s, and a replay rarely needs it.
        from scipy.ndimage import gaussian_filter1d

        even = np.stack([np.interp(t, self.t, v) for v in self.field.T], axis=1)
        smooth: FloatArray = gaussian_filter1d(even, width / (t[1] - t[0]), axis=0)
        return smooth


@dataclass(frozen=True)
class _Pair:
    """Two smoothed series at the same even times. Smoothing does not change the delay."""

    t: FloatArray
    """(n,) [s]"""
    first: FloatArray
    """(n, k) [T]"""
    slope: FloatArray
    """(n, k) [T/s] Derivative of the first."""
    second: FloatArray
    width: float
    """[s] Width of the smoothing."""
    noise: float
    """[T] Standard deviation of the noise of a difference of two readings."""

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Field and slope (n, k) of the first series at times `t` (n,)."""
        field, slope = (np.stack([np.interp(t, self.t, v) for v in values.T], axis=1)
                        for values in (self.first, self.slope))
        return field, slope


def _pair_of(data: PassData, i: int, j: int) -> _Pair | None:
    """Both series at their common times; None if they are not comparable."""
    seen = [~np.isnan(data.field[data.sensor == k]).all(axis=0) for k in (i, j)]
    R = data.network.R_ws
    axes = np.flatnonzero(seen[0] & seen[1])
    if not len(axes) or len(axes) < 3 and not np.allclose(R[i], R[j], atol=ROTATION_STD):
        return None
    first, second = _Series(data, i, R[i], axes), _Series(data, j, R[j], axes)
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
    # The quiet part of a long window does not belong to the pass.
    energy = np.where(energy > 0.1 * energy.max(), energy, 0.0)
    energy /= energy.sum()
    width = max(step, SMOOTHING * float(np.sqrt(energy @ np.square(t - energy @ t))))
    smooth = first.smoothed(t, width)
    return _Pair(t, smooth, np.gradient(smooth, t, axis=0), second.smoothed(t, width), width,
                 float(np.hypot(first.noise, second.noise)))


def _pair_delay(data: PassData, i: int, j: int) -> PairDelay | None:
    """Delay of sensor `j` after sensor `i`; None if they are not comparable."""
    pair = _pair_of(data, i, j)
    if pair is None:
        return None
    try:
        fits = [_refined(pair, tau) for tau in _maxima(pair)]
    except np.linalg.LinAlgError:
        # If the first field is constant, the delay is arbitrary.
        return None
    delay, std, similarity = max(fits, key=lambda fit: fit[2])
    return PairDelay(i, j, delay, std, similarity)


def _maxima(pair: _Pair) -> list[float]:
    """Delays [s] of the highest maxima of the correlation."""
    every = max(1, len(pair.t) // N_COARSE)
    step = every * (pair.t[1] - pair.t[0])
    a, b = (y[::every] - np.median(y, axis=0) for y in (pair.first, pair.second))
    c = np.sum([np.correlate(y, x, 'full') for x, y in zip(a.T, b.T, strict=True)], axis=0)
    inner = np.flatnonzero((c[1:-1] >= c[:-2]) & (c[1:-1] > c[2:])) + 1
    high = sorted(inner[c[inner] >= MIN_PEAK * c.max()], key=lambda k: -c[k])[:5]
    return [float((k - (len(a) - 1)) * step) for k in high] or [0.0]


def _refined(pair: _Pair, tau: float) -> tuple[float, float, float]:
    """Delay [s], its standard deviation [s] and the similarity, refined from a first delay.

    Gauss-Newton on delay, background, rotation, scale and gains: the second field is the first
    one, delayed and slightly rotated and scaled.
    """
    k = pair.second.shape[1]
    theta = np.concatenate([[tau], np.zeros(2 * k + 3)])
    prior = np.zeros((len(theta), len(theta)))
    prior[1 + k:4 + k, 1 + k:4 + k] = np.eye(3) / ROTATION_STD**2
    prior[4 + k:, 4 + k:] = np.linalg.inv(SCALE_STD**2 * np.ones((k, k)) + GAIN_STD**2 * np.eye(k))
    # Samples at this distance are nearly independent after the smoothing.
    every = max(1, round(2.0 * pair.width / (pair.t[1] - pair.t[0])))
    here = (pair.t > pair.t[0] + max(tau, 0.0)) & (pair.t < pair.t[-1] + min(tau, 0.0))
    t, y = pair.t[here][::every], pair.second[here][::every]
    freedom = y.size - len(theta)
    rest = np.median(pair.second, axis=0)
    size = np.linalg.norm(y - rest)
    whole = np.linalg.norm(pair.second[::every] - rest)
    if freedom <= 0 or not size > 0.0 or size < MIN_CORRELATION * whole:
        # The delay is so long that the two fields hardly overlap.
        return tau, np.inf, 0.0
    std = size / np.sqrt(y.size)
    for _ in range(_STEPS):
        left, J = _residual(pair, t, y, theta)
        # The residual is the difference of the two fields. Smoothing reduces noise, but not the
        # quantisation error of a coarse sensor.
        std = max(float(np.linalg.norm(left)) / np.sqrt(freedom), pair.noise, 1e-6 * size)
        information = J.T @ J / std**2 + prior
        step = np.linalg.solve(information, J.T @ left / std**2 - prior @ theta)
        theta = theta + step
        if abs(theta[0] - tau) > pair.t[-1] - pair.t[0]:
            # Diverged; further steps would overflow.
            return tau, np.inf, 0.0
        if abs(step[0]) < 1e-6 * pair.width:
            break
    if abs(theta[0] - tau) > MAX_SHIFT * pair.width or theta @ prior @ theta > MAX_PRIOR_CHI2:
        return tau, np.inf, 0.0
    left, J = _residual(pair, t, y, theta)
    return (float(theta[0]), _delay_std(t, J / std, left / std, prior),
            1.0 - max(0.0, float(left @ left) - freedom * pair.noise**2) / float(size**2))


def _delay_std(t: FloatArray, J: FloatArray, left: FloatArray, prior: FloatArray) -> float:
    """Standard deviation [s] of the delay, including the unexplained differences."""
    covariance: FloatArray = np.linalg.inv(J.T @ J + prior).astype(np.float64)
    shape = len(t), len(left) // len(t)
    covariance += model_error_covariance([t], [J.reshape(*shape, -1)], [left.reshape(shape)],
                                      covariance)
    return float(np.sqrt(covariance[0, 0]))


def _residual(pair: _Pair, t: FloatArray, y: FloatArray,
          theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (n k,) [T] and derivatives (n k, n_theta)."""
    k = y.shape[1]
    tau, level, turn, gain = theta[0], theta[1:1 + k], theta[1 + k:4 + k], theta[4 + k:]
    field, slope = pair.at(t - tau)
    turned = np.zeros((len(t), k, 3))
    if k == 3:
        for a in range(3):
            turned[:, :, a] = np.cross(np.eye(3)[a], field)
    moved = field + turned @ turn
    J = np.concatenate([-slope[:, :, None] * (1.0 + gain)[:, None],
                        np.broadcast_to(np.eye(k), (len(t), k, k)), turned,
                        moved[:, :, None] * np.eye(k)], axis=2)
    left = y - (1.0 + gain) * moved - level
    return left.ravel(), J.reshape(left.size, -1)
