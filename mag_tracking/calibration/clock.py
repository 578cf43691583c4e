"""By how much the clocks of two sensors differ, from a knock that both feel.

Source: T10 section 6.3 (correlation of the accelerometers); refined below a sample by
least squares, which also says how well it is known.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.optimize import minimize_scalar
from scipy.signal import correlate, find_peaks

from mag_tracking.arrays import BoolArray, FloatArray

LOUD = 10.0
"""A knock is above so many deviations of the rest."""

ALIKE = 0.7
"""Two sensors felt the same knocks where they correlate at least so well."""

RIVAL = 0.9
"""Another lag that correlates so well compared with the best is as likely."""

AROUND_S = 5.0
"""[s] Of a long recording only what is so near to knocks is compared; it tells what rest is."""

MARGIN_S = 0.1
"""[s] What is compared before and after a knock."""

_Series: TypeAlias = tuple[FloatArray, FloatArray]
"""Times (n,) [s] and values (n,)."""


@dataclass(frozen=True)
class Lag:
    """How far one clock is ahead of another."""

    offset: float
    """[s]; NaN where there is a reason."""
    std: float
    """[s]"""
    correlation: float
    """Of the two, at that lag, 0..1; NaN where neither was loud."""
    reason: str
    """Why there is none; empty where there is one."""


def _none(reason: str, correlation: float = float('nan')) -> Lag:
    """No lag."""
    return Lag(float('nan'), float('nan'), correlation, reason)


def shock(acceleration: FloatArray) -> FloatArray:
    """(n,) [m/s^2] how far each of the accelerations (n, 3) is from rest, in any direction.

    In any: how a sensor is turned need not be known.
    """
    a = np.asarray(acceleration, dtype=float)
    size = np.linalg.norm(a - np.nanmedian(a, axis=0), axis=1)
    beyond_rest: FloatArray = size - np.nanmedian(size)
    return beyond_rest


def knock_lag(t_reference: FloatArray, reference: FloatArray, t: FloatArray, signal: FloatArray,
              longest: float) -> Lag:
    """How far the clock of one sensor is ahead of a reference's, by knocks that both felt.

    Parameters
    ----------
    t_reference, t : (n,) and (m,) [s]
        Increasing; each by its own sensor's clock, from the same zero.
    reference, signal : (n,) and (m,)
        How much each is shaken (`shock`).
    longest : float [s]
        No lag is longer.

    Returns
    -------
    Lag
        Positive where the sensor stamps the same knock later.

    Raises ValueError where times and signals do not fit, or do not increase.
    """
    a, b = _series(t_reference, reference, 'reference'), _series(t, signal, 'sensor')
    a, b = _whole(*a), _whole(*b)
    apart = _apart(a, b, longest)
    if apart is not None:
        return _none(f'the knocks are {apart:.3g} s apart, more than {longest:g} s')
    a, b = _near(a, b, longest), _near(b, a, longest)
    for name, (_, s) in (('reference', a), ('sensor', b)):
        if len(s) < 8 or not _loud(s).any():
            return _none(f'the {name} felt no knock')
    lag, correlation, reason = _coarse(a, b, longest)
    if reason:
        return _none(reason, correlation)
    # The one with more readings is interpolated.
    if _step(*a) <= _step(*b):
        offset, std = _fine(a, b, lag)
    else:
        offset, std = _fine(b, a, -lag)
        offset = -offset
    if not abs(offset) <= longest:
        return _none(f'the knocks are {offset:.3f} s apart, more than {longest:g} s', correlation)
    return Lag(offset, std, correlation, '')


def _series(t: FloatArray, s: FloatArray, name: str) -> _Series:
    """(t, s) as arrays without NaN."""
    t, s = np.asarray(t, dtype=float), np.asarray(s, dtype=float)
    if t.shape != s.shape or t.ndim != 1:
        raise ValueError(f'the {name} has times {t.shape} for values {s.shape}')
    good = ~np.isnan(s)
    t, s = t[good], s[good]
    if (np.diff(t) <= 0.0).any():
        raise ValueError(f'the times of the {name} do not increase')
    return t, s


def _whole(t: FloatArray, s: FloatArray) -> _Series:
    """The series without a knock that it begins or ends in."""
    if len(s) < 8:
        return t, s
    loud = _loud(s)
    for _ in range(2):
        if loud[t <= t[0] + MARGIN_S].any():
            # Up to where it has been quiet for as long.
            ends = np.flatnonzero(np.diff(np.append(t[loud], np.inf)) > MARGIN_S)
            keep = t > t[loud][ends[0]]
            t, s, loud = t[keep], s[keep], loud[keep]
        t, s, loud = -t[::-1], s[::-1], loud[::-1]
        if not len(t):
            break
    return t, s


def _apart(a: _Series, b: _Series, longest: float) -> float | None:
    """[s] between the knocks of two series where all are farther apart than `longest`, or None."""
    if not (len(a[1]) > 7 and len(b[1]) > 7 and _loud(a[1]).any() and _loud(b[1]).any()):
        return None
    s, t = a[0][_loud(a[1])], b[0][_loud(b[1])]
    after = np.clip(np.searchsorted(t, s), 0, len(t) - 1)
    distance = np.minimum(np.abs(t[after] - s), np.abs(t[np.maximum(after - 1, 0)] - s)).min()
    return float(distance) if distance > longest + MARGIN_S else None


def _near(a: _Series, b: _Series, longest: float) -> _Series:
    """Series `a` from a while before the other's first knock to a while after its last."""
    if len(b[1]) < 8 or not _loud(b[1]).any():
        return a
    first, last = _event_times(*b)
    near = (a[0] >= first - longest - AROUND_S) & (a[0] <= last + longest + AROUND_S)
    return a[0][near], a[1][near]


def _loud(s: FloatArray) -> BoolArray:
    """(n,) where a signal is above its rest."""
    rest = 1.4826 * np.median(np.abs(s - np.median(s)))
    loud: BoolArray = s > LOUD * max(rest, 1e-3)
    return loud


def _event_times(t: FloatArray, s: FloatArray) -> tuple[float, float]:
    """(first, last) time of what is loud."""
    loud = t[_loud(s)]
    return loud[0], loud[-1]


def _step(t: FloatArray, s: FloatArray) -> float:
    """[s] Sampling interval where it is loud."""
    first, last = _event_times(t, s)
    near = (t >= first - MARGIN_S) & (t <= last + MARGIN_S)
    return float(np.median(np.diff(t[near]))) if np.count_nonzero(near) > 2 else float('inf')


def _coarse(a: _Series, b: _Series, longest: float) -> tuple[float, float, str]:
    """(lag, correlation, reason) to a fraction of a sample."""
    step = 0.5 * min(_step(*a), _step(*b))
    if not np.isfinite(step):
        return float('nan'), float('nan'), 'the knock is shorter than a sample'
    firsts, lasts = zip(_event_times(*a), _event_times(*b), strict=True)
    grid = np.arange(min(firsts) - longest, max(lasts) + longest + step, step)
    u, v = (np.interp(grid, t, s, left=0.0, right=0.0) for t, s in (a, b))
    c = correlate(v, u, method='auto') / np.sqrt((u @ u) * (v @ v))
    lags = step * np.arange(1 - len(u), len(v))
    # A little more than is allowed: a maximum on the border is none.
    within = np.abs(lags) <= longest + 4.0 * step
    c, lags = c[within], lags[within]
    best = int(c.argmax())
    if c[best] < ALIKE:
        return lags[best], float(c[best]), (
            f'the two do not feel the same knocks within {longest:g} s '
            f'(correlation {c[best]:.2f})')
    others = [k for k in find_peaks(c)[0] if abs(k - best) > 2 and c[k] > RIVAL * c[best]]
    if others:
        return lags[best], float(c[best]), (
            f'lags of {lags[best]:.3f} and {lags[others[0]]:.3f} s fit alike: knock once more, '
            'unevenly')
    return float(lags[best]), float(c[best]), ''


def _fine(a: _Series, b: _Series, lag: float) -> tuple[float, float]:
    """(offset, std) [s] where series `a`, interpolated, moved and scaled, fits `b` best."""
    offset, std = _fitted(a, b, lag, PchipInterpolator(*a, extrapolate=False))
    # What lies between two readings nobody knows: another curve through them says how much
    # that matters.
    other, _ = _fitted(a, b, lag, CubicSpline(*a, extrapolate=False))
    return offset, float(np.hypot(std, other - offset))


def _fitted(a: _Series, b: _Series, lag: float,
            curve: PchipInterpolator | CubicSpline) -> tuple[float, float]:
    """(offset, std) [s] with `curve` as the interpolated series."""
    t, s = b
    step = max(_step(*a), _step(*b))
    first, last = _event_times(*a)
    # The same readings throughout: a sum over others with every lag would have steps.
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
    # What is left over is largest on the flanks, where it counts: noise of a size is, and so is
    # what interpolation leaves out (MacKinnon and White 1985, HC3).
    left = residual(found.x) / np.maximum(1.0 - slope**2 / square - u**2 / (u @ u), 0.1)
    return float(found.x), float(np.sqrt(np.sum((slope * left)**2)) / (abs(gain) * square))
