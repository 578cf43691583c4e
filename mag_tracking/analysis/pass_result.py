"""Result of a batch fit of a pass."""

from dataclasses import dataclass, field, replace

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import heading_of, propagated_path, speed_of
from mag_tracking.physics.passes import closest_approach

RIVAL_CHI2 = 9.2
"""Maximum chi-square difference between a rival and the best fit (probability 0.01)."""
DIFFERENT_PATH_CHI2 = 22.5
"""Minimum squared normalised distance of different paths in six parameters (probability 0.001)."""
MAX_NORMALISED_COST = 2.0
"""Maximum normalised cost of a joint fit that is not dominated by model errors."""
MAX_COST_RATIO = 1.25
"""Maximum cost relative to the best cost; fits up to this ratio count as equally good."""
MIN_LENGTH_FRACTION = 1e-2
"""Minimum length of a row, at most one, relative to the distance travelled during the pass."""
MIN_CPA_FRACTION = 1e-3
"""Minimum CPA range of a path beside the sensor, relative to the distance travelled."""
MAX_DIRECTION_STD = 0.5
"""[rad] Maximum standard deviation of a direction. Less certain directions are set to NaN."""


@dataclass(frozen=True)
class Bearing:
    """Observable quantities of a pass relative to a single sensor, at which a path and its
    reflection have equal fields."""

    cpa_direction: FloatArray
    """(3,) unit vector, world, from the sensor to the CPA in the solution above the sensor."""
    motion_direction: FloatArray
    """(3,) unit vector, world, of the velocity in the solution above the sensor."""
    moment_direction: FloatArray
    """(3,) unit vector, world, of the total moment."""
    direction_std: FloatArray
    """(3,) [rad] largest standard deviation of each of the three directions."""
    cpa_time: float
    """[s] relative to time zero."""
    cpa_time_std: float
    rate: float
    """[1/s] speed over CPA range."""
    rate_std: float


@dataclass(frozen=True)
class PassFit:
    """Weighted least-squares fit of a pass at constant velocity; if `reason` is not empty, only
    quantities in `trusted` are valid."""

    n_dipoles: int
    data: PassData
    """Fitted readings, without the fields of other targets of a joint fit."""
    reason: str = ''
    """Reason for a rejection of the fit as a whole; empty if the fit is accepted."""
    converged: bool = False
    """Whether the search reached a minimum."""
    names: tuple[str, ...] = ()
    """Names of the unknowns: path, moments, backgrounds."""
    x: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(n_x,) values of the unknowns: [m], [m/s], [A m²], [T]."""
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(n_x, n_x) for a correct model and noise, TSP14 eq. (47); infinite if not observable."""
    robust_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(n_x, n_x) including sensor errors and model errors with correlated residuals, from which all
    standard deviations are derived, and those of positions from `position_covariance`."""
    cost: float = np.nan
    """Sum of squared whitened residuals, TSP14 eq. (46b)."""
    explained: float = np.nan
    """Fraction of the whitened energy, without backgrounds and noise, that the fit explains."""
    duration_s: float = np.nan
    """[s] Duration of the interval that contains the central 96 % of the target's energy."""
    velocity_change: float = np.nan
    """Apparent relative change of the velocity during the pass."""
    velocity_change_std: float = np.nan
    """Its standard deviation due to noise and model errors."""
    residual_elsewhere: float = np.nan
    """Unexplained fraction of the energy outside the reach of the vehicle; see `pass_trust`."""
    trusted: tuple[str, ...] = ()
    """Those of speed, direction and time of the CPA that are valid even if the fit is rejected."""
    bearing: Bearing | None = None
    """Observable quantities of a fit of one sensor; None otherwise."""
    rivals: tuple[tuple[float, FloatArray], ...] = ()
    """(d, path) of each other minimum of the cost, whose likelihood ratio to this fit is exp(-d/2).
    The covariance does not cover rivals."""
    predicted: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) [T] fitted field including the background, sensor frame."""
    predicted_std: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) [T] standard deviation of `predicted` from the robust covariance, without noise."""
    n_other_unknowns: int = 0
    """Number of unknowns of other targets in the same joint fit."""
    shape_covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) [m²] covariance of the middle of a vehicle about the centre of the row."""

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns, including those of other targets of a joint fit."""
        return len(self.x) + self.n_other_unknowns

    @property
    def degrees_of_freedom(self) -> float:
        """Number of independent measurements minus the number of unknowns."""
        return self.data.n_independent - self.n_unknowns

    @property
    def normalised_cost(self) -> float:
        """Cost per degree of freedom, about one if the model is correct; TSP14 eq. (50)."""
        return self.cost / self.degrees_of_freedom

    @property
    def determined(self) -> bool:
        """Whether the search converged to a plausible length and all unknowns are observable."""
        if not (len(self.x) and self.converged):
            return False
        variance = np.diagonal(self.robust_covariance)
        if not (np.isfinite(variance).all() and (variance > 0.0).all()):
            return False
        if self.n_dipoles == 1:
            return True
        length, length_std = self.length
        travelled_distance = np.linalg.norm(self.velocity) * self.duration_s
        return bool(length_std <= max(length, 1.0)
                    and MIN_LENGTH_FRACTION * travelled_distance <= length <= travelled_distance)

    @property
    def is_poor_joint_fit(self) -> bool:
        """Whether this is a joint fit with a normalised cost above `MAX_NORMALISED_COST`."""
        return self.n_other_unknowns > 0 and bool(self.normalised_cost > MAX_NORMALISED_COST)

    @property
    def ambiguous(self) -> bool:
        """Whether a different path is possible at the 1 % level, or the fit is a poor joint fit."""
        P = self.robust_covariance[:6, :6]
        return self.is_poor_joint_fit or any(
            (e := path[:6] - self.x[:6]) @ np.linalg.pinv(P, hermitian=True) @ e
            > DIFFERENT_PATH_CHI2 for d, path in self.rivals if d < RIVAL_CHI2)

    @property
    def position(self) -> FloatArray:
        """Position of the centre of the target at time zero, (3,) m, world frame."""
        return self.x[:3]

    @property
    def position_covariance(self) -> FloatArray:
        """Covariance (3, 3) [m², world frame] of the middle of the vehicle, or of the centre of the
        row for a single sensor without a known range."""
        P = self.robust_covariance[:3, :3]
        return P if self.bearing is not None else P + self.shape_covariance

    @property
    def velocity(self) -> FloatArray:
        """Velocity, (3,) m/s, world frame."""
        return self.x[3:6]

    def shifted(self, seconds: float) -> 'PassFit':
        """Return the fit with time zero shifted; a positive shift makes it later."""
        F = np.eye(len(self.x))
        F[:3, 3:6] = seconds * np.eye(3)
        # An infinite variance times zero is NaN.
        with np.errstate(invalid='ignore'):
            covariance, robust = (F @ P @ F.T for P in (self.covariance, self.robust_covariance))
        rivals = tuple((cost, propagated_path(path, seconds)) for cost, path in self.rivals)
        return replace(self, data=self.data.shifted(seconds), x=propagated_path(self.x, seconds),
                       covariance=covariance, robust_covariance=robust, rivals=rivals)

    @property
    def speed(self) -> tuple[float, float]:
        """Speed and its standard deviation [m/s]."""
        return speed_of(self.velocity, self.robust_covariance[3:6, 3:6])

    @property
    def heading(self) -> tuple[float, float]:
        """Heading, anticlockwise from x, and its standard deviation [rad]."""
        return heading_of(self.velocity, self.robust_covariance[3:6, 3:6])

    @property
    def length(self) -> tuple[float, float]:
        """Length of the row and its standard deviation [m]; zeros for a point."""
        if self.n_dipoles == 1:
            return 0.0, 0.0
        return self.x[6], np.sqrt(self.robust_covariance[6, 6])

    @property
    def moment(self) -> tuple[FloatArray, FloatArray]:
        """Total moment, (3,) A m², world frame, and its covariance (3, 3); TSP14 eq. (9)."""
        S, first = np.zeros((3, len(self.x))), 6 + int(self.n_dipoles > 1)
        S[:, first:first + 3 * self.n_dipoles] = np.tile(np.eye(3), self.n_dipoles)
        return S @ self.x, S @ self.robust_covariance @ S.T

    def closest_approach(self, point: FloatArray) -> tuple[float, float, float, float]:
        """Time [s, relative to time zero] and range [m] of the CPA to a point, each followed by its
        std; TSP14 eq. (24), with linearised stds."""
        r, v = self.position - point, self.velocity
        t_cpa, distance, r_cpa = closest_approach(r, v)
        u = r_cpa / distance if distance > 0.0 else np.zeros(3)
        P = self.robust_covariance[:6, :6]
        g_time = -np.concatenate([v, r + 2.0 * t_cpa * v]) / (v @ v)
        g_range = np.concatenate([u, t_cpa * u])
        return (t_cpa, np.float64(np.sqrt(g_time @ P @ g_time)), distance,
                np.float64(np.sqrt(g_range @ P @ g_range
                                   + u @ (self.position_covariance - P[:3, :3]) @ u)))


def scaled_to_range(theta: FloatArray, p: FloatArray, sensor_position: FloatArray,
                    distance: float, duration: float) -> tuple[FloatArray, FloatArray] | None:
    """Path and moments scaled to a CPA range `distance`; None if the path meets the sensor.

    At a single sensor, (r, v, m) and (u r, u v, u³ m) have the same field (TSP14 eq. (34)), and so
    have (r, v) and (-r, -v); the path above the sensor at the CPA is returned. `theta` (6 or 7,) is
    position, velocity and, for a row, length; `duration` [s] is that of the pass.
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
    """Largest std [rad] of the direction of x (3,) with covariance P; inf if P is not finite."""
    if not np.isfinite(P).all():
        return np.inf
    u = x / np.linalg.norm(x)
    normal_projection = (np.eye(3) - np.outer(u, u)) / np.linalg.norm(x)
    return float(np.sqrt(np.linalg.eigvalsh(normal_projection @ P @ normal_projection)[-1]))
