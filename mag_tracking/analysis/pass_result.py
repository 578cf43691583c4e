"""What a batch fit of a pass has to say."""

from dataclasses import dataclass, field, replace

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import heading_of, moved_along, speed_of
from mag_tracking.physics.anderson import closest_approach

RIVAL = 9.2
"""Chi-square that a rival may be behind: one in a hundred."""

FAR = 22.5
"""Squared deviations, of six numbers, at which another path is another: one in a thousand."""


POOR = 2.0
"""A normalised cost beyond says that the model leaves out more than the noise covers."""

NEARLY = 1.25
"""A fit whose cost is not larger than this times that of the best describes the pass as well."""

SHORTEST = 1e-2
"""A row that is shorter than this share of the way on which it was seen is a point; one that is
longer than that way is none."""


@dataclass(frozen=True)
class Bearing:
    """What one sensor alone tells: everything but the scale.

    Seen from the sensor; target and motion may both be reversed, which gives the same field.
    """

    cpa_direction: FloatArray
    """(3,) unit vector, world, to the target at its closest; the end that is not below."""
    motion_direction: FloatArray
    """(3,) unit vector, world."""
    moment_direction: FloatArray
    """(3,) unit vector, world, of the whole."""
    direction_std: FloatArray
    """(3,) [rad], of the three: the largest deviation across each."""
    cpa_time: float
    """[s] after time zero."""
    cpa_time_std: float
    rate: float
    """[1/s] speed over CPA range."""
    rate_std: float


@dataclass(frozen=True)
class PassFit:
    """A pass at constant velocity, as weighted least squares has it.

    Where `reason` is not empty the fit as a whole is no answer; what is `trusted` is one.
    """

    n_dipoles: int
    data: PassData
    reason: str = ''
    converged: bool = False
    names: tuple[str, ...] = ()
    """Of the unknowns: path, moments, backgrounds."""
    x: FloatArray = field(default_factory=lambda: np.zeros(0))
    """(n_x,) their values: [m], [m/s], [A m^2], [T]."""
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(n_x, n_x) TSP14 eq. (47), which takes model and noise for right; infinite variance = not
    observable."""
    robust_covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    """(n_x, n_x) the same and what the model leaves out: residuals that are alike for a while
    instead of noise. All deviations are of this one."""
    cost: float = np.nan
    """Sum of squared whitened residuals, TSP14 eq. (46b)."""
    explained: float = np.nan
    """Share of the whitened energy beyond the backgrounds and the noise that the fit explains."""
    duration_s: float = np.nan
    """[s] in which nearly all of the target's energy came."""
    velocity_change: float = np.nan
    """Share of itself by which the velocity seems to change while the target is seen."""
    velocity_change_std: float = np.nan
    """By noise, and by what the model leaves out."""
    residual_elsewhere: float = np.nan
    """Share of the energy that is left over where no vehicle leaves any; see `pass_trust`."""
    trusted: tuple[str, ...] = ()
    """The names of those among speed, direction and time (of the closest point) that are
    determined, also where the whole has a reason not to be believed; see `pass_trust`."""
    bearing: Bearing | None = None
    """With one sensor."""
    rivals: tuple[tuple[float, FloatArray], ...] = ()
    """(d, path) of other minima, a likelihood ratio of exp(-d/2) behind this one: the covariance
    knows nothing of them. A row with an empty end is one, a shorter one further on."""
    predicted: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) [T], sensor frame, with the background."""
    predicted_std: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) [T], by the honest covariance, without noise."""
    n_other_unknowns: int = 0
    """How many more unknowns the fit had: those of other targets in the same window, the field of
    which `data` are without."""

    @property
    def n_unknowns(self) -> int:
        """How many unknowns were fitted together."""
        return len(self.x) + self.n_other_unknowns

    @property
    def degrees_of_freedom(self) -> float:
        """Independent measurements less unknowns."""
        return self.data.n_independent - self.n_unknowns

    @property
    def normalised_cost(self) -> float:
        """About one where the model is right; TSP14 eq. (50)."""
        return self.cost / self.degrees_of_freedom

    @property
    def determined(self) -> bool:
        """Whether the measurements fix all unknowns, right or not."""
        if not (len(self.x) and self.converged):
            return False
        variance = np.diagonal(self.robust_covariance)
        if not (np.isfinite(variance).all() and (variance > 0.0).all()):
            return False
        if self.n_dipoles == 1:
            return True
        length, length_std = self.length
        way = np.linalg.norm(self.velocity) * self.duration_s
        return bool(length_std <= max(length, 1.0) and SHORTEST * way <= length <= way)

    @property
    def is_poor_mixture(self) -> bool:
        """Whether targets that were fitted together leave over more than noise."""
        return self.n_other_unknowns > 0 and bool(self.normalised_cost > POOR)

    @property
    def ambiguous(self) -> bool:
        """Whether another path, elsewhere by its deviations, is possible at 1 %.

        Of targets that were fitted together also where much is left over: of which of them it is
        nobody knows.
        """
        if self.is_poor_mixture:
            return True
        P = self.robust_covariance[:6, :6]
        for d, path in self.rivals:
            e = path[:6] - self.x[:6]
            if d < RIVAL and e @ np.linalg.pinv(P, hermitian=True) @ e > FAR:
                return True
        return False

    @property
    def position(self) -> FloatArray:
        """(3,) [m], world, of the middle at time zero."""
        return self.x[:3]

    @property
    def velocity(self) -> FloatArray:
        """(3,) [m/s], world."""
        return self.x[3:6]

    def shifted(self, seconds: float) -> 'PassFit':
        """The same fit with time zero `seconds` later."""
        F = np.eye(len(self.x))
        F[:3, 3:6] = seconds * np.eye(3)
        # An infinite variance times zero is NaN.
        with np.errstate(invalid='ignore'):
            covariance, robust = (F @ P @ F.T for P in (self.covariance, self.robust_covariance))
        rivals = tuple((cost, moved_along(path, seconds)) for cost, path in self.rivals)
        return replace(self, data=self.data.shifted(seconds), x=moved_along(self.x, seconds),
                       covariance=covariance, robust_covariance=robust, rivals=rivals)

    @property
    def speed(self) -> tuple[float, float]:
        """[m/s] and its deviation."""
        return speed_of(self.velocity, self.robust_covariance[3:6, 3:6])

    @property
    def heading(self) -> tuple[float, float]:
        """[rad] anticlockwise from x, and its deviation."""
        return heading_of(self.velocity, self.robust_covariance[3:6, 3:6])

    @property
    def length(self) -> tuple[float, float]:
        """[m] of the row and its deviation; zeros for a point."""
        if self.n_dipoles == 1:
            return 0.0, 0.0
        return self.x[6], np.sqrt(self.robust_covariance[6, 6])

    @property
    def moment(self) -> tuple[FloatArray, FloatArray]:
        """(3,) [A m^2], world, of the whole, and its covariance (3, 3); TSP14 (9)."""
        S = np.zeros((3, len(self.x)))
        first = 6 + int(self.n_dipoles > 1)
        for i in range(self.n_dipoles):
            S[:, first + 3 * i:first + 3 * i + 3] = np.eye(3)
        return S @ self.x, S @ self.robust_covariance @ S.T

    def closest_approach(self, point: FloatArray) -> tuple[float, float, float, float]:
        """CPA of the row's middle to a point.

        Parameters
        ----------
        point : (3,) [m], world

        Returns
        -------
        time, time_std : float [s], after time zero
        range, range_std : float [m]

        Source: TSP14 eq. (24); deviations by its derivatives.
        """
        r, v = self.position - point, self.velocity
        time, distance, r_cpa = closest_approach(r, v)
        u = r_cpa / distance if distance > 0.0 else np.zeros(3)
        P = self.robust_covariance[:6, :6]
        g_time = -np.concatenate([v, r + 2.0 * time * v]) / (v @ v)
        g_range = np.concatenate([u, time * u])
        return (time, np.float64(np.sqrt(g_time @ P @ g_time)), distance,
                np.float64(np.sqrt(g_range @ P @ g_range)))
