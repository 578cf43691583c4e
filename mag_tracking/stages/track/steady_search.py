"""Search for vehicles on straight paths in the frames of a window, where others pass, too.

Everything that is linear in the field of a vehicle is Gaussian and is taken out: the moments of
the one that is sought, the backgrounds, and what is not known of those that are tracked. What is
left is the path, which is searched for from a grid of starts.

Source: TSP14 sections III.A and V for the row of dipoles; variable projection with priors.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.least_squares import refine
from mag_tracking.inference.marginal_whitener import MarginalWhitener
from mag_tracking.inference.matrices import ignoring_overflow, pseudo_inverse
from mag_tracking.inference.separable_fit import distinct
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.steady_pass import N_STRAIGHT, PATH, SteadyPass
from mag_tracking.stages.track.initiation_vehicle import VehicleSettings
from mag_tracking.stages.track.pass_samples import PassSamples
from mag_tracking.stages.track.reach import DETECTABLE_ENERGY
from mag_tracking.stages.track.window_start import in_order_of

N_DIPOLES = 3
"""Dipoles of the rows that are sought: enough for a car near a sensor."""

STEP_ALONG, BEYOND = 3.0, 12.0
"""[m] The grid has positions this far apart, up to so far beyond the outermost sensor."""

SPEED = PATH.index('speed')
"""Column of a path."""

MIN_STD = 1e-3
"""[m], [m/s], [A m^2] Of what the settings have without a spread, such as the length of a point."""

SLOWEST = 0.2
"""No vehicle comes that is slower than this share of the lowest starting speed."""

N_STARTS, N_STEPS, TOLERANCE = 10, 12, 1e-3
"""So many starts that differ are refined, in so many steps, or until one improves the cost by less
than this share."""

APART_START: FloatArray = np.array([4.0, 2.5, 1.0, 5.0, 0.3, 1.0, 3.0])
APART: FloatArray = np.array([1.0, 1.0, 1.0, 2.0, 0.3, 1.0, 9.0])
"""[m], [m/s], [rad] Starts, and paths, that differ by no more than this are the same."""

KNOWN_STD: FloatArray = np.array([2.0, 1.5, 0.2, 3.0, 0.1, 0.1, 1.5])
"""[m], [m/s], [rad] By so much may the path of another vehicle of the search be off."""


@dataclass(frozen=True)
class PathPrior:
    """What is known of a vehicle's path and moments before it is measured."""

    headings: FloatArray
    """(n,) [rad] of the arrival lines."""
    centre: FloatArray
    """(2,) [m] through which the lines go."""
    mean: FloatArray
    """(7,) of a straight path; position and heading are relative to the nearest line."""
    std: FloatArray
    """(7,)"""
    moment_std: FloatArray
    """(3 d,) [A m^2] of the combinations of moments."""
    slowest: float
    """[m/s] What is slower does not come: it was there before."""

    @classmethod
    def of(cls, vehicle: VehicleSettings, network: SensorNetwork) -> 'PathPrior':
        """That of all kinds of the settings together."""
        def spread(means: Iterable[float], stds: Iterable[float]) -> tuple[float, float]:
            m, s = np.array(means, dtype=float), np.array(stds, dtype=float)
            return float(m.mean()), max(float(np.sqrt(m.var() + np.square(s).mean())), MIN_STD)

        height, height_std = spread(vehicle.heights, vehicle.height_stds)
        speeds = np.array(vehicle.speeds)
        speed, speed_std = spread(speeds, vehicle.speed_std * speeds)
        length, length_std = spread(vehicle.lengths, vehicle.length_stds)
        lateral_std = spread(vehicle.lateral_offsets, [vehicle.lateral_std])[1]
        total = np.sqrt(np.square(vehicle.moments).mean() / 3.0)
        difference = max(float(np.sqrt(np.square(vehicle.difference_stds).mean())), MIN_STD)
        # The first combination is the mean of the row, times the root of the number of dipoles.
        return cls(np.deg2rad(vehicle.arrival_headings_deg), network.centre[:2],
                   np.array([0.0, 0.0, height, speed, 0.0, 0.0, length]),
                   np.array([np.inf, lateral_std, height_std, speed_std, vehicle.cross_speed_std,
                             vehicle.climb_std, length_std]),
                   np.repeat([total / np.sqrt(N_DIPOLES)] + [difference] * (N_DIPOLES - 1), 3),
                   SLOWEST * min(vehicle.speeds))

    def nearest(self, theta: FloatArray) -> tuple[IntArray, FloatArray]:
        """The arrival line (n,) nearest in heading to paths theta (n, 7), and by how much [rad]."""
        off = (theta[:, 4, None] - self.headings + np.pi) % (2.0 * np.pi) - np.pi
        line: IntArray = np.abs(off).argmin(axis=1)
        return line, off[np.arange(len(theta)), line]

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n, 7) of paths, and Jacobians (n, 7, 7) of what they are compared with."""
        line, turned = self.nearest(theta)
        aside = np.stack([-np.sin(self.headings), np.cos(self.headings)], axis=1)[line]
        relative = theta.copy()
        relative[:, 1] = np.einsum('ni,ni->n', theta[:, :2] - self.centre, aside)
        relative[:, 4] = turned
        J = np.tile(np.diag(1.0 / self.std), (len(theta), 1, 1))
        J[:, 1, :2] = aside / self.std[1]
        return (self.mean - relative) / self.std, J

    def starts(self, vehicle: VehicleSettings, network: SensorNetwork) -> FloatArray:
        """Paths (n, 7) from which a vehicle is sought, at time zero anywhere along the lines."""
        offsets = np.array(vehicle.lateral_offsets)
        offsets = np.unique(np.append(offsets, 0.5 * (offsets[1:] + offsets[:-1])))
        speeds = np.array(vehicle.speeds)
        speeds = np.unique(np.append(speeds, np.sqrt(speeds[1:] * speeds[:-1])))
        starts = []
        for heading in self.headings:
            along = np.array([np.cos(heading), np.sin(heading)])
            reach = float(np.abs((network.positions[:, :2] - self.centre) @ along).max())
            places, y, v = (a.ravel() for a in np.meshgrid(
                np.arange(-vehicle.max_start_distance - reach, BEYOND + reach, STEP_ALONG),
                offsets, speeds,
                indexing='ij'))
            grid = np.tile(self.mean, (len(places), 1))
            grid[:, :2] = self.centre + places[:, None] * along \
                + y[:, None] * [-along[1], along[0]]
            grid[:, 3], grid[:, 4] = v, heading
            starts.append(grid)
        return np.vstack(starts)


class StartGrid:
    """Paths from which a vehicle is sought, and the fields of a point on each.

    What does not depend on what is known is worked out once for all searches of a window.

    Attributes
    ----------
    theta : (n, 7) array
        See `PathPrior.starts`.
    bases : (3 n_samples, 3 n) array
        Whitened fields of unit moments: three columns for each path.
    gram : (n, 3, 3) array
        A'A of the columns A of each path.
    prior_cost : (n,) array
        Squared deviations of each path from the prior.
    """

    def __init__(self, samples: PassSamples, prior: PathPrior, theta: FloatArray) -> None:
        """`samples` are those of a window, `theta` (n, 7) the paths."""
        A = samples.straight_model(1).basis(theta)
        self.theta = theta
        self.gram: FloatArray = np.swapaxes(A, 1, 2) @ A
        self.bases: FloatArray = np.ascontiguousarray(np.swapaxes(A, 0, 1)).reshape(A.shape[1], -1)
        self.prior_cost: FloatArray = np.square(
            prior.residual_and_jacobian(theta)[0]).sum(axis=1)


@dataclass(frozen=True)
class SteadySearch:
    """Frames in which vehicles are sought, and what is known of them.

    The paths of m vehicles that are sought together stand in one row of 7 m numbers, and their
    moments in one of 9 m. In shapes n is the number of rows, y that of whitened measurements.
    """

    samples: PassSamples
    prior: PathPrior
    known: FloatArray
    """(y,) whitened field of the vehicles that are known."""
    columns: FloatArray
    """(y, q) whitened: what is not known of backgrounds and of those vehicles, each times its
    standard deviation."""

    @cached_property
    def _model(self) -> SteadyPass:
        """The row that is sought."""
        return self.samples.straight_model(N_DIPOLES)

    @cached_property
    def _without(self) -> MarginalWhitener:
        """Takes out what is not known."""
        return MarginalWhitener(self.columns)

    @cached_property
    def _y(self) -> FloatArray:
        """(y,) what is left to be explained."""
        return self._without(self.samples.y - self.known)

    def _solved(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Basis (n, y, 9 m), information (n, 9 m, 9 m), its inverse, and estimate (n, 9 m) of the
        moments of m vehicles on paths theta (n, 7 m).

        The inverse is NaN or meaningless for a path through a sensor.
        """
        basis = self._model.basis(theta.reshape(-1, N_STRAIGHT))
        A = self._without(_side_by_side(basis, _number_of(theta)))
        At = np.swapaxes(A, 1, 2)
        information = At @ A + np.diag(self._moment_std(theta)**-2.0)
        inverse = pseudo_inverse(information)
        return A, information, inverse, np.einsum('nij,nj->ni', inverse, At @ self._y)

    def _moment_std(self, theta: FloatArray) -> FloatArray:
        """(9 m,) of the moments of m vehicles on paths theta (n, 7 m)."""
        return np.tile(self.prior.moment_std, _number_of(theta))

    def cost(self, grid: StartGrid) -> FloatArray:
        """(n,) minus twice the log-density of the frames with a point on each path of a grid."""
        n, std = len(grid.theta), self.prior.moment_std[0] * np.sqrt(N_DIPOLES)
        with ignoring_overflow():
            factor = self._without.correction_factor(grid.bases).reshape(-1, n, 3).swapaxes(0, 1)
            information = grid.gram - factor.swapaxes(1, 2) @ factor + np.eye(3) / std**2
            b = (self._without(self._y) @ grid.bases).reshape(n, 3)
            p = np.einsum('nij,nj->ni', pseudo_inverse(information), b)
            # Residuals are not formed: this is faster, and exact enough to rank the starts.
            cost: FloatArray = float(self._y @ self._y) - np.einsum('ni,ni->n', p, b) \
                + grid.prior_cost + _log_determinant(information * std**2)
        return np.where(np.isfinite(cost), cost, np.inf)

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n, y + 16 m) of measurements, moments and paths theta (n, 7 m), and the
        Jacobians (n, y + 16 m, 7 m) of what is predicted, as by Kaufman (1975)."""
        n, m, std = len(theta), _number_of(theta), self._moment_std(theta)
        paths = theta.reshape(-1, N_STRAIGHT)
        A, _, inverse, p = self._solved(theta)
        derivative = self._model.derivative(paths, p.reshape(len(paths), -1))
        D = self._without(_side_by_side(derivative, m))
        moved = inverse @ (np.swapaxes(A, 1, 2) @ D)
        off, off_J = self.prior.residual_and_jacobian(paths)
        return (np.hstack([self._y - np.einsum('nyi,ni->ny', A, p), -p / std, off.reshape(n, -1)]),
                np.concatenate([D - A @ moved, -moved / std[:, None], _block_diagonal(off_J, m)],
                               axis=1))

    def refined(self, theta: FloatArray, n_steps: int = N_STEPS) -> tuple[FloatArray, FloatArray]:
        """Paths (n, 7 m) after steps of Levenberg and Marquardt, and costs (n,); infinite where a
        vehicle is slower than any that comes, goes backwards, or is not felt.

        Only its field keeps a path near the sensors: a step may throw a vehicle that explains
        nothing any distance away.
        """
        if not len(theta):
            return theta, np.zeros(0)
        path, cost, _, _ = refine(self.residual_and_jacobian, theta, n_steps, TOLERANCE)
        are_moving = (path[:, SPEED::N_STRAIGHT] >= self.prior.slowest).all(axis=1)
        return path, np.where(are_moving & self._are_felt(path), cost, np.inf)

    def best(self, grid: StartGrid, most: int) -> FloatArray:
        """At most so many paths (n, 7) that explain the frames best, the best one first."""
        path, cost = self.refined(_usable(grid.theta, self.cost(grid), APART_START, N_STARTS))
        return _usable(path, cost, APART, most)

    def moments(self, theta: FloatArray) -> FloatArray:
        """(m, 3, 3) [A m^2, world] moments of the rows on paths (7 m,), from the tail to the head.
        """
        _, _, _, p = self._solved(theta[None])
        moments: FloatArray = self._model.combinations @ p.reshape(-1, N_DIPOLES, 3)
        return moments

    def beside(self, path: FloatArray) -> 'SteadySearch':
        """The search for another vehicle, this one being known by about this path (7,)."""
        _, _, _, p = self._solved(path[None])
        return replace(self, columns=np.hstack([
            self.columns, self._model.basis(path[None])[0] * self.prior.moment_std,
            self._model.derivative(path[None], p)[0] * KNOWN_STD]))

    def pairs(self, grid: StartGrid, most: int, most_second: int) -> list[FloatArray]:
        """Pairs of paths (2, 7) that explain the frames, the best one first."""
        starts = [np.append(first, second) for first in self.best(grid, most)
                  for second in self.beside(first).best(grid, most_second)]
        pairs, cost = self.refined(np.array(starts).reshape(-1, 2 * N_STRAIGHT))
        cost = cost + self._log_determinant_of_moments(pairs)
        usable = np.isfinite(cost)
        if not usable.any():
            return []
        # Squares of the places of other pairs may overflow in the comparison of orders.
        pairs, cost = pairs[usable], cost[usable]
        best = pairs[np.argmin(cost)].reshape(2, -1)
        pairs = np.array([in_order_of(best, pair.reshape(2, -1)).ravel() for pair in pairs])
        return list(_usable(pairs, cost, np.tile(APART, 2), len(pairs)).reshape(-1, 2, N_STRAIGHT))

    def _log_determinant_of_moments(self, theta: FloatArray) -> FloatArray:
        """(n,) log-determinant of the information of the moments of paths (n, 7 m), relative to
        the prior."""
        with ignoring_overflow():
            return _log_determinant(self._information_of_moments(theta))

    def _are_felt(self, theta: FloatArray) -> BoolArray:
        """(n,) whether each vehicle of paths theta (n, 7 m) is expected to be felt in the frames,
        by the prior of its moments and beside what is not known."""
        with ignoring_overflow():
            energy = np.einsum('nii->ni', self._information_of_moments(theta)) - 1.0
        each = energy.reshape(len(theta), -1, 3 * N_DIPOLES).sum(axis=2)
        felt: BoolArray = (each > DETECTABLE_ENERGY).all(axis=1)
        return felt

    def _information_of_moments(self, theta: FloatArray) -> FloatArray:
        """(n, 9 m, 9 m) of the moments of paths (n, 7 m), where the prior has a unit matrix."""
        std = self._moment_std(theta)
        information: FloatArray = self._solved(theta)[1] * np.outer(std, std)
        return information


def _log_determinant(A: FloatArray) -> FloatArray:
    """(n,) of matrices (n, k, k); infinite of one that rounding has left indefinite."""
    sign, value = np.linalg.slogdet(A)
    return np.where(sign > 0.0, value, np.inf)


def _number_of(theta: FloatArray) -> int:
    """How many vehicles have their paths in a row of theta (n, 7 m)."""
    return theta.shape[1] // N_STRAIGHT


def _side_by_side(A: FloatArray, m: int) -> FloatArray:
    """Matrices (n, k, m c) of the `A` (n m, k, c) of m vehicles each."""
    n, k, c = len(A) // m, *A.shape[1:]
    return A.reshape(n, m, k, c).swapaxes(1, 2).reshape(n, k, m * c)


def _block_diagonal(A: FloatArray, m: int) -> FloatArray:
    """Matrices (n, m k, m c) with the `A` (n m, k, c) of m vehicles each as their blocks."""
    n, k, c = len(A) // m, *A.shape[1:]
    out = np.zeros((n, m, k, m, c))
    for i in range(m):
        out[:, i, :, i] = A.reshape(n, m, k, c)[:, i]
    return out.reshape(n, m * k, m * c)


def _usable(theta: FloatArray, cost: FloatArray, apart: FloatArray, most: int) -> FloatArray:
    """The best `most` paths (n, 7) that can be used, of which no two are the same."""
    usable = np.isfinite(cost)
    paths: FloatArray = theta[usable]
    return paths[distinct(paths, cost[usable], apart, most)]
