"""Search for vehicles on straight paths in the frames of a window, given known vehicles.

The linear terms have Gaussian priors and are marginalised: moments, backgrounds, and errors of
known vehicles. Source: TSP14 sections III.A and V for the row of dipoles; variable projection.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import distinct, refine
from mag_tracking.inference.matrices import MarginalWhitener, ignoring_overflow, pseudo_inverse
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.passes import N_STRAIGHT, PATH, SteadyPass
from mag_tracking.stages.track import initiation_vehicle
from mag_tracking.stages.track.bank_filter import DETECTABLE_ENERGY
from mag_tracking.stages.track.initiation_vehicle import LATERAL_STD, SPEED_STD, VehicleSettings
from mag_tracking.stages.track.pass_samples import PassSamples

N_DIPOLES = 3
"""Number of dipoles of the rows in the search; sufficient for a car near a sensor."""
GRID_STEP, GRID_MARGIN = 3.0, 12.0
"""[m] Spacing of the grid along an arrival line, and its range beyond the last sensor."""
SPEED_COLUMN = PATH.index('speed')
"""Column of the speed in a path."""
MIN_STD = 1e-3
"""[m], [m/s], [A m^2] Minimum std of a parameter without a spread in the settings."""
MIN_SPEED_RATIO = 0.2
"""Minimum speed of an arriving vehicle, relative to the lowest starting speed."""
N_STARTS, N_STEPS, TOLERANCE = 10, 12, 1e-3
"""Maximum numbers of refined starts and of steps, and relative improvement that ends them."""
START_TOLERANCE: FloatArray = np.array([4.0, 2.5, 1.0, 5.0, 0.3, 1.0, 3.0])
PATH_TOLERANCE: FloatArray = np.array([1.0, 1.0, 1.0, 2.0, 0.3, 1.0, 9.0])
"""[m], [m/s], [rad] Differences up to which two starts, or two refined paths, are identical."""
FIRST_PATH_STD: FloatArray = np.array([2.0, 1.5, 0.2, 3.0, 0.1, 0.1, 1.5])
"""[m], [m/s], [rad] Std of the path of the first vehicle in a search for a second."""


@dataclass(frozen=True)
class PathPrior:
    """Prior of the path and the moments of a vehicle."""

    headings: FloatArray
    """(n,) [rad] Headings of the arrival lines."""
    centre: FloatArray
    """(2,) [m] Point through which all arrival lines pass."""
    mean: FloatArray
    """(7,) Mean of a straight path; position and heading are relative to the nearest line."""
    std: FloatArray
    """(7,) Standard deviations about `mean`; infinite for the position along the line."""
    moment_std: FloatArray
    """(3 d,) [A m^2] Standard deviations of the orthogonal combinations of the dipole moments."""
    min_speed: float
    """[m/s] Minimum speed of an arriving vehicle. A slower vehicle was already near the sensors."""

    @classmethod
    def of(cls, vehicle: VehicleSettings, network: SensorNetwork) -> 'PathPrior':
        """Common prior of all kinds of vehicle in the settings."""
        def spread(means: Iterable[float], stds: Iterable[float]) -> tuple[float, float]:
            m, s = np.array(means, dtype=float), np.array(stds, dtype=float)
            return float(m.mean()), max(float(np.sqrt(m.var() + np.square(s).mean())), MIN_STD)

        kinds = vehicle.kinds
        height, height_std = spread([k.height for k in kinds], [k.height_std for k in kinds])
        speeds = np.array(vehicle.speeds)
        speed, speed_std = spread(speeds, SPEED_STD * speeds)
        length, length_std = spread([k.length for k in kinds], [k.length_std for k in kinds])
        lateral_std = spread(vehicle.lateral_offsets, [LATERAL_STD])[1]
        total = np.sqrt(np.square([k.moment for k in kinds]).mean() / 3.0)
        difference = max(float(np.sqrt(np.square(
            [k.difference_std for k in kinds]).mean())), MIN_STD)
        # The first combination is the mean of the row times the root of the number of dipoles.
        return cls(np.deg2rad(vehicle.arrival_headings_deg), network.centre[:2],
                   np.array([0.0, 0.0, height, speed, 0.0, 0.0, length]),
                   np.array([np.inf, lateral_std, height_std, speed_std,
                             initiation_vehicle.CROSS_SPEED_STD, initiation_vehicle.CLIMB_STD,
                             length_std]),
                   np.repeat([total / np.sqrt(N_DIPOLES)] + [difference] * (N_DIPOLES - 1), 3),
                   MIN_SPEED_RATIO * min(vehicle.speeds))

    def nearest_line(self, theta: FloatArray) -> tuple[IntArray, FloatArray]:
        """Arrival line (n,) nearest in heading to paths (n, 7), and relative heading."""
        relative_headings = (theta[:, 4, None] - self.headings + np.pi) % (2.0 * np.pi) - np.pi
        line: IntArray = np.abs(relative_headings).argmin(axis=1)
        return line, relative_headings[np.arange(len(theta)), line]

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normalised residuals (n, 7) of paths, and negative derivatives."""
        line, relative_heading = self.nearest_line(theta)
        normals = np.stack([-np.sin(self.headings), np.cos(self.headings)], axis=1)[line]
        relative = theta.copy()
        relative[:, 1] = np.einsum('ni,ni->n', theta[:, :2] - self.centre, normals)
        relative[:, 4] = relative_heading
        J = np.tile(np.diag(1.0 / self.std), (len(theta), 1, 1))
        J[:, 1, :2] = normals / self.std[1]
        return (self.mean - relative) / self.std, J

    def starts(self, vehicle: VehicleSettings, network: SensorNetwork) -> FloatArray:
        """Grid (n, 7) of start paths, whose positions cover the arrival lines near sensors."""
        offsets = np.array(vehicle.lateral_offsets)
        offsets = np.unique(np.append(offsets, 0.5 * (offsets[1:] + offsets[:-1])))
        speeds = np.array(vehicle.speeds)
        speeds = np.unique(np.append(speeds, np.sqrt(speeds[1:] * speeds[:-1])))
        starts = []
        for heading in self.headings:
            along = np.array([np.cos(heading), np.sin(heading)])
            sensors = (network.positions[:, :2] - self.centre) @ along
            half_length = float(np.abs(sensors).max())
            x = np.arange(-initiation_vehicle.MAX_START_DISTANCE - half_length,
                          GRID_MARGIN + half_length, GRID_STEP)
            # No sensor senses a vehicle in a wide gap between the sensors.
            distance = np.abs(x[:, None] - sensors).min(axis=1)
            x = x[distance <= initiation_vehicle.MAX_START_DISTANCE + GRID_MARGIN]
            x, y, v = (a.ravel() for a in np.meshgrid(x, offsets, speeds, indexing='ij'))
            grid = np.tile(self.mean, (len(x), 1))
            grid[:, :2] = self.centre + x[:, None] * along \
                + y[:, None] * [-along[1], along[0]]
            grid[:, 3], grid[:, 4] = v, heading
            starts.append(grid)
        return np.vstack(starts)


class StartGrid:
    """Grid of start paths `theta` (n, 7), with the field of a point target on each path.

    `bases` (3 n_samples, 3 n) are whitened fields of unit moments A, `gram` (n, 3, 3) are A'A, and
    `prior_cost` (n,) is the squared normalised difference from the mean of the prior.
    """

    def __init__(self, samples: PassSamples, prior: PathPrior, theta: FloatArray) -> None:
        A = samples.straight_model(1).basis(theta)
        self.theta = theta
        self.gram: FloatArray = np.swapaxes(A, 1, 2) @ A
        self.bases: FloatArray = np.ascontiguousarray(np.swapaxes(A, 0, 1)).reshape(A.shape[1], -1)
        self.prior_cost: FloatArray = np.square(
            prior.residual_and_jacobian(theta)[0]).sum(axis=1)


@dataclass(frozen=True)
class SteadySearch:
    """Search for vehicles in the samples of a window, given the known vehicles; n are joint paths
    of m vehicles, with 7 m parameters and 9 m moments, and y whitened measurements."""

    samples: PassSamples
    prior: PathPrior
    known: FloatArray
    """(y,) Whitened field of the known vehicles."""
    columns: FloatArray
    """(y, q) Whitened field of one std of each background or error of known vehicles."""

    @cached_property
    def _model(self) -> SteadyPass:
        """Row of dipoles that models a vehicle in the search."""
        return self.samples.straight_model(N_DIPOLES)

    @cached_property
    def _marginal_whitener(self) -> MarginalWhitener:
        """Whitening that marginalises the nuisance terms in `columns`."""
        return MarginalWhitener(self.columns)

    @cached_property
    def _y(self) -> FloatArray:
        """Field (y,) to be explained: without known vehicles, and with marginal whitening."""
        return self._marginal_whitener(self.samples.y - self.known)

    def _solve(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Whitened fields of unit moments (n, y, 9 m) of vehicles on paths, information matrices of
        the moments (n, 9 m, 9 m), their inverses (NaN at a sensor), and the moments (n, 9 m)."""
        basis = self._model.basis(theta.reshape(-1, N_STRAIGHT))
        A = self._marginal_whitener(_joined_columns(basis, theta.shape[1] // N_STRAIGHT))
        At = np.swapaxes(A, 1, 2)
        information = At @ A + np.diag(self._moment_std(theta)**-2.0)
        inverse = pseudo_inverse(information)
        return A, information, inverse, np.einsum('nij,nj->ni', inverse, At @ self._y)

    def _moment_std(self, theta: FloatArray) -> FloatArray:
        """Prior standard deviations (9 m,) of the moments of m vehicles."""
        return np.tile(self.prior.moment_std, theta.shape[1] // N_STRAIGHT)

    def cost(self, grid: StartGrid) -> FloatArray:
        """Cost (n,) of a point target on each path of a grid: -2 log-density + constant."""
        n, std = len(grid.theta), self.prior.moment_std[0] * np.sqrt(N_DIPOLES)
        with ignoring_overflow():
            factor = self._marginal_whitener.correction_factor(grid.bases).reshape(
                -1, n, 3).swapaxes(0, 1)
            information = grid.gram - factor.swapaxes(1, 2) @ factor + np.eye(3) / std**2
            b = (self._marginal_whitener(self._y) @ grid.bases).reshape(n, 3)
            p = np.einsum('nij,nj->ni', pseudo_inverse(information), b)
            # Residuals are not computed: this is faster, and accurate enough to rank the starts.
            cost: FloatArray = float(self._y @ self._y) - np.einsum('ni,ni->n', p, b) \
                + grid.prior_cost + _log_determinant(information * std**2)
        return np.where(np.isfinite(cost), cost, np.inf)

    def residual_and_jacobian(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n, y + 16 m) of measurements, moments and paths (n, 7 m), with the Jacobian of
        Kaufman (1975), the derivative (n, y + 16 m, 7 m) of the negative residual."""
        n, m, std = len(theta), theta.shape[1] // N_STRAIGHT, self._moment_std(theta)
        paths = theta.reshape(-1, N_STRAIGHT)
        A, _, inverse, p = self._solve(theta)
        derivative = self._model.derivative(paths, p.reshape(len(paths), -1))
        D = self._marginal_whitener(_joined_columns(derivative, m))
        moment_jacobian = inverse @ (np.swapaxes(A, 1, 2) @ D)
        prior_residual, prior_J = self.prior.residual_and_jacobian(paths)
        return (np.hstack([self._y - np.einsum('nyi,ni->ny', A, p), -p / std,
                           prior_residual.reshape(n, -1)]),
                np.concatenate([D - A @ moment_jacobian, -moment_jacobian / std[:, None],
                                _block_diagonal(prior_J, m)], axis=1))

    def refined(self, theta: FloatArray, n_steps: int = N_STEPS) -> tuple[FloatArray, FloatArray]:
        """Paths (n, 7 m) refined by Levenberg-Marquardt steps, and costs (n,): infinite if a
        vehicle is too slow, moves backwards, or is too far along the line to be detectable."""
        if not len(theta):
            return theta, np.zeros(0)
        path, cost, _, _ = refine(self.residual_and_jacobian, theta, n_steps, TOLERANCE)
        are_moving = (path[:, SPEED_COLUMN::N_STRAIGHT] >= self.prior.min_speed).all(axis=1)
        with ignoring_overflow():
            # Energies in the window that the prior of the moments predicts.
            energy = np.einsum('nii->ni', self._information_of_moments(path)) - 1.0
        vehicle_energy = energy.reshape(len(path), -1, 3 * N_DIPOLES).sum(axis=2)
        are_detectable = (vehicle_energy > DETECTABLE_ENERGY).all(axis=1)
        return path, np.where(are_moving & are_detectable, cost, np.inf)

    def best(self, grid: StartGrid, max_paths: int) -> FloatArray:
        """At most `max_paths` paths (n, 7) of one vehicle that explain the frames best."""
        path, cost = self.refined(
            _best_distinct(grid.theta, self.cost(grid), START_TOLERANCE, N_STARTS))
        return _best_distinct(path, cost, PATH_TOLERANCE, max_paths)

    def moments(self, theta: FloatArray) -> FloatArray:
        """Moments (m, 3, 3) on paths (7 m,), from tail to head, A m², world frame."""
        _, _, _, p = self._solve(theta[None])
        return self._model.combinations @ p.reshape(-1, N_DIPOLES, 3)

    def beside(self, path: FloatArray) -> 'SteadySearch':
        """Search for another vehicle beside a found one on an approximate path (7,)."""
        _, _, _, p = self._solve(path[None])
        return replace(self, columns=np.hstack([
            self.columns, self._model.basis(path[None])[0] * self.prior.moment_std,
            self._model.derivative(path[None], p)[0] * FIRST_PATH_STD]))

    def pairs(self, grid: StartGrid, max_paths: int, max_second: int) -> list[FloatArray]:
        """Pairs of paths (2, 7) that explain the frames best, the best first; at most `max_paths`
        first paths, and `max_second` second paths for each, are tried."""
        starts = [np.append(first, second) for first in self.best(grid, max_paths)
                  for second in self.beside(first).best(grid, max_second)]
        pairs, cost = self.refined(np.array(starts).reshape(-1, 2 * N_STRAIGHT))
        with ignoring_overflow():
            cost = cost + _log_determinant(self._information_of_moments(pairs))
        is_usable = np.isfinite(cost)
        if not is_usable.any():
            return []
        # Unusable pairs are dropped first, because squares of their positions may overflow.
        pairs, cost = pairs[is_usable], cost[is_usable]
        best = pairs[np.argmin(cost)].reshape(2, -1)
        pairs = np.array([in_order_of(best, pair.reshape(2, -1)).ravel() for pair in pairs])
        return list(_best_distinct(pairs, cost, np.tile(PATH_TOLERANCE, 2), len(pairs)).reshape(
            -1, 2, N_STRAIGHT))

    def _information_of_moments(self, theta: FloatArray) -> FloatArray:
        """Information matrices (n, 9 m, 9 m) of the moments, in units of the prior information."""
        std = self._moment_std(theta)
        return self._solve(theta)[1] * np.outer(std, std)


def _log_determinant(A: FloatArray) -> FloatArray:
    """Log-determinants (n,) of matrices (n, k, k); infinite if the determinant is not positive."""
    sign, value = np.linalg.slogdet(A)
    return np.where(sign > 0.0, value, np.inf)


def _joined_columns(A: FloatArray, m: int) -> FloatArray:
    """Columns (n, k, m c) of `m` successive matrices of `A` (n m, k, c), side by side."""
    n, k, c = len(A) // m, *A.shape[1:]
    return A.reshape(n, m, k, c).swapaxes(1, 2).reshape(n, k, m * c)


def _block_diagonal(A: FloatArray, m: int) -> FloatArray:
    """Block-diagonal matrices (n, m k, m c), each of `m` successive blocks of `A` (n m, k, c)."""
    n, k, c = len(A) // m, *A.shape[1:]
    out = np.zeros((n, m, k, m, c))
    for i in range(m):
        out[:, i, :, i] = A.reshape(n, m, k, c)[:, i]
    return out.reshape(n, m * k, m * c)


def _best_distinct(theta: FloatArray, cost: FloatArray, tolerance: FloatArray, n_max: int
                   ) -> FloatArray:
    """At most `n_max` distinct rows of `theta` with a finite cost, the best first."""
    is_usable = np.isfinite(cost)
    paths: FloatArray = theta[is_usable]
    return paths[distinct(paths, cost[is_usable], tolerance, n_max)]


def in_order_of(first: FloatArray, pair: FloatArray) -> FloatArray:
    """Pair of paths (2, 7) in the order that matches another pair best, by distance."""
    d = np.linalg.norm(pair[:, None, :2] - first[:, :2], axis=2)
    return pair if d[0, 0] + d[1, 1] <= d[0, 1] + d[1, 0] else pair[::-1].copy()
