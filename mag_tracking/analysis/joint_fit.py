"""Joint batch fit of several targets whose fields overlap, and the choice of their number.

The targets are first modelled as points. One search starts at the tracked positions. A second
search adds the targets one by one where the residual field is strongest. The number of dipoles of
each target is then selected.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from mag_tracking.analysis import pass_fit
from mag_tracking.analysis.fitted_pass import order_criteria
from mag_tracking.analysis.pass_data import PassData, background_columns, separable_problem
from mag_tracking.analysis.pass_description import PATH_TOLERANCE, assignment, fits_at_minimum
from mag_tracking.analysis.pass_result import MAX_COST_RATIO, PassFit
from mag_tracking.analysis.pass_trust import has_plausible_residual
from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.geometry import overlap, propagated_path
from mag_tracking.inference.least_squares import coarse_minima, fine_minimum, refine
from mag_tracking.physics.passes import SuperposedPasses
from mag_tracking.units import NS

N_REFINED, N_STEPS, N_CONVERGED, N_FINE_STARTS = 150, 6, 10, 2
"""Number of starting points that are refined in the coarse search, steps of each, number of coarse
solutions that are refined until convergence, and of those from which the final fit starts."""
INITIAL_LENGTH = 3.0
"""[m] Initial length of a row of dipoles that replaces a point."""
MIN_GAP, VEHICLE_WIDTH = 3.0, 1.5
"""[m] Minimum distance between the rows of two vehicles, along and across their heading."""
MAX_DETECTION_RANGE = 15.0
"""[m] Maximum distance at which a sensor detects a target."""
MAX_ROUNDS = 3
"""Maximum number of rounds of the order selection, each of all targets in turn."""
MAX_VELOCITY_DIFFERENCE, MAX_TRACK_DISTANCE = 0.5, 5.0
"""Maximum relative difference of velocity, and distance [m], of two fits, or of fit and track."""
MAX_TARGETS = 3
"""Maximum number of targets in a joint fit, each with about twelve unknowns."""
MAX_LENGTH = 18.75
"""[m] Maximum length of the iron of one vehicle: the limit for road trains (Directive 96/53/EC)."""
MAX_VELOCITY_SPREAD = 0.25
"""Maximum relative difference of the velocity of a part of a vehicle from the mean of all parts."""


@dataclass(frozen=True)
class GroundPrior:
    """Prior of the height and vertical speed of vehicles, without which two targets that leave the
    ground can explain a single target that turns."""

    height: tuple[float, float]
    """Height of the magnetic centre above z = 0 and its standard deviation [m]."""
    climb_std: float
    """Standard deviation of the vertical speed [m/s]; its mean is zero."""

    def prior(self, orders: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Prior mean and std (n_theta,) of paths of rows of dipoles, 0 and inf without a prior."""
        first = np.append(0, np.cumsum([6 + (n > 1) for n in orders]))
        mean, std = np.zeros(first[-1]), np.full(first[-1], np.inf)
        mean[first[:-1] + 2], std[first[:-1] + 2] = self.height
        std[first[:-1] + 5] = self.climb_std
        return mean, std


def fit_joint(data: PassData, paths: FloatArray, ground: GroundPrior,
              orders: Sequence[int] = (1, 2, 3, 4),
              stopped: Callable[[], bool] | None = None) -> tuple[tuple[PassFit, ...], ...]:
    """Fit several rows of dipoles, each at constant velocity, to the sum of their fields.

    Returns, for each target, one fit per candidate order that has enough measurements; the other
    targets then have their selected orders. Targets are sorted by the time at which they pass the
    centre of the sensors; time zero is at the strongest field of each. `reason` is set if the best
    fit of a target differs from its track, or another fit from the best fit. Empty if there are too
    few measurements or `stopped()` was true. `paths` (K, 6) are approximate positions [m] at time
    zero of `data` and velocities [m/s].
    """
    n_targets, begin_ns = len(paths), data.stamp_ns
    orders = [n for n in orders if not pass_fit.unusable_reason(data, n_targets * (n,))]
    if not orders:
        return ()
    data, averaged = pass_fit.centred_on_peak(data)
    paths = propagated_path(paths, (data.stamp_ns - begin_ns) / NS)
    initial_paths = np.vstack([paths.ravel(), _initial_paths(averaged, n_targets, ground)])
    fits = _JointFits(data, averaged, initial_paths, ground)
    selected_orders = [min(orders, key=lambda n: (abs(n - 2), n))] * n_targets
    for _ in range(MAX_ROUNDS):
        previous_orders = list(selected_orders)
        for k in range(n_targets):
            if stopped is not None and stopped():
                return ()
            criteria = order_criteria(fits.of_target(k, selected_orders, orders))
            if np.isfinite(criteria).any():
                selected_orders[k] = orders[int(np.argmin(criteria))]
        if selected_orders == previous_orders:
            break
    finished = []
    for k, n in enumerate(selected_orders):
        target_fits = fits.of_target(k, selected_orders, orders)
        finished.append(_finished(target_fits, orders.index(n), paths[k]))
    return tuple(target_fits for _, target_fits in sorted(finished, key=lambda pair: pair[0]))


def _initial_paths(averaged: PassData, n_targets: int, ground: GroundPrior) -> FloatArray:
    """Search for the solutions (n, 6 n_targets) with point targets that fit averaged data best."""
    paths: FloatArray = np.zeros((1, 0))
    residuals = [averaged]
    for n in range(1, n_targets + 1):
        orders = n * (1,)
        create_model, prior = partial(SuperposedPasses.from_orders, orders), ground.prior(orders)
        starts = [np.hstack([np.tile(known_path, (len(target_starts), 1)), target_starts])
                  for known_path, target_starts in zip(
                      paths, (pass_fit.starting_paths(r, 1) for r in residuals), strict=True)]
        coarse = separable_problem(averaged, create_model, prior=prior)
        smooth = separable_problem(averaged, create_model, pass_fit.COARSE_ERROR, prior)
        paths, _ = coarse_minima(smooth, coarse, np.concatenate(starts), np.tile(
            PATH_TOLERANCE[:6], n), N_REFINED, N_STEPS, N_CONVERGED)
        if n < n_targets:
            model = create_model(averaged.t, averaged.positions,
                                 averaged.network.R_sw[averaged.sensor])
            residuals = [replace(averaged, field=averaged.field - (
                model.basis(path[None])[0] @ coarse.linear(path)).reshape(-1, 3))
                for path in paths]
    return paths


class _JointFits:
    """Cached joint fits of several targets, for any combination of their numbers of dipoles.

    Each fit starts at the point-target solutions `initial_paths` (n, 6 K), the first of which is
    the tracked paths, and at the fit of the current combination if available.
    """

    def __init__(self, data: PassData, averaged: PassData, initial_paths: FloatArray,
                 ground: GroundPrior) -> None:
        self._data, self._averaged, self._ground = data, averaged, ground
        # Sort the targets of each solution in the order of the tracks.
        split = [np.split(paths, paths.size // 6) for paths in initial_paths]
        self._initial_paths = [[paths[i] for i in assignment(split[0], paths)] for paths in split]
        self._noise_dof = data.n_independent - background_columns(data, data.whitening).shape[1]
        self._cache: dict[tuple[int, ...], tuple[PassFit, ...]] = {}

    def of_target(self, k: int, orders: Sequence[int],
                  candidates: Sequence[int]) -> tuple[PassFit, ...]:
        """Fits of target `k` with each of `candidates`, while the others have their `orders`."""
        previous, fits = self._cache.get(tuple(orders)), []
        for n in candidates:
            combination = (*orders[:k], n, *orders[k + 1:])
            if combination not in self._cache:
                self._cache[combination] = self._fit(
                    combination, self._starting_paths(combination, k, previous))
            fits.append(self._cache[combination][k])
        return tuple(fits)

    def _starting_paths(self, orders: tuple[int, ...], k: int,
                        previous: Sequence[PassFit] | None) -> FloatArray:
        """Starting paths (n, n_theta) for given numbers of dipoles; `previous` is a joint fit, if
        any, that may differ in that of target `k`."""
        starts = [_with_orders(paths, orders) for paths in self._initial_paths]
        if previous is not None and all(len(fit.x) for fit in previous):
            paths = _with_orders([fit.x[:6 + (fit.n_dipoles > 1)] for fit in previous], orders)
            rows = [paths[k], *(pass_fit.shorter_rows(paths[k]) if orders[k] > 1 else ())]
            starts += [[*paths[:k], row, *paths[k + 1:]] for row in rows]
        return np.array([np.concatenate(paths) for paths in starts])

    def _fit(self, orders: tuple[int, ...], starts: FloatArray) -> tuple[PassFit, ...]:
        """Fit all targets jointly; return the `PassFit` of each target."""
        data, create_model = self._data, partial(SuperposedPasses.from_orders, orders)
        prior, split = self._ground.prior(orders), create_model(
            data.t, data.positions, data.whitening).split
        coarse, fine = (separable_problem(d, create_model, prior=prior)
                        for d in (self._averaged, data))
        theta, cost, _, _ = refine(coarse.residual_and_jacobian, starts, 40, 1e-6)
        in_order = tuple(range(len(orders)))
        cost = _exclude_solutions(cost, np.array([
            assignment(self._initial_paths[0], split(solution)) == in_order
            for solution in theta]), np.inf)
        # If all minima without overlap are much worse, keep those with overlap; `fit_targets`
        # rejects them.
        cost = _exclude_solutions(cost, np.array([are_separate(self._averaged, split(solution))
                                                  for solution in theta]), MAX_COST_RATIO)
        minimum = fine_minimum(fine, theta, cost, np.concatenate(
            [PATH_TOLERANCE[:6 + (n > 1)] for n in orders]), N_FINE_STARTS)
        if not np.isfinite(minimum.cost):
            return tuple(PassFit(n, data, 'no valid start of the search') for n in orders)
        theta, p = create_model(data.t, data.positions, data.whitening).with_nonnegative_length(
            minimum.theta, fine.linear(minimum.theta))
        unexplained = max(minimum.cost - self._noise_dof, 0.0) / (fine.energy - self._noise_dof)
        return fits_at_minimum(data, orders, replace(minimum, theta=theta), p, 1.0 - unexplained,
                               pass_fit.DEFAULT_ERRORS, path_std=prior[1])


def _exclude_solutions(cost: FloatArray, is_allowed: BoolArray, max_ratio: float) -> FloatArray:
    """Set the costs (n,) of disallowed solutions to infinity, unless every allowed cost exceeds
    `max_ratio` times the lowest cost."""
    has_allowed = (cost[is_allowed] <= max_ratio * cost.min()).any()
    return np.where(is_allowed, cost, np.inf) if has_allowed else cost


def are_separate(data: PassData, paths: Sequence[FloatArray], min_gap: float = MIN_GAP) -> bool:
    """Whether targets, with paths (6 or 7,), do not overlap within range of the sensors; `min_gap`
    [m] is the gap along the heading."""
    positions = [path[:3] + data.t[:, None] * path[3:6] for path in paths]
    is_detected = np.any([np.linalg.norm(position - data.positions, axis=1) < MAX_DETECTION_RANGE
                          for position in positions], axis=0)
    for i, k in combinations(range(len(paths)), 2):
        distance = min_gap + 0.5 * sum(abs(path[6]) for path in (paths[i], paths[k])
                                       if len(path) > 6)
        velocity = np.array([np.tile(paths[j][3:6], (len(data.t), 1)) for j in (i, k)])
        if overlap(np.array([positions[i], positions[k]]), velocity, distance,
                   VEHICLE_WIDTH)[is_detected].any():
            return False
    return True


def path_from(data: PassData, fit: PassFit) -> FloatArray:
    """Path (6 or 7,) of a fit, propagated to time zero of `data`."""
    return propagated_path(fit.x[:6 + (fit.n_dipoles > 1)],
                           (data.stamp_ns - fit.data.stamp_ns) / NS)


def _with_orders(paths: Sequence[FloatArray], orders: Sequence[int]) -> list[FloatArray]:
    """Convert paths (6 or 7,) to points or rows; a new row has the length `INITIAL_LENGTH`."""
    return [np.concatenate([path[:6], path[6:] if len(path) > 6 else [INITIAL_LENGTH]])
            if n > 1 else path[:6] for path, n in zip(paths, orders, strict=True)]


def _finished(fits: Sequence[PassFit], best: int,
              path: FloatArray) -> tuple[float, tuple[PassFit, ...]]:
    """Shift time zero of the fits of one target to the strongest field of the `best` fit, and
    reject the fits that differ: `best` from the tracked `path` (6,), others from `best`.

    Returns also the time [s since 1970] at which `best` is closest to the centre of the sensors.
    """
    fit, checked = fits[best], []
    if not len(fit.x):
        return np.inf, tuple(fits)
    for other in fits:
        reason = 'the fit differs from the track in position or velocity' if other is fit else \
            f'the path differs from the selected fit (number of dipoles: {fit.n_dipoles})'
        agrees = other.reason or _agrees_with_path(other, path if other is fit else fit.x)
        checked.append(other if agrees else replace(other, reason=reason, trusted=()))
    centre = fit.data.network.positions[fit.data.sensors].mean(axis=0)
    cpa_time = fit.data.stamp_ns / NS + fit.closest_approach(centre)[0]
    seconds = _fitted_peak_s(fit)
    return cpa_time, tuple(f.shifted(seconds) if len(f.x) else f for f in checked)


def _agrees_with_path(fit: PassFit, path: FloatArray) -> bool:
    """Whether a fit agrees at its strongest field with a path (6 or more,), same time zero."""
    if not len(fit.x):
        return False
    seconds = _fitted_peak_s(fit)
    offset = propagated_path(fit.x, seconds)[:2] - propagated_path(path, seconds)[:2]
    return bool(np.linalg.norm(offset) <= MAX_TRACK_DISTANCE and np.linalg.norm(
        fit.velocity - path[3:6]) <= MAX_VELOCITY_DIFFERENCE * np.linalg.norm(path[3:6]))


def _fitted_peak_s(fit: PassFit) -> float:
    """Time [s] at which the fitted field of a target is strongest."""
    return replace(fit.data, field=fit.predicted).peak_s


def fit_targets(data: PassData, single_fits: Sequence[PassFit], paths: FloatArray,
                ground: GroundPrior, orders: Sequence[int],
                stopped: Callable[[], bool] | None = None) -> tuple[tuple[PassFit, ...], ...]:
    """Select between a fit of a pass as one target and a joint fit of the tracked targets.

    A long row of dipoles can explain two vehicles in a line, and two targets on straight paths a
    single one that turns. `single_fits`, one for each number of dipoles, are returned if one target
    explains the field equally well, or if the fitted targets are parts of one vehicle (long
    vehicles are sometimes tracked as two), and with a reason if the joint fit is impossible or is
    rejected.
    """
    n_targets = len(paths)
    if n_targets < 2 or len(data.sensors) < 2:
        return (tuple(single_fits),)
    if n_targets > MAX_TARGETS:
        return (_reject(single_fits, n_targets,
                        f'but at most {MAX_TARGETS} can be fitted together'),)
    joint_fits = fit_joint(data, paths, ground, orders, stopped=stopped)
    if not joint_fits:
        return (_reject(single_fits, n_targets,
                        'but there are too few measurements to fit them together'),)
    best_joint, best_single = [_best_fit(fits) for fits in joint_fits], _best_fit(single_fits)
    if not best_single.reason and best_single.length[0] <= MAX_LENGTH and all(
            fit.determined for fit in best_joint) and (
            _are_parts(data, best_joint) or order_criteria([best_single, best_joint[0]])[0] == 0.0):
        return (tuple(single_fits),)
    reason = _rejection_reason(data, best_joint)
    return (_reject(single_fits, n_targets, reason),) if reason else joint_fits


def _best_fit(fits: Sequence[PassFit]) -> PassFit:
    """Return the fit with the smallest BIC, or the first fit if none is determined."""
    return fits[int(np.argmin(order_criteria(fits)))]


def _are_parts(data: PassData, fits: Sequence[PassFit]) -> bool:
    """Whether targets are parts of one vehicle: they overlap at almost equal velocities."""
    velocity = np.array([fit.velocity for fit in fits])
    mean = velocity.mean(axis=0)
    return bool((np.linalg.norm(velocity - mean, axis=1)
                 <= MAX_VELOCITY_SPREAD * np.linalg.norm(mean)).all()
                and not are_separate(data, [path_from(data, fit) for fit in fits]))


def _rejection_reason(data: PassData, fits: Sequence[PassFit]) -> str:
    """Reason why a joint fit is rejected; empty if it is accepted."""
    if not all(fit.converged for fit in fits):
        return 'but the joint fit did not converge'
    if not all(has_plausible_residual(fit) for fit in fits):
        return ('but constant velocities leave '
                f'{1.0 - fits[0].explained:.1%} of the field unexplained; possible causes are a '
                'turn, braking or another vehicle')
    if not are_separate(data, [path_from(data, fit) for fit in fits]):
        return ('but the fitted vehicles overlap; possible causes are a turn, braking or another '
                'vehicle')
    for k, fit in enumerate(fits, 1):
        if fit.reason:
            return f'but the fit of vehicle {k} is rejected: {fit.reason}'
        if fit.length[0] > MAX_LENGTH:
            return f'but the fitted length of vehicle {k}, {fit.length[0]:.0f} m, is too long'
    return ''


def _reject(fits: Sequence[PassFit], n_targets: int, details: str) -> tuple[PassFit, ...]:
    """Return the fits with a reason for rejection and without trusted quantities."""
    reason = f'not one target: {n_targets} targets were tracked, {details}'
    return tuple(replace(fit, reason=reason, trusted=()) for fit in fits)
