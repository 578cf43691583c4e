"""Closest point of approach of a pass, estimated from the readings of one sensor."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from mag_tracking.arrays import FloatArray
from mag_tracking.physics.passes import anderson_residual
from mag_tracking.records import plain

MAX_SAMPLES = 200
"""Maximum number of samples in the search. If a pass has more, blocks of samples are averaged."""

MAX_STARTS = 5
"""Maximum number of grid points from which the search starts. With a single axis, the cost function
has several local minima."""

CORRELATION_TIME = 2.0
"""[time scales] Correlation time of the residual when a dipole is fitted to a vehicle."""

CENTRE_OFFSET = 0.15
"""[time scales] Typical distance of a vehicle's magnetic centre from the middle of its body."""

MIN_SAMPLES = 8
"""Minimum number of samples for a fit. Only samples with all reported axes are counted."""


class ClosestPoint(NamedTuple):
    """Closest point of approach of a pass, estimated from one sensor."""

    time: float
    """[s] Time of the closest point; of the largest field if the closest point is not observable.
    NaN without samples."""
    time_std: float
    """[s] Standard deviation of `time`; inf if the closest point is not observable."""
    time_scale: float
    """[s] Range at the closest point divided by the speed; NaN if not observable."""


def closest_point(t: FloatArray, field: FloatArray, noise_std: FloatArray) -> ClosestPoint:
    """Fit the Anderson functions of a dipole on a straight line to the field (n, 3) of one sensor.

    One axis is sufficient; a missing axis is NaN. `noise_std` (3,) [T] is the noise of one reading.
    The linear parameters (three coefficients and a constant per axis) are solved for each candidate
    time and time scale. See [TSP14]_ eq. (22), (23), with the exponent 5/2.
    """
    present = ~np.isnan(field).all(axis=0) & ~np.isnan(noise_std)
    complete = ~np.isnan(field[:, present]).any(axis=1)
    if np.count_nonzero(complete) < MIN_SAMPLES:
        strongest = float(t[np.argmax(np.nansum(field**2, axis=1))]) if len(t) else np.nan
        return ClosestPoint(strongest, np.inf, np.nan)
    t, y = _averaged(t[complete], field[complete][:, present] / noise_std[present])
    t, y = plain(t), plain(y)
    span = float(t[-1] - t[0])
    strongest = float(t[np.argmax(np.sum(y**2, axis=1))])
    if not span > 0.0:
        return ClosestPoint(strongest, np.inf, np.nan)
    interval = span / (len(t) - 1)

    def cost(time: float, scale: float) -> float:
        return anderson_residual(t, y, time, scale)

    starts = sorted((cost(time, scale), time, scale)
                    for scale in np.geomspace(1.5 * interval, span, 24).tolist()
                    for time in np.arange(t[0], t[-1], max(0.3 * scale, interval)).tolist())

    def cost_of(x: FloatArray) -> float:
        return cost(float(x[0]), float(np.exp(x[1])))

    best = min((minimize(cost_of, np.array([time, np.log(scale)]), method='Nelder-Mead', options={
        'xatol': 1e-4 * interval, 'fatol': 1e-9 * (1.0 + at_start), 'maxiter': 200})
        for at_start, time, scale in starts[:MAX_STARTS]), key=lambda result: float(result.fun))
    time, scale = float(best.x[0]), float(np.exp(best.x[1]))
    # The residual of a vehicle is larger than noise, so the variance is estimated from it.
    residual_variance = max(best.fun / max(y.size - 4 * y.shape[1] - 2, 1), 0.0)
    n_correlated = max(1.0, CORRELATION_TIME * scale / interval)
    step = 0.05 * scale
    curvature = (cost(time + step, scale) + cost(time - step, scale) - 2.0 * best.fun) / step**2
    std = np.sqrt(2.0 * residual_variance * n_correlated / curvature) \
        if curvature > 0.0 else np.inf
    if not (t[0] <= time <= t[-1] and scale <= span and np.isfinite(std)):
        return ClosestPoint(strongest, np.inf, np.nan)
    return ClosestPoint(time, float(np.hypot(std, CENTRE_OFFSET * scale)), scale)


def _averaged(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average samples in at most `MAX_SAMPLES` equal blocks; drop an incomplete last block."""
    n = -(-len(t) // MAX_SAMPLES) or 1
    k = len(t) // n
    return t[:k * n].reshape(k, n).mean(axis=1), y[:k * n].reshape(k, n, -1).mean(axis=1)
