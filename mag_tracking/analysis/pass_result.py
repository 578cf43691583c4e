"""Result of a batch fit of a pass."""

from dataclasses import dataclass, field, replace

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import heading_of, propagated_path, speed_of
from mag_tracking.physics.anderson import closest_approach

RIVAL_CHI2 = 9.2
"""Maximum chi-square distance of a rival from the best fit (probability 0.01)."""

DIFFERENT_PATH_CHI2 = 22.5
"""Minimum squared normalised distance, in six parameters, of two different paths (probability
0.001)."""


MAX_NORMALISED_COST = 2.0
"""Maximum normalised cost; beyond it, model errors exceed the noise."""

MAX_COST_RATIO = 1.25
"""Maximum ratio of the cost of a fit to the best cost at which it describes the pass equally
well."""

MIN_LENGTH_SHARE = 1e-2
"""Minimum length of a row relative to the distance travelled during the pass; a shorter row is a
point. A row longer than the distance travelled is rejected."""


@dataclass(frozen=True)
class Bearing:
    """Observable quantities of a pass at one sensor: everything but the scale.

    Relative to the sensor. The same field results if target and motion are both reversed.
    """

    cpa_direction: FloatArray
    """(3,) unit vector, world, to the target at the CPA; of the two solutions the one that is not
    below."""
    motion_direction: FloatArray
    """(3,) unit vector, world."""
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
    """Weighted least-squares fit of a pass at constant velocity.

    If `reason` is not empty, the fit as a whole is rejected; the quantities in `trusted` are valid.
    """

    n_dipoles: int
    data: PassData
    reason: str = ''
    converged: bool = False
    names: tuple[str, ...] = ()
    """Names of the unknowns: path, moments, backgrounds."""
    x: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(n_x,) values of the unknowns: [m], [m/s], [A m²], [T]."""
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(n_x, n_x) TSP14 eq. (47), for a correct model and noise; infinite variance = not
    observable."""
    robust_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(n_x, n_x) including model errors, whose residuals are correlated in time, and sensor errors.
    All standard deviations are from this covariance."""
    cost: float = np.nan
    """Sum of squared whitened residuals, TSP14 eq. (46b)."""
    explained: float = np.nan
    """Share of the whitened energy, less backgrounds and noise, that the fit explains."""
    duration_s: float = np.nan
    """[s] that contain nearly all of the target's energy."""
    velocity_change: float = np.nan
    """Apparent relative change of the velocity during the pass."""
    velocity_change_std: float = np.nan
    """Due to noise and model errors."""
    residual_elsewhere: float = np.nan
    """Share of the energy that is unexplained where a vehicle leaves no residual; see
    `pass_trust`."""
    trusted: tuple[str, ...] = ()
    """Those of speed, direction and time (of the CPA) that are determined, even if the fit as a
    whole is rejected; see `pass_trust`."""
    bearing: Bearing | None = None
    """For one sensor."""
    rivals: tuple[tuple[float, FloatArray], ...] = ()
    """(d, path) of other minima with a likelihood ratio of exp(-d/2) to this one; the covariance
    does not include them. A row whose end has no moment has a rival: a shorter row with another
    centre."""
    predicted: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) [T], sensor frame, including the background."""
    predicted_std: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) [T], from the robust covariance, without noise."""
    n_other_unknowns: int = 0
    """Number of unknowns of other targets in the same joint fit; `data` does not contain their
    fields."""

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns that were fitted jointly."""
        return len(self.x) + self.n_other_unknowns

    @property
    def degrees_of_freedom(self) -> float:
        """Number of independent measurements minus number of unknowns."""
        return self.data.n_independent - self.n_unknowns

    @property
    def normalised_cost(self) -> float:
        """Cost per degree of freedom, about one if the model is correct; TSP14 eq. (50)."""
        return self.cost / self.degrees_of_freedom

    @property
    def determined(self) -> bool:
        """Whether the measurements determine all unknowns."""
        if not (len(self.x) and self.converged):
            return False
        variance = np.diagonal(self.robust_covariance)
        if not (np.isfinite(variance).all() and (variance > 0.0).all()):
            return False
        if self.n_dipoles == 1:
            return True
        length, length_std = self.length
        way = np.linalg.norm(self.velocity) * self.duration_s
        return bool(length_std <= max(length, 1.0) and MIN_LENGTH_SHARE * way <= length <= way)

    @property
    def is_poor_mixture(self) -> bool:
        """Whether the residuals of a joint fit exceed the noise."""
        return self.n_other_unknowns > 0 and bool(self.normalised_cost > MAX_NORMALISED_COST)

    @property
    def ambiguous(self) -> bool:
        """Whether a different path is possible at the 1 % level.

        A poor joint fit is ambiguous as well, since the residual cannot be assigned to a target.
        """
        if self.is_poor_mixture:
            return True
        P = self.robust_covariance[:6, :6]
        for d, path in self.rivals:
            e = path[:6] - self.x[:6]
            if d < RIVAL_CHI2 and e @ np.linalg.pinv(P, hermitian=True) @ e > DIFFERENT_PATH_CHI2:
                return True
        return False

    @property
    def position(self) -> FloatArray:
        """Position of the centre at time zero, (3,) m, world frame."""
        return self.x[:3]

    @property
    def velocity(self) -> FloatArray:
        """Velocity, (3,) m/s, world frame."""
        return self.x[3:6]

    def shifted(self, seconds: float) -> 'PassFit':
        """Return the same fit with time zero moved.

        Parameters
        ----------
        seconds : float, s
            Positive moves time zero later.

        Returns
        -------
        PassFit
        """
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
        S = np.zeros((3, len(self.x)))
        first = 6 + int(self.n_dipoles > 1)
        for i in range(self.n_dipoles):
            S[:, first + 3 * i:first + 3 * i + 3] = np.eye(3)
        return S @ self.x, S @ self.robust_covariance @ S.T

    def closest_approach(self, point: FloatArray) -> tuple[float, float, float, float]:
        """CPA of the centre of the row to a point.

        Parameters
        ----------
        point : (3,) array, m, world frame

        Returns
        -------
        time : float, s
            Relative to time zero.
        time_std : float, s
        range : float, m
        range_std : float, m

        References
        ----------
        [TSP14]_ eq. (24), with linearised standard deviations.
        """
        r, v = self.position - point, self.velocity
        time, distance, r_cpa = closest_approach(r, v)
        u = r_cpa / distance if distance > 0.0 else np.zeros(3)
        P = self.robust_covariance[:6, :6]
        g_time = -np.concatenate([v, r + 2.0 * time * v]) / (v @ v)
        g_range = np.concatenate([u, time * u])
        return (time, np.float64(np.sqrt(g_time @ P @ g_time)), distance,
                np.float64(np.sqrt(g_range @ P @ g_range)))
