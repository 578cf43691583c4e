"""Speed and direction by when sensors feel the same: no model of the target is needed.

Two sensors that a target passes one after the other, at about the same distance, measure the same
field with a delay. Distance over delay is the speed, the sign of the delay is the direction. The
answer depends on neither moment, shape nor length of the target, and so checks track and fit.
Sensors at different sides of a road feel different fields; they have no delay, and the reason says
so.

What the sensors' clocks are apart goes into the delay, and is not in its deviation.
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
"""Fields are the same where this share of one's energy is that of the other, delayed."""

MIN_PEAK = 0.7
"""Maxima of the correlation that are lower than this share of the highest are not looked at."""

N_COARSE = 512
"""Samples of the field in which the maxima are looked for."""

SCALE_STD, GAIN_STD, TURN_STD = 0.05, 0.02, np.deg2rad(2.0)
"""How the field at one sensor may differ from that at the other: in all (the distance to the
target), of each axis (gains), and about each axis (mounting, by a careful installer)."""

MIN_DELAY = 3.0
"""A delay that is less than so many of its deviations may as well be zero."""

SMOOTHING = 0.3
"""Width of the smoothing, as a share of the time (root mean square) in which the field is seen."""

STRAYED = 4.0
"""In widths of the smoothing: a delay that moves further belongs to another maximum."""

MAX_CHANGED = 22.5
"""Chi-square of turn, scale and gains together beyond which it is another field: one in
a thousand."""

DISAGREE, SAME_SPEED = 3.0, 0.1
"""Speeds contradict each other that are apart by more deviations, and by more than this share."""

MIN_ALONG = 0.3
"""Cosine of the angle to the line of the sensors below which a target goes across it."""

MAX_READINGS = 1_000_000
"""A pass of more even times is not looked at: its timestamps are no even ones."""

MAX_PAIRS = 12
"""Pairs that are compared; the closest ones."""

FEWEST = 10
"""Readings that a sensor needs."""

_STEPS = 20


@dataclass(frozen=True)
class PairDelay:
    """Delay of the second of two sensors (rows of the network)."""

    first: int
    second: int
    delay: float
    """[s]"""
    delay_std: float
    alike: float
    """Share of the second one's energy that is the first one's field."""


@dataclass(frozen=True)
class CorrelatedMotion:
    """The velocity that the delays between sensors tell, or the reason why they tell none."""

    reason: str = 'not looked for'
    speed: float = np.nan
    """[m/s]"""
    speed_std: float = np.nan
    heading: float = np.nan
    """[rad] anticlockwise from x."""
    heading_std: float = np.nan
    """NaN: the sensors are on one line, and the target is taken to go along it."""
    alike: float = np.nan
    """The largest `alike` of all pairs that were compared."""
    pairs: tuple[PairDelay, ...] = ()


def correlated_motion(data: PassData) -> CorrelatedMotion:
    """The velocity of a target by the delays between the sensors that it passed.

    Parameters
    ----------
    data : PassData
        Around one pass.

    Returns
    -------
    CorrelatedMotion
    """
    if len(data.sensors) < 2:
        return CorrelatedMotion('one sensor: there is no delay')
    found = [d for d in (_pair_delay(data, i, j) for i, j in _pairs(data)) if d is not None]
    if not found:
        return CorrelatedMotion('no two sensors beside each other have readings of a field, and an '
                                'axis, in common')
    best = max(d.alike for d in found)
    alike = tuple(d for d in found if d.alike >= MIN_CORRELATION)
    if not alike:
        return CorrelatedMotion(f'the sensors feel different fields ({max(best, 0.0):.0%} alike): '
                                'none is behind another on the way', alike=best)
    if all(abs(d.delay) < MIN_DELAY * d.delay_std for d in alike):
        return CorrelatedMotion('the sensors feel the same at the same time', alike=best,
                                pairs=alike)
    return _motion(data, alike, best)


def disagree(speed: tuple[float, float], heading: tuple[float, float],
             delay: CorrelatedMotion) -> bool:
    """Whether a speed [m/s] and a heading [rad], with their deviations, contradict the delays.

    Across the line of the sensors a target that goes obliquely has a shorter delay. Where it goes
    nearly at right angles to it, or something is not known, nothing is contradicted.
    """
    if delay.reason or not np.isfinite([*speed, *heading]).all():
        return False
    off = abs(np.angle(np.exp(1j * (heading[0] - delay.heading))))
    if off > 0.5 * np.pi:
        return bool(off - 0.5 * np.pi > DISAGREE * heading[1])
    along = np.cos(off) if np.isnan(delay.heading_std) else 1.0
    if along < MIN_ALONG:
        return False
    # What the delay would be as a speed, and how far the heading makes that uncertain.
    std = np.hypot(speed[1], speed[0] * np.tan(off) * heading[1]) / along
    apart = abs(speed[0] / along - delay.speed)
    return bool(apart > DISAGREE * np.hypot(std, delay.speed_std)
                and apart > SAME_SPEED * delay.speed)


def _pairs(data: PassData) -> list[tuple[int, int]]:
    """The closest pairs of sensors."""
    place = data.network.positions[:, :2]
    pairs = list(combinations(data.sensors.tolist(), 2))
    apart = np.array([np.linalg.norm(place[i] - place[j]) for i, j in pairs])
    nearest = [k for k in np.argsort(apart, kind='stable') if apart[k] > MIN_DELAY_BASELINE]
    return [pairs[k] for k in nearest[:MAX_PAIRS]]


def _motion(data: PassData, pairs: Sequence[PairDelay], alike: float) -> CorrelatedMotion:
    """The velocity whose delays are those of the pairs."""
    place = data.network.positions[:, :2]
    d = np.array([place[p.second] - place[p.first] for p in pairs])
    tau, std = (np.array([getattr(p, n) for p in pairs]) for n in ('delay', 'delay_std'))
    _, size, Vt = np.linalg.svd(d / std[:, None], full_matrices=False)
    on_line = len(size) < 2 or size[1] < 0.1 * size[0]
    A = d @ Vt[:1].T if on_line else d
    covariance = np.linalg.inv((A / std[:, None] ** 2).T @ A)
    slowness = covariance @ (A.T @ (tau / std**2))
    rest, freedom = (tau - A @ slowness) / std, len(tau) - A.shape[1]
    # Delays that contradict each other have larger errors than they say.
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
                            float(np.arctan2(vector[1], vector[0])), heading_std, alike,
                            tuple(pairs))


class _Series:
    """The readings of one sensor, smoothed, in the axes of the world (or its own)."""

    def __init__(self, data: PassData, j: int, R: FloatArray, axes: IntArray) -> None:
        mine = data.sensor == j
        field = data.field[mine]
        whole = np.isfinite(field[:, axes]).all(axis=1)
        self.t = data.t[mine][whole]
        self.field = (field[whole] @ R.T if len(axes) == 3 else field[whole])[:, axes]
        # A frame that is missing has no noise either.
        variance = np.einsum('nii->ni', data.covariance[mine][whole])[:, axes]
        self.noise = float(np.sqrt(variance.min(axis=0).mean())) if whole.any() else 0.0

    def smoothed(self, t: FloatArray, width: float) -> FloatArray:
        """(n, k) at even times `t` (n,), by a normal curve of a `width` [s]."""
        # It takes a quarter of a second to import, and a replay hardly needs it.
        from scipy.ndimage import gaussian_filter1d

        even = np.stack([np.interp(t, self.t, v) for v in self.field.T], axis=1)
        smooth: FloatArray = gaussian_filter1d(even, width / (t[1] - t[0]), axis=0)
        return smooth


@dataclass(frozen=True)
class _Pair:
    """Two smoothed series at the same even times; a delay is not changed by the smoothing."""

    t: FloatArray
    first: FloatArray
    """(n, k) [T]"""
    slope: FloatArray
    """(n, k) [T/s] of the first."""
    second: FloatArray
    width: float
    """[s] of the smoothing."""
    noise: float
    """[T] of the difference of two readings that move."""

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Field and slope (n, k) of the first one at times `t` (n,)."""
        field, slope = (np.stack([np.interp(t, self.t, v) for v in values.T], axis=1)
                        for values in (self.first, self.slope))
        return field, slope


def _pair_of(data: PassData, i: int, j: int) -> _Pair | None:
    """Both sensors at the times that both have; None where they have no axes in common."""
    seen = [~np.isnan(data.field[data.sensor == k]).all(axis=0) for k in (i, j)]
    R = data.network.R_ws
    axes = np.flatnonzero(seen[0] & seen[1])
    if not len(axes) or len(axes) < 3 and not np.allclose(R[i], R[j], atol=TURN_STD):
        return None
    first, second = _Series(data, i, R[i], axes), _Series(data, j, R[j], axes)
    if min(len(first.t), len(second.t)) < FEWEST or not min(first.noise, second.noise) > 0.0:
        return None
    begin, end = max(first.t[0], second.t[0]), min(first.t[-1], second.t[-1])
    step = min(float(np.median(np.diff(s.t))) for s in (first, second))
    if not 0.0 < step * FEWEST < end - begin < step * MAX_READINGS:
        return None
    t = np.arange(begin, end, step)
    energy = np.square(first.smoothed(t, step) - np.median(first.field, axis=0)).sum(axis=1)
    if not energy.max() > 0.0:
        return None
    # The quiet part of a long window is not what is seen.
    energy = np.where(energy > 0.1 * energy.max(), energy, 0.0)
    energy /= energy.sum()
    width = max(step, SMOOTHING * float(np.sqrt(energy @ np.square(t - energy @ t))))
    smooth = first.smoothed(t, width)
    return _Pair(t, smooth, np.gradient(smooth, t, axis=0), second.smoothed(t, width), width,
                 float(np.hypot(first.noise, second.noise)))


def _pair_delay(data: PassData, i: int, j: int) -> PairDelay | None:
    """The delay of sensor `j` behind `i`; None where they have no axes in common."""
    pair = _pair_of(data, i, j)
    if pair is None:
        return None
    try:
        fits = [_refined(pair, tau) for tau in _maxima(pair)]
    except np.linalg.LinAlgError:
        # Where the first one does not change the delay is arbitrary.
        return None
    delay, std, alike = max(fits, key=lambda fit: fit[2])
    return PairDelay(i, j, delay, std, alike)


def _maxima(pair: _Pair) -> list[float]:
    """[s] Delays of the highest maxima of the correlation."""
    every = max(1, len(pair.t) // N_COARSE)
    step = every * (pair.t[1] - pair.t[0])
    a, b = (y[::every] - np.median(y, axis=0) for y in (pair.first, pair.second))
    c = np.sum([np.correlate(y, x, 'full') for x, y in zip(a.T, b.T, strict=True)], axis=0)
    inner = np.flatnonzero((c[1:-1] >= c[:-2]) & (c[1:-1] > c[2:])) + 1
    high = sorted(inner[c[inner] >= MIN_PEAK * c.max()], key=lambda k: -c[k])[:5]
    return [float((k - (len(a) - 1)) * step) for k in high] or [0.0]


def _refined(pair: _Pair, tau: float) -> tuple[float, float, float]:
    """(delay, its deviation, share of the second one's energy), from a first delay [s].

    Gauss and Newton's steps on the delay, a background, a turn, a scale and gains: what the
    second sensor measured is the first one's field, turned and scaled a little, and delayed.
    """
    k = pair.second.shape[1]
    theta = np.concatenate([[tau], np.zeros(2 * k + 3)])
    prior = np.zeros((len(theta), len(theta)))
    prior[1 + k:4 + k, 1 + k:4 + k] = np.eye(3) / TURN_STD**2
    prior[4 + k:, 4 + k:] = np.linalg.inv(SCALE_STD**2 * np.ones((k, k)) + GAIN_STD**2 * np.eye(k))
    # As far apart as the smoothing is wide the samples are nearly independent.
    every = max(1, round(2.0 * pair.width / (pair.t[1] - pair.t[0])))
    here = (pair.t > pair.t[0] + max(tau, 0.0)) & (pair.t < pair.t[-1] + min(tau, 0.0))
    t, y = pair.t[here][::every], pair.second[here][::every]
    freedom = y.size - len(theta)
    rest = np.median(pair.second, axis=0)
    size = np.linalg.norm(y - rest)
    whole = np.linalg.norm(pair.second[::every] - rest)
    if freedom <= 0 or not size > 0.0 or size < MIN_CORRELATION * whole:
        # So late that hardly anything of the one is left to compare with the other.
        return tau, np.inf, 0.0
    std = size / np.sqrt(y.size)
    for _ in range(_STEPS):
        left, J = _left(pair, t, y, theta)
        # What is left over is what the two do not have in common. Smoothing makes noise smaller
        # but not the error of a coarse sensor's steps.
        std = max(float(np.linalg.norm(left)) / np.sqrt(freedom), pair.noise, 1e-6 * size)
        information = J.T @ J / std**2 + prior
        step = np.linalg.solve(information, J.T @ left / std**2 - prior @ theta)
        theta = theta + step
        if abs(theta[0] - tau) > pair.t[-1] - pair.t[0]:
            # Diverged, and soon beyond all numbers.
            return tau, np.inf, 0.0
        if abs(step[0]) < 1e-6 * pair.width:
            break
    if abs(theta[0] - tau) > STRAYED * pair.width or theta @ prior @ theta > MAX_CHANGED:
        return tau, np.inf, 0.0
    left, J = _left(pair, t, y, theta)
    return (float(theta[0]), _delay_std(t, J / std, left / std, prior),
            1.0 - max(0.0, float(left @ left) - freedom * pair.noise**2) / float(size**2))


def _delay_std(t: FloatArray, J: FloatArray, left: FloatArray, prior: FloatArray) -> float:
    """[s] Deviation of the delay, with what the two fields do not have in common."""
    covariance: FloatArray = np.linalg.inv(J.T @ J + prior).astype(np.float64)
    shape = len(t), len(left) // len(t)
    covariance += model_error_covariance([t], [J.reshape(*shape, -1)], [left.reshape(shape)],
                                      covariance)
    return float(np.sqrt(covariance[0, 0]))


def _left(pair: _Pair, t: FloatArray, y: FloatArray,
          theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residual (n k,) [T] and derivatives (n k, n_theta)."""
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
