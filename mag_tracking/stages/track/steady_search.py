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

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import refine
from mag_tracking.inference.marginalised import Marginalised
from mag_tracking.inference.separable_fit import distinct
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.steady_pass import N_PATH, N_STRAIGHT, SteadyPass
from mag_tracking.stages.track.initiation_vehicle import VehicleSettings
from mag_tracking.stages.track.pass_samples import PassSamples

N_DIPOLES = 3
"""Dipoles of the rows that are sought: enough for a car near a sensor."""

STEP_ALONG, BEYOND = 3.0, 12.0
"""[m] The grid has positions this far apart, up to so far beyond the outermost sensor."""

LEAST_STD = 1e-3
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

ROUNDS, ROUND_STEPS = 3, 6
"""Two paths are refined in turn, so often and in so many steps, each with the other not known."""


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
            return float(m.mean()), max(float(np.sqrt(m.var() + np.square(s).mean())), LEAST_STD)

        height, height_std = spread(vehicle.heights, vehicle.height_stds)
        speeds = np.array(vehicle.speeds)
        speed, speed_std = spread(speeds, vehicle.speed_std * speeds)
        length, length_std = spread(vehicle.lengths, vehicle.length_stds)
        lateral_std = spread(vehicle.lateral_offsets, [vehicle.lateral_std])[1]
        total = np.sqrt(np.square(vehicle.moments).mean() / 3.0)
        difference = max(float(np.sqrt(np.square(vehicle.difference_stds).mean())), LEAST_STD)
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
                np.arange(-vehicle.farthest - reach, BEYOND + reach, STEP_ALONG), offsets, speeds,
                indexing='ij'))
            grid = np.tile(self.mean, (len(places), 1))
            grid[:, :2] = self.centre + places[:, None] * along \
                + y[:, None] * [-along[1], along[0]]
            grid[:, 3], grid[:, 4] = v, heading
            starts.append(grid)
        return np.vstack(starts)


@dataclass(frozen=True)
class SteadySearch:
    """Frames in which a vehicle is sought, and what is known of them."""

    samples: PassSamples
    prior: PathPrior
    known: FloatArray
    """(3 n,) whitened field of the vehicles that are known."""
    columns: FloatArray
    """(3 n, q) whitened: what is not known of backgrounds and of those vehicles, each times its
    standard deviation."""

    @cached_property
    def _without(self) -> Marginalised:
        """Takes out what is not known."""
        return Marginalised(self.columns)

    @cached_property
    def _y(self) -> FloatArray:
        """(3 n,) what is left to be explained."""
        return self._without(self.samples.y - self.known)

    def _model(self, n_dipoles: int) -> SteadyPass:
        """The row that is sought."""
        s = self.samples
        return SteadyPass(s.t, s.positions, s.M, np.full(len(s.t), -1), np.arange(N_STRAIGHT),
                          np.zeros(N_PATH), n_dipoles)

    def _solved(self, theta: FloatArray, moment_std: FloatArray) -> tuple[
            SteadyPass, FloatArray, FloatArray, FloatArray]:
        """Model, basis (n, 3 n, k), information (n, k, k) and estimate (n, k) of the moments."""
        model = self._model(len(moment_std) // 3)
        A = self._without(model.basis(theta))
        At = np.swapaxes(A, 1, 2)
        information = At @ A + np.diag(moment_std**-2.0)
        p = np.asarray(np.linalg.solve(information, (At @ self._y)[:, :, None])[:, :, 0],
                       dtype=np.float64)
        return model, A, information, p

    def cost(self, theta: FloatArray) -> FloatArray:
        """(n,) minus twice the log-density of the frames with a point on paths theta (n, 7)."""
        std = np.full(3, self.prior.moment_std[0] * np.sqrt(N_DIPOLES))
        _, A, information, p = self._solved(theta, std)
        residual = self._y - np.einsum('nyi,ni->ny', A, p)
        off, _ = self.prior.residual_and_jacobian(theta)
        cost: FloatArray = (residual**2).sum(axis=1) + np.square(p / std).sum(axis=1) \
            + (off**2).sum(axis=1) + np.linalg.slogdet(information * np.outer(std, std))[1]
        return np.where(np.isfinite(cost), cost, np.inf)

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of measurements, moments and path; with the Jacobian of Kaufman (1975)."""
        std = self.prior.moment_std
        model, A, information, p = self._solved(theta, std)
        D = self._without(model.derivative(theta, p))
        moved = np.linalg.solve(information, np.swapaxes(A, 1, 2) @ D)
        off, off_J = self.prior.residual_and_jacobian(theta)
        return (np.hstack([self._y - np.einsum('nyi,ni->ny', A, p), -p / std, off]),
                np.concatenate([D - A @ moved, -moved / std[:, None], off_J], axis=1))

    def refined(self, theta: FloatArray, n_steps: int = N_STEPS) -> tuple[FloatArray, FloatArray]:
        """Paths (n, 7) after steps of Levenberg and Marquardt, and costs (n,); infinite where a
        vehicle stands, or goes backwards."""
        path, cost, _, _ = refine(self.residual_and_jacobian, theta, n_steps, TOLERANCE)
        return path, np.where(path[:, 3] >= self.prior.slowest, cost, np.inf)

    def best(self, starts: FloatArray, most: int) -> FloatArray:
        """At most so many paths (n, 7) that explain the frames best, the best one first."""
        path, cost = self.refined(_usable(starts, self.cost(starts), APART_START, N_STARTS))
        return _usable(path, cost, APART, most)

    def moments(self, path: FloatArray) -> FloatArray:
        """(3, 3) [A m^2, world] moments of the row on a path (7,), from the tail to the head."""
        model, _, _, p = self._solved(path[None], self.prior.moment_std)
        moments: FloatArray = model.combinations @ p[0].reshape(-1, 3)
        return moments

    def beside(self, path: FloatArray) -> 'SteadySearch':
        """The search for another vehicle, this one being known by about this path (7,)."""
        model, _, _, p = self._solved(path[None], self.prior.moment_std)
        return replace(self, columns=np.hstack([
            self.columns, model.basis(path[None])[0] * self.prior.moment_std,
            model.derivative(path[None], p)[0] * KNOWN_STD]))

    def pairs(self, starts: FloatArray, most: int, most_second: int) -> list[FloatArray]:
        """Pairs of paths (2, 7) that explain the frames, the best one first."""
        found: list[tuple[float, FloatArray]] = []
        for first in self.best(starts, most):
            for second in self.beside(first).best(starts, most_second):
                pair = self._refined_in_turn(first, second)
                found.append((self._cost_of_pair(pair), pair))
        return [pair for cost, pair in sorted(found, key=lambda f: f[0]) if np.isfinite(cost)]

    def _refined_in_turn(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Both paths (2, 7), each refined a little while the other is not known."""
        for _ in range(ROUNDS):
            first = self.beside(second).refined(first[None], ROUND_STEPS)[0][0]
            second = self.beside(first).refined(second[None], ROUND_STEPS)[0][0]
        return np.array([first, second])

    def _cost_of_pair(self, pair: FloatArray) -> float:
        """Minus twice the log-density of the frames with both rows."""
        bases = self._model(N_DIPOLES).basis(pair) * self.prior.moment_std
        without = Marginalised(np.hstack([self.columns, *bases]))
        left = without(self.samples.y - self.known)
        off, _ = self.prior.residual_and_jacobian(pair)
        cost = float(left @ left + without.log_determinant + (off**2).sum())
        return cost if (pair[:, 3] >= self.prior.slowest).all() else np.inf


def _usable(theta: FloatArray, cost: FloatArray, apart: FloatArray, most: int) -> FloatArray:
    """The best `most` paths (n, 7) that can be used, of which no two are the same."""
    usable = np.isfinite(cost)
    paths: FloatArray = theta[usable]
    return paths[distinct(paths, cost[usable], apart, most)]
