"""Clock offset between two sensors, from knocks measured by both."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.optimize import minimize_scalar
from scipy.signal import correlate, find_peaks

from mag_tracking.arrays import BoolArray, FloatArray

KNOCK_THRESHOLD = 10.0
"""Minimum magnitude of a knock in standard deviations of the signal at rest."""
MIN_CORRELATION = 0.7
"""Minimum correlation of two sensors that measured the same knocks."""
MAX_RIVAL_RATIO = 0.9
"""Maximum correlation at a second lag, relative to the best one, of an unambiguous lag."""
CONTEXT_S, MARGIN_S = 5.0, 0.1
"""[s] Interval beside the first and last knock that is compared, and beside a knock."""
_Series: TypeAlias = tuple[FloatArray, FloatArray]
"""Times (n,) [s] and values (n,)."""


@dataclass(frozen=True)
class Lag:
    """Clock offset [s] of one sensor relative to another, and its std; NaN if unknown."""

    reason: str = ''
    """Reason for an unknown offset; empty if the offset is known."""
    correlation: float = float('nan')
    """Correlation at the offset, 0 to 1, even if the offset was rejected; NaN if not computed."""
    offset: float = float('nan')
    std: float = float('nan')


def shock(acceleration: FloatArray) -> FloatArray:
    """Magnitude (n,) above rest of the distance of accelerations (n, 3), m/s², from the median."""
    a = np.asarray(acceleration, dtype=float)
    magnitude = np.linalg.norm(a - np.nanmedian(a, axis=0), axis=1)
    above_rest: FloatArray = magnitude - np.nanmedian(magnitude)
    return above_rest


def knock_lag(t_reference: FloatArray, reference: FloatArray, t: FloatArray, signal: FloatArray,
              max_lag: float) -> Lag:
    """Clock offset of a sensor relative to a reference, from knocks that both measured.

    `reference` and `signal` are shocks (see `shock`) at increasing times in s since the same zero;
    `max_lag` bounds the absolute offset, which is positive if the sensor's clock is ahead. The lag
    of the largest correlation ([T10]_ section 6.3) is refined below the sampling interval by least
    squares.
    """
    a, b = _without_cut_knocks(t_reference, reference), _without_cut_knocks(t, signal)
    separation = _knock_separation(a, b, max_lag)
    if separation is not None:
        return Lag(f'the knocks are {separation:.3g} s apart, maximum {max_lag:g} s')
    a, b = _around_knocks(a, b, max_lag), _around_knocks(b, a, max_lag)
    for name, (_, s) in (('reference', a), ('sensor', b)):
        if not _has_knock(s):
            return Lag(f'the {name} measured no knock')
    lag, correlation, reason = _coarse_lag(a, b, max_lag)
    if reason:
        return Lag(reason, correlation)
    # The series with the higher rate is interpolated.
    if _sampling_interval(*a) <= _sampling_interval(*b):
        offset, std = _refined_lag(a, b, lag)
    else:
        offset, std = _refined_lag(b, a, -lag)
        offset = -offset
    if not abs(offset) <= max_lag:
        return Lag(f'the knocks are {offset:.3f} s apart, maximum {max_lag:g} s', correlation)
    return Lag('', correlation, offset, std)


def _without_cut_knocks(t: FloatArray, s: FloatArray) -> _Series:
    """Remove knocks that are cut off at the beginning or end of a series."""
    if len(s) < 8:
        return t, s
    is_loud = _is_knock(s)
    for _ in range(2):
        if is_loud[t <= t[0] + MARGIN_S].any():
            # The knock ends where the signal has been quiet for MARGIN_S.
            ends = np.flatnonzero(np.diff(np.append(t[is_loud], np.inf)) > MARGIN_S)
            is_kept = t > t[is_loud][ends[0]]
            t, s, is_loud = t[is_kept], s[is_kept], is_loud[is_kept]
        t, s, is_loud = -t[::-1], s[::-1], is_loud[::-1]
        if not len(t):
            break
    return t, s


def _knock_separation(a: _Series, b: _Series, max_lag: float) -> float | None:
    """Smallest interval [s] between knocks of two series; None if none, or within `max_lag`."""
    if not (_has_knock(a[1]) and _has_knock(b[1])):
        return None
    s, t = a[0][_is_knock(a[1])], b[0][_is_knock(b[1])]
    next_index = np.clip(np.searchsorted(t, s), 0, len(t) - 1)
    distance = np.minimum(np.abs(t[next_index] - s),
                          np.abs(t[np.maximum(next_index - 1, 0)] - s)).min()
    return float(distance) if distance > max_lag + MARGIN_S else None


def _around_knocks(a: _Series, b: _Series, max_lag: float) -> _Series:
    """Part of series `a` around the knocks of `b`; all of `a` if `b` has no knock."""
    if not _has_knock(b[1]):
        return a
    first, last = _knock_times(*b)
    is_near = (a[0] >= first - max_lag - CONTEXT_S) & (a[0] <= last + max_lag + CONTEXT_S)
    return a[0][is_near], a[1][is_near]


def _is_knock(s: FloatArray) -> BoolArray:
    """Whether each value of a signal belongs to a knock, (n,)."""
    rest_level = 1.4826 * np.median(np.abs(s - np.median(s)))
    is_loud: BoolArray = s > KNOCK_THRESHOLD * max(rest_level, 1e-3)
    return is_loud


def _has_knock(s: FloatArray) -> bool:
    """Whether a signal is long enough and contains a knock."""
    return len(s) > 7 and bool(_is_knock(s).any())


def _knock_times(t: FloatArray, s: FloatArray) -> tuple[float, float]:
    """Times [s] of the first and the last value that belong to knocks."""
    knocks = t[_is_knock(s)]
    return knocks[0], knocks[-1]


def _sampling_interval(t: FloatArray, s: FloatArray) -> float:
    """Median sampling interval [s] near the knocks; infinite for fewer than three readings."""
    first, last = _knock_times(t, s)
    is_near = (t >= first - MARGIN_S) & (t <= last + MARGIN_S)
    return float(np.median(np.diff(t[is_near]))) if np.count_nonzero(is_near) > 2 else float('inf')


def _coarse_lag(a: _Series, b: _Series, max_lag: float) -> tuple[float, float, str]:
    """Lag [s] with the largest correlation, this correlation, and the rejection reason or ''."""
    step = 0.5 * min(_sampling_interval(*a), _sampling_interval(*b))
    if not np.isfinite(step):
        return float('nan'), float('nan'), 'the knock is shorter than the sampling interval'
    firsts, lasts = zip(_knock_times(*a), _knock_times(*b), strict=True)
    grid = np.arange(min(firsts) - max_lag, max(lasts) + max_lag + step, step)
    u, v = (np.interp(grid, t, s, left=0.0, right=0.0) for t, s in (a, b))
    c = correlate(v, u, method='auto') / np.sqrt((u @ u) * (v @ v))
    lags = step * np.arange(1 - len(u), len(v))
    # The margin excludes maxima on the border.
    is_allowed = np.abs(lags) <= max_lag + 4.0 * step
    c, lags = c[is_allowed], lags[is_allowed]
    best = int(c.argmax())
    if c[best] < MIN_CORRELATION:
        return lags[best], float(c[best]), (
            f'the two sensors did not measure the same knocks within {max_lag:g} s '
            f'(correlation {c[best]:.2f})')
    rivals = [k for k in find_peaks(c)[0] if abs(k - best) > 2 and c[k] > MAX_RIVAL_RATIO * c[best]]
    if rivals:
        return lags[best], float(c[best]), (
            f'lags of {lags[best]:.3f} and {lags[rivals[0]]:.3f} s fit equally well: knock again '
            'at unevenly spaced times')
    return float(lags[best]), float(c[best]), ''


def _refined_lag(a: _Series, b: _Series, lag: float) -> tuple[float, float]:
    """Refine the `lag` of `b` relative to `a` by least squares; return the lag and its std [s]."""
    offset, std = _fitted_lag(a, b, lag, PchipInterpolator(*a, extrapolate=False))
    # The signal between two readings is unknown; a second interpolation estimates its effect.
    other_offset, _ = _fitted_lag(a, b, lag, CubicSpline(*a, extrapolate=False))
    return offset, float(np.hypot(std, other_offset - offset))


def _fitted_lag(a: _Series, b: _Series, lag: float,
                curve: PchipInterpolator | CubicSpline) -> tuple[float, float]:
    """Fit lag and scale of `curve`, an interpolation of `a`, to `b`; return the lag and std [s]."""
    t, s = b
    step = max(_sampling_interval(*a), _sampling_interval(*b))
    first, last = _knock_times(*a)
    # The set of readings is fixed: if it depended on the lag, the sum would be discontinuous.
    is_near = (t >= first + lag - MARGIN_S) & (t <= last + lag + MARGIN_S)
    is_near &= (t >= a[0][0] + lag + 2.0 * step) & (t <= a[0][-1] + lag - 2.0 * step)
    t, s = t[is_near], s[is_near]

    def residual(offset: float) -> FloatArray:
        u = curve(t - offset)
        return s - (u @ s) / (u @ u) * u

    optimum = minimize_scalar(lambda d: np.sum(residual(d)**2), method='bounded', args=(),
                              bounds=(lag - 2.0 * step, lag + 2.0 * step),
                              options={'xatol': 1e-6})
    u, slope = curve(t - optimum.x), curve.derivative()(t - optimum.x)
    gain, square = (u @ s) / (u @ u), slope @ slope
    # The residuals are heteroscedastic: multiplicative noise and interpolation errors are largest
    # on the flanks, which determine the lag (MacKinnon and White 1985, HC3).
    residuals = residual(optimum.x) / np.maximum(1.0 - slope**2 / square - u**2 / (u @ u), 0.1)
    return float(optimum.x), float(np.sqrt(np.sum((slope * residuals)**2)) / (abs(gain) * square))
