"""Closest point and direction of a pass from one sensor, without any scale."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from mag_tracking.arrays import FloatArray
from mag_tracking.physics.anderson import anderson_residual
from mag_tracking.records import plain

MAX_SAMPLES = 200
"""A pass is averaged to so many samples before the closest point is sought."""

MAX_STARTS = 5
"""The best points of a grid from which the closest point is sought: one axis has several optima."""

CORRELATED = 2.0
"""[time scales] Correlation time of the residual of a vehicle that is fitted by a dipole."""

OFF_CENTRE = 0.15
"""[time scales] The magnetic centre of a vehicle is so far from the middle of its body."""


class ClosestPoint(NamedTuple):
    """The closest point of a pass, seen by one sensor."""

    time: float
    """[s]; time of the largest field where the closest point is not determined."""
    time_std: float
    """[s]; inf where the closest point is not determined."""
    time_scale: float
    """[s] Range at the closest point over the speed; NaN where it is not determined."""


def closest_point(t: FloatArray, field: FloatArray, noise_std: FloatArray) -> ClosestPoint:
    """Fit the Anderson functions of a dipole on a straight line to the field of one sensor.

    Any axis is enough. The linear part, three coefficients and a constant an axis, is solved for
    each time and time scale.

    Parameters
    ----------
    t : (n,) array, s
        In order.
    field : (n, 3) array, T
        NaN = missing axis.
    noise_std : (3,) array, T

    Returns
    -------
    ClosestPoint

    References
    ----------
    [TSP14]_ eq. (22), (23), with the exponent 5/2.
    """
    there = ~np.isnan(field).all(axis=0) & ~np.isnan(noise_std)
    whole = ~np.isnan(field[:, there]).any(axis=1)
    t, y = t[whole], field[whole][:, there] / noise_std[there]
    if len(t):
        t, y = _averaged(t, y)
    t, y = plain(t), plain(y)
    span = float(t[-1] - t[0]) if len(t) else 0.0
    if len(t) < 8 or not span > 0.0:
        return ClosestPoint(float(t.mean()) if len(t) else np.nan, np.inf, np.nan)
    loudest = float(t[np.argmax(np.sum(y**2, axis=1))])
    interval = span / (len(t) - 1)

    def cost(time: float, scale: float) -> float:
        return anderson_residual(t, y, time, scale)

    starts = sorted((cost(time, scale), time, scale)
                    for scale in np.geomspace(1.5 * interval, span, 24).tolist()
                    for time in np.arange(t[0], t[-1], max(0.3 * scale, interval)).tolist())

    def cost_of(x: FloatArray) -> float:
        return cost(float(x[0]), float(np.exp(x[1])))

    found = min((minimize(cost_of, np.array([time, np.log(scale)]), method='Nelder-Mead', options={
        'xatol': 1e-4 * interval, 'fatol': 1e-9 * (1.0 + at_start), 'maxiter': 200})
        for at_start, time, scale in starts[:MAX_STARTS]), key=lambda result: float(result.fun))
    time, scale = float(found.x[0]), float(np.exp(found.x[1]))
    # Variance of the samples by what is left over; a vehicle leaves more than noise.
    left = max(found.fun / max(y.size - 4 * y.shape[1] - 2, 1), 0.0)
    alike = max(1.0, CORRELATED * scale / interval)
    step = 0.05 * scale
    curvature = (cost(time + step, scale) + cost(time - step, scale) - 2.0 * found.fun) / step**2
    std = np.sqrt(2.0 * left * alike / curvature) if curvature > 0.0 else np.inf
    if not (t[0] <= time <= t[-1] and scale <= span and np.isfinite(std)):
        return ClosestPoint(loudest, np.inf, np.nan)
    return ClosestPoint(time, float(np.hypot(std, OFF_CENTRE * scale)), scale)


def _averaged(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means of neighbours, at most `MAX_SAMPLES`, each of the same number of samples."""
    n = -(-len(t) // MAX_SAMPLES) or 1
    k = len(t) // n
    return t[:k * n].reshape(k, n).mean(axis=1), y[:k * n].reshape(k, n, -1).mean(axis=1)
