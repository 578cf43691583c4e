"""What one sensor tells of a pass: everything but the scale."""

import numpy as np

from mag_tracking.analysis.pass_result import Bearing, PassFit
from mag_tracking.arrays import FloatArray
from mag_tracking.physics.anderson import closest_approach

THROUGH = 1e-3
"""A CPA range below this share of the way seen is none: the path goes through the sensor."""

VAGUE = 0.5
"""[rad] A direction that is known no better than this is none."""


def scaled_to_range(theta: FloatArray, p: FloatArray, place: FloatArray,
                    distance: float) -> tuple[FloatArray, FloatArray] | None:
    """A path and its moments, seen alike by the one sensor at `place`, with that CPA range.

    (r, v, L, m) and (u r, u v, u L, u^3 m) give the same field; TSP14 eq. (34).
    So do (r, v) and (-r, -v), of which it gives the one that passes above the sensor.
    Returns None where the path goes through the sensor.
    """
    r, v = theta[:3] - place, theta[3:6]
    time, at, _ = closest_approach(r, v)
    if at <= THROUGH * np.linalg.norm(r - time * v):
        return None
    u = distance / at
    # Target and motion may both be reversed: taken is the end that is not below the sensor.
    side = 1.0 if (r + time * v)[2] >= 0.0 else -1.0
    scaled = u * np.concatenate([side * r, side * v, theta[6:]])
    scaled[:3] += place
    return scaled, p * u**3


def bearing_of(fit: PassFit, place: FloatArray) -> Bearing:
    """The `Bearing` of a fit whose CPA range was taken for known; `place` (3,) of the sensor."""
    r, v = fit.position - place, fit.velocity
    P = fit.robust_covariance
    time, distance, r_cpa = closest_approach(r, v)
    v2 = v @ v
    g_time = -np.concatenate([v, r + 2.0 * time * v]) / v2
    dr_cpa = np.hstack([np.eye(3), time * np.eye(3)]) + np.outer(v, g_time)
    g_rate = np.concatenate([np.zeros(3), v / np.sqrt(v2)]) / distance
    m, P_m = fit.moment
    up = 1.0 if r_cpa[2] >= 0.0 else -1.0
    stds = np.array([_direction_std(r_cpa, dr_cpa @ P[:6, :6] @ dr_cpa.T),
                     _direction_std(v, P[3:6, 3:6]), _direction_std(m, P_m)])
    at, along, turned = (x / np.linalg.norm(x) if std < VAGUE else np.full(3, np.nan)
                         for x, std in zip((up * r_cpa, up * v, m), stds, strict=True))
    return Bearing(at, along, turned, stds, time, float(np.sqrt(g_time @ P[:6, :6] @ g_time)),
                   float(np.sqrt(v2) / distance), float(np.sqrt(g_rate @ P[:6, :6] @ g_rate)))


def _direction_std(x: FloatArray, P: FloatArray) -> float:
    """[rad] Largest deviation of the direction of x (3,) with covariance P; inf where unknown."""
    if not np.isfinite(P).all():
        return np.inf
    u = x / np.linalg.norm(x)
    across = (np.eye(3) - np.outer(u, u)) / np.linalg.norm(x)
    return float(np.sqrt(np.linalg.eigvalsh(across @ P @ across)[-1]))
