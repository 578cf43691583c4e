"""Driving direction by the generalised likelihood ratio of a dipole in one of two lanes."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import fminbound

from mag_tracking.arrays import FloatArray

STEP = 0.05
"""Largest step of the search for the time of the closest approach, in lateral distance over
speed."""


class LaneHypothesis(NamedTuple):
    """A target that passes the sensor at a known speed and distance."""

    speed: float
    """[m/s] along x; positive from left to right as seen from the sensor."""
    distance: float
    """[m] to the lane, along y."""
    height: float = 0.0
    """[m] of the target above the sensor."""


def direction_likelihood_ratio(t: FloatArray, field: FloatArray, noise_std: float,
                               left_to_right: LaneHypothesis,
                               right_to_left: LaneHypothesis) -> float:
    """Log likelihood ratio of two lanes, with the moment and the time of passing maximised.

    Parameters
    ----------
    t : (n,) array, s
    field : (n, 2) array, T
        Horizontal field, x along the road, without the background.
    noise_std : float, T
        Standard deviation of one sample on each axis.
    left_to_right, right_to_left : LaneHypothesis

    Returns
    -------
    float
        Positive for left to right.

    References
    ----------
    [PHD15]_ Paper B eq. (24)-(35). Eq. (27) prints +||r||^2 where the dipole has -||r||^2.
    """
    first, second = (_least_residual(t, field, h) for h in (left_to_right, right_to_left))
    return (second - first) / (2.0 * noise_std**2)


def _least_residual(t: FloatArray, field: FloatArray, lane: LaneHypothesis) -> float:
    """[T^2] Smallest sum of squares that a dipole in the lane leaves."""
    step = float(STEP * abs(lane.distance / lane.speed))
    grid = np.arange(t[0], t[-1] + step, step)
    at_grid = _residuals(t, field, lane, grid)
    k = int(np.argmin(at_grid))

    def cost(at: float) -> float:
        return float(_residuals(t, field, lane, np.array([at]))[0])

    found = float(fminbound(cost, float(grid[k] - step), float(grid[k] + step)))
    return min(float(at_grid[k]), cost(found))


def _residuals(t: FloatArray, field: FloatArray, lane: LaneHypothesis,
               at: FloatArray) -> FloatArray:
    """(k,) [T^2] sums of squares that the best moments leave, for closest approaches `at` (k,) [s].
    """
    along = lane.speed * (t - at[:, None])
    r = np.stack([along, np.full_like(along, lane.distance),
                  np.full_like(along, lane.height)], axis=-1)
    size = np.linalg.norm(r, axis=-1)[..., None, None]
    # At the height of the sensor a vertical moment has no horizontal field.
    n = 3 if lane.height else 2
    H = (3.0 * r[..., :2, None] * r[..., None, :n] / size**5 - np.eye(3)[:2, :n] / size**3)
    H = H.reshape(len(at), -1, n)
    y = field.ravel()
    b = y @ H
    moment = np.linalg.solve(np.swapaxes(H, 1, 2) @ H, b[..., None])[..., 0]
    left: FloatArray = y @ y - np.sum(b * moment, axis=-1)
    return left
