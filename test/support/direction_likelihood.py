"""Driving direction from the generalised likelihood ratio of a dipole in one of two lanes."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import fminbound

from mag_tracking.arrays import FloatArray

MAX_STEP = 0.05
"""Maximum step of the search for the CPA time, in units of lateral distance over speed."""


class LaneHypothesis(NamedTuple):
    """Hypothesis that a target passes in a lane, at a known speed and distance."""

    speed: float
    """Speed along x [m/s]; positive from left to right as seen from the sensor."""
    distance: float
    """Distance of the lane along y [m]."""
    height: float = 0.0
    """Height of the target above the sensor [m]."""


def direction_likelihood_ratio(t: FloatArray, field: FloatArray, noise_std: float,
                               left_to_right: LaneHypothesis,
                               right_to_left: LaneHypothesis) -> float:
    """Log-likelihood ratio of two lanes, maximised over moment and CPA time.

    Positive if left to right is more probable.

    `field` (n, 2) [T] is the horizontal field without the background, with x along the road;
    `noise_std` is per sample and axis. PHD15 Paper B eq. (24)-(35), with -||r||² in eq. (27), where
    the paper prints +||r||².
    """
    first, second = (_minimum_residual(t, field, h) for h in (left_to_right, right_to_left))
    return (second - first) / (2.0 * noise_std**2)


def _minimum_residual(t: FloatArray, field: FloatArray, lane: LaneHypothesis) -> float:
    """Minimum residual sum of squares [T²] over the moments and CPA times of a dipole in a lane."""
    step = float(MAX_STEP * abs(lane.distance / lane.speed))
    grid = np.arange(t[0], t[-1] + step, step)
    grid_residuals = _residuals(t, field, lane, grid)
    k = int(np.argmin(grid_residuals))

    def cost(t_cpa: float) -> float:
        return float(_residuals(t, field, lane, np.array([t_cpa]))[0])

    t_best = float(fminbound(cost, float(grid[k] - step), float(grid[k] + step)))
    return min(float(grid_residuals[k]), cost(t_best))


def _residuals(t: FloatArray, field: FloatArray, lane: LaneHypothesis,
               t_cpa: FloatArray) -> FloatArray:
    """Residual sum of squares (k,) [T²] for the least-squares moment at each `t_cpa` (k,) [s]."""
    along = lane.speed * (t - t_cpa[:, None])
    r = np.stack([along, np.full_like(along, lane.distance),
                  np.full_like(along, lane.height)], axis=-1)
    distance = np.linalg.norm(r, axis=-1)[..., None, None]
    # In the horizontal plane of the sensor, a vertical moment has no horizontal field.
    n = 3 if lane.height else 2
    H = (3.0 * r[..., :2, None] * r[..., None, :n] / distance**5 - np.eye(3)[:2, :n] / distance**3)
    H = H.reshape(len(t_cpa), -1, n)
    y = field.ravel()
    b = y @ H
    moment = np.linalg.solve(np.swapaxes(H, 1, 2) @ H, b[..., None])[..., 0]
    residuals: FloatArray = y @ y - np.sum(b * moment, axis=-1)
    return residuals
