"""Observable quantities of a pass at a single sensor: directions, CPA time, speed over range."""

import numpy as np

from mag_tracking.analysis.pass_result import Bearing, PassFit
from mag_tracking.arrays import FloatArray
from mag_tracking.physics.passes import closest_approach

MIN_CPA_FRACTION = 1e-3
"""Minimum CPA range relative to the distance travelled during the pass. At a smaller ratio, the
path is treated as passing through the sensor."""

MAX_DIRECTION_STD = 0.5
"""[rad] Maximum standard deviation of a direction. Less certain directions are set to NaN."""


def scaled_to_range(theta: FloatArray, p: FloatArray, sensor_position: FloatArray,
                    distance: float, duration: float) -> tuple[FloatArray, FloatArray] | None:
    """Path and moments scaled to a CPA range `distance`; None if the path meets the sensor.

    At a single sensor, (r, v, m) and (u r, u v, u³ m) have the same field (TSP14 eq. (34)). The
    paths (r, v) and (-r, -v) also have the same field; the path above the sensor at the CPA is
    returned. `theta` (6 or 7,) is position, velocity and, for a row, length; `duration` [s] is that
    of the pass.
    """
    r, v = theta[:3] - sensor_position, theta[3:6]
    t_cpa, cpa_range, _ = closest_approach(r, v)
    if cpa_range <= MIN_CPA_FRACTION * duration * np.linalg.norm(v):
        return None
    u = distance / cpa_range
    # The path reversed through the sensor has the same field; use the path above the sensor.
    sign = 1.0 if (r + t_cpa * v)[2] >= 0.0 else -1.0
    scaled = u * np.concatenate([sign * r, sign * v, theta[6:]])
    scaled[:3] += sensor_position
    return scaled, p * u**3


def bearing_of(fit: PassFit, sensor_position: FloatArray) -> Bearing:
    """Compute the quantities of a single-sensor fit that do not depend on the assumed CPA range."""
    r, v = fit.position - sensor_position, fit.velocity
    P = fit.robust_covariance
    t_cpa, distance, r_cpa = closest_approach(r, v)
    squared_speed = v @ v
    g_time = -np.concatenate([v, r + 2.0 * t_cpa * v]) / squared_speed
    dr_cpa = np.hstack([np.eye(3), t_cpa * np.eye(3)]) + np.outer(v, g_time)
    g_rate = np.concatenate([np.zeros(3), v / np.sqrt(squared_speed)]) / distance
    m, P_m = fit.moment
    sign = 1.0 if r_cpa[2] >= 0.0 else -1.0
    stds = np.array([_direction_std(r_cpa, dr_cpa @ P[:6, :6] @ dr_cpa.T),
                     _direction_std(v, P[3:6, 3:6]), _direction_std(m, P_m)])
    cpa_direction, motion_direction, moment_direction = (
        x / np.linalg.norm(x) if std < MAX_DIRECTION_STD else np.full(3, np.nan)
        for x, std in zip((sign * r_cpa, sign * v, m), stds, strict=True))
    return Bearing(cpa_direction, motion_direction, moment_direction, stds, t_cpa,
                   float(np.sqrt(g_time @ P[:6, :6] @ g_time)),
                   float(np.sqrt(squared_speed) / distance),
                   float(np.sqrt(g_rate @ P[:6, :6] @ g_rate)))


def _direction_std(x: FloatArray, P: FloatArray) -> float:
    """Largest std [rad] of the direction of x (3,) with covariance P; infinite if P is not
    finite."""
    if not np.isfinite(P).all():
        return np.inf
    u = x / np.linalg.norm(x)
    normal_projection = (np.eye(3) - np.outer(u, u)) / np.linalg.norm(x)
    return float(np.sqrt(np.linalg.eigvalsh(normal_projection @ P @ normal_projection)[-1]))
