"""Joint batch fit of several targets whose fields overlap.

The targets are first placed as points: at their tracked positions, and one after another where the
residual field is strongest. The number of dipoles of each target is then selected.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from mag_tracking.analysis.model_order import order_criteria
from mag_tracking.analysis.pass_covariance import SensorErrors
from mag_tracking.analysis.pass_data import PassData, background_columns, separable_problem
from mag_tracking.analysis.pass_description import PATH_TOLERANCE, assignment, fits_at_minimum
from mag_tracking.analysis.pass_fit import (
    COARSE_ERROR,
    DEFAULT_ERRORS,
    centred_on_peak,
    shorter_rows,
    starting_paths,
    unusable_reason,
)
from mag_tracking.analysis.pass_result import MAX_COST_RATIO, PassFit
from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.geometry import overlap, propagated_path
from mag_tracking.inference.least_squares import refine
from mag_tracking.inference.separable_fit import coarse_minima, fine_minimum
from mag_tracking.physics.passes import SuperposedPasses
from mag_tracking.units import NS

N_REFINED, N_STEPS = 150, 6
"""Number of starts that are refined, and number of steps of each, before the best are selected."""

N_PLACEMENTS = 10
"""Number of placements of the targets that are refined to their minima."""

N_FINE = 2
"""Number of minima at which the fit of all measurements starts: the best one and its rival."""

INITIAL_LENGTH = 3.0
"""[m] Initial length of a row that replaces a point."""

MIN_GAP, VEHICLE_WIDTH = 3.0, 1.5
"""[m] Minimum distance between the rows of two vehicles, along their heading (a body is longer than
its row) and across it. Closer rows are parts of one vehicle."""

MAX_DETECTION_RANGE = 15.0
"""[m] Maximum distance at which a sensor detects a target."""

MAX_ROUNDS = 3
"""Maximum number of selections of the order of each target, given the orders of the others."""

MAX_VELOCITY_DIFFERENCE, MAX_TRACK_DISTANCE = 0.5, 5.0
"""Maximum relative difference of velocity, and maximum distance [m], between two fits of one
target, or between a fit and its track. Tracks have RMS errors of 0.3 to 0.9 m (`bench.busy`)."""


@dataclass(frozen=True)
class GroundPrior:
    """Prior of the height and vertical speed of vehicles.

    Without it, two flying targets can explain one that turns.
    """

    height: tuple[float, float]
    """Height of the magnetic centre above z = 0 and its standard deviation [m]."""
    climb_std: float
    """Standard deviation of the vertical speed [m/s]; its mean is zero."""

    def prior(self, orders: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Prior of the paths of several rows of dipoles.

        Parameters
        ----------
        orders : sequence of int
            Number of dipoles of each row.

        Returns
        -------
        mean : (n_theta,) array
        std : (n_theta,) array
            Infinite for parameters without a prior.
        """
        means, stds = [], []
        for n_dipoles in orders:
            mean, std = np.zeros(6 + (n_dipoles > 1)), np.full(6 + (n_dipoles > 1), np.inf)
            (mean[2], std[2]), std[5] = self.height, self.climb_std
            means.append(mean)
            stds.append(std)
        return np.concatenate(means), np.concatenate(stds)


def fit_joint(data: PassData, paths: FloatArray, ground: GroundPrior,
              orders: Sequence[int] = (1, 2, 3, 4), errors: SensorErrors = DEFAULT_ERRORS,
              stopped: Callable[[], bool] | None = None) -> tuple[tuple[PassFit, ...], ...]:
    """Fit several rows of dipoles, each at constant velocity, to the sum of their fields.

    Parameters
    ----------
    data : PassData
        Readings of at least two sensors.
    paths : (K, 6) array, m, m/s
        Approximate position of each target when `data.t` is zero, and its velocity.
    ground : GroundPrior
    orders : sequence of int
        Numbers of dipoles to try for each target.
    errors : SensorErrors
        Sensor errors that the robust covariance includes.
    stopped : function, optional
        Returns whether to abandon the fit.

    Returns
    -------
    tuple of tuples of PassFit
        For each target, one fit per order of `orders` that the number of measurements allows; the
        other targets have their selected order. Targets are in the order in which they pass the
        centre of the sensors; time zero is at the strongest field of each. A fit that is not at
        the tracked path, or at the best fit of its target, has a reason. Empty if there are too
        few measurements for every order, or if the fit was abandoned.
    """
    n_targets, begin_ns = len(paths), data.stamp_ns
    orders = [n for n in orders if not unusable_reason(data, n_targets * (n,))]
    if not orders:
        return ()
    data, rough = centred_on_peak(data)
    paths = propagated_path(paths, (data.stamp_ns - begin_ns) / NS)
    placed = np.vstack([paths.ravel(), _initial_paths(rough, n_targets, ground)])
    fits = _JointFits(data, rough, placed, ground, errors)
    known = [min(orders, key=lambda n: (abs(n - 2), n))] * n_targets
    for _ in range(MAX_ROUNDS):
        before = list(known)
        for k in range(n_targets):
            if stopped is not None and stopped():
                return ()
            criteria = order_criteria(fits.of(k, known, orders))
            if np.isfinite(criteria).any():
                known[k] = orders[int(np.argmin(criteria))]
        if known == before:
            break
    found = [_shifted_to_strongest(
        _checked_against_track(fits.of(k, known, orders), orders.index(known[k]), paths[k]),
        orders.index(known[k])) for k in range(n_targets)]
    return tuple(of_one for _, of_one in sorted(found, key=lambda pair: pair[0]))


def _initial_paths(rough: PassData, n_targets: int, ground: GroundPrior) -> FloatArray:
    """Best paths (n, 6 n_targets) of point targets; `rough` is the averaged pass."""
    paths: FloatArray = np.zeros((1, 0))
    rests = [rough]
    for n in range(1, n_targets + 1):
        orders = n * (1,)
        model_of, prior = partial(SuperposedPasses.of, orders), ground.prior(orders)
        starts = []
        for known, rest in zip(paths, rests, strict=True):
            own = starting_paths(rest, 1)
            starts.append(np.hstack([np.tile(known, (len(own), 1)), own]))
        coarse = separable_problem(rough, model_of, prior=prior)
        paths, _ = coarse_minima(separable_problem(rough, model_of, COARSE_ERROR, prior), coarse,
                                 np.concatenate(starts), np.tile(PATH_TOLERANCE[:6], n), N_REFINED,
                                 N_STEPS, N_PLACEMENTS)
        if n < n_targets:
            model = model_of(rough.t, rough.positions, rough.network.R_sw[rough.sensor])
            rests = [replace(rough, field=rough.field - (
                model.basis(path[None])[0] @ coarse.linear(path)).reshape(-1, 3))
                for path in paths]
    return paths


class _JointFits:
    """Cached fits of several targets with any numbers of dipoles.

    Each starts at the points `placed` (n, 6 K) and at the fit with another number of dipoles.
    """

    def __init__(self, data: PassData, rough: PassData, placed: FloatArray, ground: GroundPrior,
                 errors: SensorErrors) -> None:
        self._data, self._rough, self._ground, self._errors = data, rough, ground, errors
        # The first row holds the tracks; the targets of all rows are sorted in its order.
        split = [np.split(paths, paths.size // 6) for paths in placed]
        self._initial_paths = [[paths[i] for i in assignment(split[0], paths)] for paths in split]
        self._n_free = data.n_independent - background_columns(data, data.whitening).shape[1]
        self._known: dict[tuple[int, ...], tuple[PassFit, ...]] = {}

    def of(self, k: int, orders: Sequence[int], tried: Sequence[int]) -> tuple[PassFit, ...]:
        """Fits of target `k` with each order in `tried`; the other targets keep their `orders`."""
        before, fits = self._known.get(tuple(orders)), []
        for n in tried:
            found = (*orders[:k], n, *orders[k + 1:])
            if found not in self._known:
                self._known[found] = self._fitted(found, self._starts(found, k, before))
            fits.append(self._known[found][k])
        return tuple(fits)

    def _starts(self, orders: tuple[int, ...], k: int,
                before: Sequence[PassFit] | None) -> FloatArray:
        """Starting points (n, n_theta) of the search for some numbers of dipoles.

        `before` are the fits with another number of dipoles for target `k`.
        """
        starts = [_of_orders(paths, orders) for paths in self._initial_paths]
        if before is not None and all(len(fit.x) for fit in before):
            paths = _of_orders([fit.x[:6 + (fit.n_dipoles > 1)] for fit in before], orders)
            rows = [paths[k], *(shorter_rows(paths[k]) if orders[k] > 1 else ())]
            starts += [[*paths[:k], row, *paths[k + 1:]] for row in rows]
        return np.array([np.concatenate(paths) for paths in starts])

    def _fitted(self, orders: tuple[int, ...], starts: FloatArray) -> tuple[PassFit, ...]:
        """`PassFit` of each target."""
        data, model_of = self._data, partial(SuperposedPasses.of, orders)
        prior, split = self._ground.prior(orders), model_of(
            data.t, data.positions, data.whitening).split
        coarse, fine = (separable_problem(d, model_of, prior=prior) for d in (self._rough, data))
        theta, cost, _, _ = refine(coarse.residual_and_jacobian, starts, 40, 1e-6)
        in_order = tuple(range(len(orders)))
        cost = _restricted_to(cost, np.array([
            assignment(self._initial_paths[0], split(found)) == in_order
            for found in theta]), np.inf)
        # If only much worse minima are separate, the overlap remains; `fit_targets` rejects it.
        cost = _restricted_to(cost, np.array([are_separate(self._rough, split(found))
                                              for found in theta]), MAX_COST_RATIO)
        found = fine_minimum(fine, theta, cost, np.concatenate(
            [PATH_TOLERANCE[:6 + (n > 1)] for n in orders]), N_FINE)
        if not np.isfinite(found.cost):
            return tuple(PassFit(n, data, 'no valid start of the search') for n in orders)
        theta, p = model_of(data.t, data.positions, data.whitening).forward(
            found.theta, fine.linear(found.theta))
        left = max(found.cost - self._n_free, 0.0) / (fine.energy - self._n_free)
        return fits_at_minimum(data, orders, replace(found, theta=theta), p, 1.0 - left,
                               self._errors, path_std=prior[1])


def _restricted_to(cost: FloatArray, wanted: BoolArray, nearly: float) -> FloatArray:
    """Costs (n,), infinite where not `wanted`.

    Unchanged if the best wanted cost exceeds `nearly` times the best.
    """
    is_one = (cost[wanted] <= nearly * cost.min()).any()
    return np.where(wanted, cost, np.inf) if is_one else cost


def are_separate(data: PassData, paths: Sequence[FloatArray], min_gap: float = MIN_GAP) -> bool:
    """Whether targets keep a distance while they are detected, side by side or one after the other.

    Parameters
    ----------
    data : PassData
    paths : sequence of (6 or 7,) array, m, m/s, m
        Position, velocity and, for a row, length.
    min_gap : float, m
        Minimum gap between two rows, along the heading.

    Returns
    -------
    bool
    """
    places = [path[:3] + data.t[:, None] * path[3:6] for path in paths]
    seen = np.any([np.linalg.norm(place - data.positions, axis=1) < MAX_DETECTION_RANGE
                   for place in places], axis=0)
    for i, k in combinations(range(len(paths)), 2):
        need = min_gap + 0.5 * sum(abs(path[6]) for path in (paths[i], paths[k]) if len(path) > 6)
        velocity = np.array([np.tile(paths[j][3:6], (len(data.t), 1)) for j in (i, k)])
        if overlap(np.array([places[i], places[k]]), velocity, need, VEHICLE_WIDTH)[seen].any():
            return False
    return True


def path_from(data: PassData, fit: PassFit) -> FloatArray:
    """Path of a fit relative to time zero of a pass.

    Parameters
    ----------
    data : PassData
    fit : PassFit

    Returns
    -------
    (6 or 7,) array, m, m/s, m
    """
    return propagated_path(fit.x[:6 + (fit.n_dipoles > 1)],
                           (data.stamp_ns - fit.data.stamp_ns) / NS)


def _of_orders(paths: Sequence[FloatArray], orders: Sequence[int]) -> list[FloatArray]:
    """Paths (6 or 7,) with or without a length, according to the numbers of dipoles."""
    return [np.concatenate([path[:6], path[6:] if len(path) > 6 else [INITIAL_LENGTH]])
            if n > 1 else path[:6] for path, n in zip(paths, orders, strict=True)]


def _checked_against_track(fits: Sequence[PassFit], best: int, path: FloatArray) -> list[PassFit]:
    """Fits of a target; fits that are not at the tracked `path` (6,) get a reason."""
    out = []
    for k, fit in enumerate(fits):
        # The best fit is compared with the track, the others with the best fit.
        is_same = k != best and not len(fits[best].x) or _is_same(
            fit, path if k == best else fits[best].x)
        why = 'the fit is not at the tracked position' if k == best else \
            f'not the same target as with {fits[best].n_dipoles} dipoles'
        out.append(fit if is_same or fit.reason else replace(fit, reason=why, trusted=()))
    return out


def _is_same(fit: PassFit, path: FloatArray) -> bool:
    """Whether a fit is at a `path` (6 or more,) with the same time zero."""
    if not len(fit.x):
        return False
    seconds = _strongest_at(fit)
    away = propagated_path(fit.x, seconds)[:2] - propagated_path(path, seconds)[:2]
    return bool(np.linalg.norm(away) <= MAX_TRACK_DISTANCE and np.linalg.norm(
        fit.velocity - path[3:6]) <= MAX_VELOCITY_DIFFERENCE * np.linalg.norm(path[3:6]))


def _strongest_at(fit: PassFit) -> float:
    """Time [s] of the strongest field of a target."""
    field = replace(fit.data, field=fit.predicted).departure
    return float(fit.data.t[np.argmax(np.einsum('ni,ni->n', field, field))])


def _shifted_to_strongest(fits: Sequence[PassFit], best: int) -> tuple[float, tuple[PassFit, ...]]:
    """CPA time [s since 1970] to the centre of the sensors, and fits with time zero at the peak.

    Both are those of the `best` fit.
    """
    fit = fits[best]
    if not len(fit.x):
        return np.inf, tuple(fits)
    seconds = _strongest_at(fit)
    centre = fit.data.network.positions[fit.data.sensors].mean(axis=0)
    at = fit.data.stamp_ns / NS + fit.closest_approach(centre)[0]
    return at, tuple(f.shifted(seconds) if len(f.x) else f for f in fits)
