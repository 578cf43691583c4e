"""Batch fit of several targets that were seen at once: their fields add up.

The targets are first placed as points: at their tracked positions, and one after another where the
residual field is strongest. Then the number of dipoles of each target is selected.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from mag_tracking.analysis.model_order import order_criteria
from mag_tracking.analysis.pass_data import PassData, background_columns, separable_problem
from mag_tracking.analysis.pass_description import APART, assignment, fits_at_minimum
from mag_tracking.analysis.pass_deviation import SensorErrors
from mag_tracking.analysis.pass_fit import (
    AS_BOUGHT,
    COARSE_ERROR,
    at_strongest,
    shorter_rows,
    starting_paths,
    unusable,
)
from mag_tracking.analysis.pass_result import NEARLY, PassFit
from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.geometry import overlap, propagated_path
from mag_tracking.inference.least_squares import refine
from mag_tracking.inference.separable_fit import coarse_minima, fine_minimum
from mag_tracking.physics.passes import SuperposedPasses
from mag_tracking.units import NS

N_REFINED, N_STEPS = 150, 6
"""Number of starts that are refined, and steps of each, before the best are chosen."""

N_PLACED = 10
"""Number of placements of the targets that are followed to their minima."""

N_FINE = 2
"""Number of minima that all measurements are fitted from: the best one and its rival."""

FIRST_LENGTH = 3.0
"""[m] Initial length of a row that was a point before."""

CLEAR, WIDTH = 3.0, 1.5
"""[m] Least distance between the rows of two vehicles, along their heading (their bodies are longer
than their rows) or across it. Two that are nearer are parts of one vehicle."""

SEEN_FROM = 15.0
"""[m] Largest distance at which a sensor detects a target."""

MAX_ROUNDS = 3
"""Number of times that the order of each target is chosen, given those of the others."""

SAME_SHARE, SAME_M = 0.5, 5.0
"""Largest relative difference of velocity, and largest distance [m], between two fits of the same
target, or a fit and its track. Tracks have RMS errors of 0.3 to 0.9 m (`bench.busy`)."""


@dataclass(frozen=True)
class GroundPrior:
    """Height and vertical speed of vehicles.

    Without it two flying targets explain one that turns.
    """

    height: tuple[float, float]
    """[m] of the magnetic centre above z = 0, and its standard deviation."""
    climb_std: float
    """[m/s] Standard deviation of the vertical speed, whose mean is zero."""

    def prior(self, orders: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Mean and deviation (n_theta,) of the paths of rows of `orders` dipoles."""
        means, stds = [], []
        for n_dipoles in orders:
            mean, std = np.zeros(6 + (n_dipoles > 1)), np.full(6 + (n_dipoles > 1), np.inf)
            (mean[2], std[2]), std[5] = self.height, self.climb_std
            means.append(mean)
            stds.append(std)
        return np.concatenate(means), np.concatenate(stds)


def fit_joint(data: PassData, paths: FloatArray, ground: GroundPrior,
                   orders: Sequence[int] = (1, 2, 3, 4), errors: SensorErrors = AS_BOUGHT,
                   stopped: Callable[[], bool] | None = None) -> tuple[tuple[PassFit, ...], ...]:
    """Fit several rows of dipoles, each at constant velocity, to the sum of their fields.

    Parameters
    ----------
    data : PassData
        Of two sensors or more.
    paths : (K, 6) [m], [m/s]
        Approximate position of each target when `data.t` is zero, and its velocity.
    ground : GroundPrior
    orders : sequence of int
        Numbers of dipoles to try for each target.
    errors : SensorErrors
        Of the sensors, for the honest covariance.
    stopped : function, optional
        Whether to give up.

    Returns
    -------
    tuple of tuples of PassFit
        The fits of each target with each of `orders` that there are enough measurements for; the
        other targets have the selected number of dipoles. Targets are in the order in which they
        pass the middle of the sensors, time zero is at the strongest field of each. A fit that left
        its track, or the best fit of its target, has a reason. Empty if there are too few
        measurements for any order, or if it gave up.
    """
    n_targets, begin_ns = len(paths), data.stamp_ns
    orders = [n for n in orders if not unusable(data, n_targets * (n,))]
    if not orders:
        return ()
    data, rough = at_strongest(data)
    paths = propagated_path(paths, (data.stamp_ns - begin_ns) / NS)
    placed = np.vstack([paths.ravel(), _placed(rough, n_targets, ground)])
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


def _placed(rough: PassData, n_targets: int, ground: GroundPrior) -> FloatArray:
    """(n, 6 n_targets) Best paths of point targets; `rough` is the averaged pass."""
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
                                 np.concatenate(starts), np.tile(APART[:6], n), N_REFINED,
                                 N_STEPS, N_PLACED)
        if n < n_targets:
            model = model_of(rough.t, rough.positions, rough.network.R_sw[rough.sensor])
            rests = [replace(rough, field=rough.field - (
                model.basis(path[None])[0] @ coarse.linear(path)).reshape(-1, 3))
                for path in paths]
    return paths


class _JointFits:
    """Fits of some targets with any numbers of dipoles, each made once.

    Each starts from the points `placed` (n, 6 K) and from the fit with another number of dipoles.
    """

    def __init__(self, data: PassData, rough: PassData, placed: FloatArray, ground: GroundPrior,
                 errors: SensorErrors) -> None:
        self._data, self._rough, self._ground, self._errors = data, rough, ground, errors
        # The first row holds the tracks; the targets of all rows are put into its order.
        split = [np.split(paths, paths.size // 6) for paths in placed]
        self._placed = [[paths[i] for i in assignment(split[0], paths)] for paths in split]
        self._n_free = data.n_independent - background_columns(data, data.whitening).shape[1]
        self._known: dict[tuple[int, ...], tuple[PassFit, ...]] = {}

    def of(self, k: int, orders: Sequence[int], tried: Sequence[int]) -> tuple[PassFit, ...]:
        """The fits of target `k` with each number of dipoles `tried`, the others having those of
        `orders`."""
        before, fits = self._known.get(tuple(orders)), []
        for n in tried:
            found = (*orders[:k], n, *orders[k + 1:])
            if found not in self._known:
                self._known[found] = self._fitted(found, self._starts(found, k, before))
            fits.append(self._known[found][k])
        return tuple(fits)

    def _starts(self, orders: tuple[int, ...], k: int,
                before: Sequence[PassFit] | None) -> FloatArray:
        """(n, n_theta) Where the search with some numbers of dipoles begins.

        `before` are the fits with another number for target `k`.
        """
        starts = [_of_orders(paths, orders) for paths in self._placed]
        if before is not None and all(len(fit.x) for fit in before):
            paths = _of_orders([fit.x[:6 + (fit.n_dipoles > 1)] for fit in before], orders)
            rows = [paths[k], *(shorter_rows(paths[k]) if orders[k] > 1 else ())]
            starts += [[*paths[:k], row, *paths[k + 1:]] for row in rows]
        return np.array([np.concatenate(paths) for paths in starts])

    def _fitted(self, orders: tuple[int, ...], starts: FloatArray) -> tuple[PassFit, ...]:
        """The `PassFit` of each target."""
        data, model_of = self._data, partial(SuperposedPasses.of, orders)
        prior, split = self._ground.prior(orders), model_of(
            data.t, data.positions, data.whitening).split
        coarse, fine = (separable_problem(d, model_of, prior=prior) for d in (self._rough, data))
        theta, cost, _, _ = refine(coarse.residual_and_jacobian, starts, 40, 1e-6)
        in_order = tuple(range(len(orders)))
        cost = _restricted_to(cost, np.array([
            assignment(self._placed[0], split(found)) == in_order for found in theta]), np.inf)
        # If only much worse minima are separate, the overlap is kept: `fit_targets` rejects it.
        cost = _restricted_to(cost, np.array([are_separate(self._rough, split(found))
                                              for found in theta]), NEARLY)
        found = fine_minimum(fine, theta, cost, np.concatenate(
            [APART[:6 + (n > 1)] for n in orders]), N_FINE)
        if not np.isfinite(found.cost):
            return tuple(PassFit(n, data, 'no start of the search could be used') for n in orders)
        theta, p = model_of(data.t, data.positions, data.whitening).forward(
            found.theta, fine.linear(found.theta))
        left = max(found.cost - self._n_free, 0.0) / (fine.energy - self._n_free)
        return fits_at_minimum(data, orders, replace(found, theta=theta), p, 1.0 - left,
                               self._errors, path_std=prior[1])


def _restricted_to(cost: FloatArray, wanted: BoolArray, nearly: float) -> FloatArray:
    """(n,) costs, infinite where not `wanted`, if the best wanted one is at most `nearly` times the
    best."""
    is_one = (cost[wanted] <= nearly * cost.min()).any()
    return np.where(wanted, cost, np.inf) if is_one else cost


def are_separate(data: PassData, paths: Sequence[FloatArray], clear: float = CLEAR) -> bool:
    """Whether targets on `paths` (6 or 7,) keep a distance while they are detected: beside each
    other, or their rows `clear` [m] apart."""
    places = [path[:3] + data.t[:, None] * path[3:6] for path in paths]
    seen = np.any([np.linalg.norm(place - data.positions, axis=1) < SEEN_FROM
                   for place in places], axis=0)
    for i, k in combinations(range(len(paths)), 2):
        need = clear + 0.5 * sum(abs(path[6]) for path in (paths[i], paths[k]) if len(path) > 6)
        velocity = np.array([np.tile(paths[j][3:6], (len(data.t), 1)) for j in (i, k)])
        if overlap(np.array([places[i], places[k]]), velocity, need, WIDTH)[seen].any():
            return False
    return True


def path_from(data: PassData, fit: PassFit) -> FloatArray:
    """The path (6 or 7,) of a fit, from time zero of `data`."""
    return propagated_path(fit.x[:6 + (fit.n_dipoles > 1)],
                           (data.stamp_ns - fit.data.stamp_ns) / NS)


def _of_orders(paths: Sequence[FloatArray], orders: Sequence[int]) -> list[FloatArray]:
    """Paths (6 or 7,) with a length, or without one, as the numbers of dipoles need it."""
    return [np.concatenate([path[:6], path[6:] if len(path) > 6 else [FIRST_LENGTH]])
            if n > 1 else path[:6] for path, n in zip(paths, orders, strict=True)]


def _checked_against_track(fits: Sequence[PassFit], best: int, path: FloatArray) -> list[PassFit]:
    """The fits of a target; those that left its tracked `path` (6,) get a reason."""
    out = []
    for k, fit in enumerate(fits):
        # The best one is that of the track, and the others are that of the best one.
        is_same = k != best and not len(fits[best].x) or _is_same(
            fit, path if k == best else fits[best].x)
        why = 'it is not where it was tracked' if k == best else \
            f'another target than with {fits[best].n_dipoles} dipoles'
        out.append(fit if is_same or fit.reason else replace(fit, reason=why, trusted=()))
    return out


def _is_same(fit: PassFit, path: FloatArray) -> bool:
    """Whether a fit is of the target on a `path` (6 or more,) from the same time on."""
    if not len(fit.x):
        return False
    seconds = _strongest_at(fit)
    away = propagated_path(fit.x, seconds)[:2] - propagated_path(path, seconds)[:2]
    return bool(np.linalg.norm(away) <= SAME_M and np.linalg.norm(
        fit.velocity - path[3:6]) <= SAME_SHARE * np.linalg.norm(path[3:6]))


def _strongest_at(fit: PassFit) -> float:
    """[s] When the field of a target is strongest."""
    field = replace(fit.data, field=fit.predicted).departure
    return float(fit.data.t[np.argmax(np.einsum('ni,ni->n', field, field))])


def _shifted_to_strongest(fits: Sequence[PassFit], best: int) -> tuple[float, tuple[PassFit, ...]]:
    """([s since 1970] when a target passes the middle of the sensors, its fits with time zero at
    its strongest field), by the `best` one."""
    fit = fits[best]
    if not len(fit.x):
        return np.inf, tuple(fits)
    seconds = _strongest_at(fit)
    centre = fit.data.network.positions[fit.data.sensors].mean(axis=0)
    at = fit.data.stamp_ns / NS + fit.closest_approach(centre)[0]
    return at, tuple(f.shifted(seconds) if len(f.x) else f for f in fits)
