"""Clock offset between two sensors from knocks that both measure."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.optimize import minimize_scalar
from scipy.signal import correlate, find_peaks

from mag_tracking.arrays import BoolArray, FloatArray

KNOCK_THRESHOLD = 10.0
"""Minimum size of a knock in standard deviations of the signal at rest."""

MIN_CORRELATION = 0.7
"""Minimum correlation of two sensors that measured the same knocks."""

MIN_RIVAL_RATIO = 0.9
"""A second lag whose correlation exceeds this share of the best one makes the lag ambiguous."""

CONTEXT_S = 5.0
"""[s] Interval before the first and after the last knock that is compared in a long recording; it
contains the signal at rest."""

MARGIN_S = 0.1
"""[s] Interval before and after a knock that is compared."""

_Series: TypeAlias = tuple[FloatArray, FloatArray]
"""Times (n,) [s] and values (n,)."""


@dataclass(frozen=True)
class Lag:
    """Clock offset of one sensor relative to another."""

    offset: float
    """[s]; NaN if there is a reason."""
    std: float
    """[s]"""
    correlation: float
    """Correlation at that lag, 0 to 1; NaN if a sensor measured no knock."""
    reason: str
    """Why there is no lag; empty if there is one."""


def _no_lag(reason: str, correlation: float = float('nan')) -> Lag:
    """A `Lag` without a value."""
    return Lag(float('nan'), float('nan'), correlation, reason)


def shock(acceleration: FloatArray) -> FloatArray:
    """Deviation of an acceleration from rest, independent of the orientation of the sensor.

    Parameters
    ----------
    acceleration : (n, 3) array, m/s²

    Returns
    -------
    (n,) array, m/s²
    """
    a = np.asarray(acceleration, dtype=float)
    size = np.linalg.norm(a - np.nanmedian(a, axis=0), axis=1)
    beyond_rest: FloatArray = size - np.nanmedian(size)
    return beyond_rest


def knock_lag(t_reference: FloatArray, reference: FloatArray, t: FloatArray, signal: FloatArray,
              max_lag: float) -> Lag:
    """Clock offset of a sensor relative to a reference, from knocks that both measured.

    The lag with the largest correlation is refined below the sampling interval by least squares,
    which also gives the standard deviation.

    Parameters
    ----------
    t_reference : (n,) array, s
        Increasing times by the clock of the reference.
    reference : (n,) array
        Shock of the reference, see `shock`.
    t : (m,) array, s
        Increasing times by the clock of the sensor, relative to the same zero.
    signal : (m,) array
        Shock of the sensor.
    max_lag : float, s
        Maximum size of the offset.

    Returns
    -------
    Lag
        Positive if the sensor's timestamps are later.

    Raises
    ------
    ValueError
        If times and values have different shapes, or times do not increase.

    References
    ----------
    [T10]_ section 6.3 for the correlation of the accelerometers.
    """
    a, b = _series(t_reference, reference, 'reference'), _series(t, signal, 'sensor')
    a, b = _without_cut_knocks(*a), _without_cut_knocks(*b)
    apart = _separation(a, b, max_lag)
    if apart is not None:
        return _no_lag(f'the knocks are {apart:.3g} s apart, maximum {max_lag:g} s')
    a, b = _around_knocks(a, b, max_lag), _around_knocks(b, a, max_lag)
    for name, (_, s) in (('reference', a), ('sensor', b)):
        if len(s) < 8 or not _is_knock(s).any():
            return _no_lag(f'the {name} measured no knock')
    lag, correlation, reason = _coarse(a, b, max_lag)
    if reason:
        return _no_lag(reason, correlation)
    # The series with the higher rate is interpolated.
    if _step(*a) <= _step(*b):
        offset, std = _fine(a, b, lag)
    else:
        offset, std = _fine(b, a, -lag)
        offset = -offset
    if not abs(offset) <= max_lag:
        return _no_lag(f'the knocks are {offset:.3f} s apart, maximum {max_lag:g} s', correlation)
    return Lag(offset, std, correlation, '')


def _series(t: FloatArray, s: FloatArray, name: str) -> _Series:
    """Arrays (t, s) without NaN."""
    t, s = np.asarray(t, dtype=float), np.asarray(s, dtype=float)
    if t.shape != s.shape or t.ndim != 1:
        raise ValueError(f'the {name} has times of shape {t.shape} for values of shape {s.shape}')
    good = ~np.isnan(s)
    t, s = t[good], s[good]
    if (np.diff(t) <= 0.0).any():
        raise ValueError(f'the times of the {name} do not increase')
    return t, s


def _without_cut_knocks(t: FloatArray, s: FloatArray) -> _Series:
    """The series without a knock that is cut off at its beginning or end."""
    if len(s) < 8:
        return t, s
    loud = _is_knock(s)
    for _ in range(2):
        if loud[t <= t[0] + MARGIN_S].any():
            # The knock ends where the signal has been quiet for MARGIN_S.
            ends = np.flatnonzero(np.diff(np.append(t[loud], np.inf)) > MARGIN_S)
            keep = t > t[loud][ends[0]]
            t, s, loud = t[keep], s[keep], loud[keep]
        t, s, loud = -t[::-1], s[::-1], loud[::-1]
        if not len(t):
            break
    return t, s


def _separation(a: _Series, b: _Series, max_lag: float) -> float | None:
    """Smallest distance [s] of knocks of two series if it exceeds `max_lag`, else None."""
    if not (len(a[1]) > 7 and len(b[1]) > 7 and _is_knock(a[1]).any() and _is_knock(b[1]).any()):
        return None
    s, t = a[0][_is_knock(a[1])], b[0][_is_knock(b[1])]
    after = np.clip(np.searchsorted(t, s), 0, len(t) - 1)
    distance = np.minimum(np.abs(t[after] - s), np.abs(t[np.maximum(after - 1, 0)] - s)).min()
    return float(distance) if distance > max_lag + MARGIN_S else None


def _around_knocks(a: _Series, b: _Series, max_lag: float) -> _Series:
    """Part of series `a` around the knocks of `b`."""
    if len(b[1]) < 8 or not _is_knock(b[1]).any():
        return a
    first, last = _event_times(*b)
    near = (a[0] >= first - max_lag - CONTEXT_S) & (a[0] <= last + max_lag + CONTEXT_S)
    return a[0][near], a[1][near]


def _is_knock(s: FloatArray) -> BoolArray:
    """Whether a signal exceeds its level at rest, (n,)."""
    rest = 1.4826 * np.median(np.abs(s - np.median(s)))
    loud: BoolArray = s > KNOCK_THRESHOLD * max(rest, 1e-3)
    return loud


def _event_times(t: FloatArray, s: FloatArray) -> tuple[float, float]:
    """Times (first, last) of knocks."""
    loud = t[_is_knock(s)]
    return loud[0], loud[-1]


def _step(t: FloatArray, s: FloatArray) -> float:
    """Sampling interval [s] around the knocks."""
    first, last = _event_times(t, s)
    near = (t >= first - MARGIN_S) & (t <= last + MARGIN_S)
    return float(np.median(np.diff(t[near]))) if np.count_nonzero(near) > 2 else float('inf')


def _coarse(a: _Series, b: _Series, max_lag: float) -> tuple[float, float, str]:
    """Lag to a fraction of a sample, correlation and reason."""
    step = 0.5 * min(_step(*a), _step(*b))
    if not np.isfinite(step):
        return float('nan'), float('nan'), 'the knock is shorter than the sampling interval'
    firsts, lasts = zip(_event_times(*a), _event_times(*b), strict=True)
    grid = np.arange(min(firsts) - max_lag, max(lasts) + max_lag + step, step)
    u, v = (np.interp(grid, t, s, left=0.0, right=0.0) for t, s in (a, b))
    c = correlate(v, u, method='auto') / np.sqrt((u @ u) * (v @ v))
    lags = step * np.arange(1 - len(u), len(v))
    # The margin excludes maxima on the border.
    within = np.abs(lags) <= max_lag + 4.0 * step
    c, lags = c[within], lags[within]
    best = int(c.argmax())
    if c[best] < MIN_CORRELATION:
        return lags[best], float(c[best]), (
            f'the two sensors did not measure the same knocks within {max_lag:g} s '
            f'(correlation {c[best]:.2f})')
    others = [k for k in find_peaks(c)[0] if abs(k - best) > 2 and c[k] > MIN_RIVAL_RATIO * c[best]]
    if others:
        return lags[best], float(c[best]), (
            f'lags of {lags[best]:.3f} and {lags[others[0]]:.3f} s fit equally well: knock again, '
            'unevenly spaced')
    return float(lags[best]), float(c[best]), ''


def _fine(a: _Series, b: _Series, lag: float) -> tuple[float, float]:
    """Offset and standard deviation [s] of the best fit of `a`, interpolated and scaled, to `b`."""
    offset, std = _fitted(a, b, lag, PchipInterpolator(*a, extrapolate=False))
    # The signal between two readings is unknown; a second interpolation estimates its effect.
    other, _ = _fitted(a, b, lag, CubicSpline(*a, extrapolate=False))
    return offset, float(np.hypot(std, other - offset))


def _fitted(a: _Series, b: _Series, lag: float,
            curve: PchipInterpolator | CubicSpline) -> tuple[float, float]:
    """Offset and standard deviation [s] with `curve` as the interpolated series."""
    t, s = b
    step = max(_step(*a), _step(*b))
    first, last = _event_times(*a)
    # A fixed set of readings, since a set that depends on the lag would make the sum discontinuous.
    near = (t >= first + lag - MARGIN_S) & (t <= last + lag + MARGIN_S)
    near &= (t >= a[0][0] + lag + 2.0 * step) & (t <= a[0][-1] + lag - 2.0 * step)
    t, s = t[near], s[near]

    def residual(offset: float) -> FloatArray:
        u = curve(t - offset)
        return s - (u @ s) / (u @ u) * u

    found = minimize_scalar(lambda d: np.sum(residual(d)**2), method='bounded', args=(),
                            bounds=(lag - 2.0 * step, lag + 2.0 * step),
                            options={'xatol': 1e-6})
    u, slope = curve(t - found.x), curve.derivative()(t - found.x)
    gain, square = (u @ s) / (u @ u), slope @ slope
    # The residuals are heteroscedastic: multiplicative noise and interpolation errors are largest
    # on the flanks, which determine the lag (MacKinnon and White 1985, HC3).
    residuals = residual(found.x) / np.maximum(1.0 - slope**2 / square - u**2 / (u @ u), 0.1)
    return float(found.x), float(np.sqrt(np.sum((slope * residuals)**2)) / (abs(gain) * square))
