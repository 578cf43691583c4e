"""Search for a new vehicle in the frames of a running track.

Three other explanations are tried: an additional vehicle; two vehicles in place of one, which may
have misled its filter; and one vehicle at another position. Each is filtered and smoothed along its
path like any hypothesis, and its evidence is compared with that of the track.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
from scipy.linalg import block_diag

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank, log_sum_exp
from mag_tracking.stages.track import window_search
from mag_tracking.stages.track.bank_filter import DETECTABLE_ENERGY, BankFilter
from mag_tracking.stages.track.initiation_vehicle import TURN_SHARE, moment_directions
from mag_tracking.stages.track.joint import IMPROBABLE, JointExplanation
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.stages.track.steady_search import in_order_of
from mag_tracking.stages.track.window_search import KnownVehicles, WindowSearch, WindowStart

PASSES, STEP = 3, 0.5
"""Number of Gauss-Newton steps along each path, and their damping factor."""
MAX_KNOWN, MAX_FIRST, MAX_SECOND = 2, 3, 2
"""Maximum numbers of tried hypotheses of a single tracked vehicle (only the best of several), of
first new vehicles for each hypothesis, and of second new vehicles for each first one."""
MAX_LOSS_NATS, MAX_EXPLANATIONS = 10.0, 12
"""Maximum loss of retained explanations against the best [nats], and their maximum number."""
LOG_P_ARRIVAL, LOG_P_LOST = np.log(0.05), np.log(0.01)
"""Log-probabilities that another vehicle arrives during a pass, or that a track is wrong."""
MIN_DISPLACEMENT_M, MAX_RATIO, N_DISTANCES = 2.0, 5.0, 10
"""Minimum distance [m] of a relocated vehicle from its track, maximum ratio of speed and moment to
the settings, and number of possible positions on a line."""


class NewTargetSearch:
    """Search for explanations by an additional vehicle, if it `may_add` one, by a vehicle at
    another position, or (only, unless `reason` is `IMPROBABLE`) by two in place of one."""

    def __init__(self, bank: FilterBank, window: Window, filter_of: Callable[[int], BankFilter],
                 n_targets: int, vehicles: window_search.VehicleState, reason: str, may_add: bool
                 ) -> None:
        self._is_improbable = reason == IMPROBABLE
        self._bank, self._window = bank, window
        self._filter_of, self._n_targets, self._vehicles = cache(filter_of), n_targets, vehicles
        self._filter, self._may_add = self._filter_of(n_targets), may_add
        settings = vehicles.settings
        self._n_one = self._filter.observation.n_one
        self._search = WindowSearch(window, vehicles)
        # First pair that was found in place of each vehicle; it defines the order of later pairs.
        self._pairs: dict[int, FloatArray] = {}
        self._log_prior = -float(np.log(
            len(settings.arrival_names) * len(settings.lateral_offsets) * len(settings.speeds)
            * len(settings.kinds) * len(moment_directions()) * N_DISTANCES))

    def find(self) -> JointExplanation | None:
        """Best explanation with a new or a relocated vehicle; None if none is usable."""
        if not len(self._search.samples.t):
            return None
        rows, track_log_likelihood, log_w, paths = self._current_track()
        # Keys: number of vehicles, and the replaced vehicle of the track.
        explanations: dict[tuple[int, int | None], list[WindowStart]] = {}
        for k in self._leading_indices(rows, log_w):
            known = self._known_vehicles(rows[k], log_w[k] - track_log_likelihood[k], paths[k])
            for start in self._all_starts(known):
                explanations.setdefault((len(start.kind), start.replaced), []).append(start)
        track_evidence = float(log_sum_exp(log_w))
        joints = [self._best_of(starts, track_evidence) for starts in explanations.values()]
        return max((joint for joint in joints if joint is not None
                    and (joint.is_sensed_by_two() if joint.adds else self._is_elsewhere(joint))),
                   key=lambda joint: joint.log_odds, default=None)

    def _all_starts(self, known: KnownVehicles) -> list[WindowStart]:
        """Starts of the explanations that are derived from one hypothesis of the track."""
        starts = self._starts_beside(known) if self._may_add and self._is_improbable else []
        for i in range(self._n_targets):
            others, is_long = self._remove_vehicle(known, i), self._filter.are_long(
                np.array([known.kind[i]]))[0]
            if self._is_improbable and self._filter.field_energies(
                    i, known.path[-1], self._window.frames[-1]).sum() > DETECTABLE_ENERGY:
                starts += self._starts_beside(others, i)
            # Only a long vehicle, or the only one, may be two vehicles.
            if self._may_add and (self._n_targets == 1 or is_long):
                starts += self._pair_starts(others, i)
        return starts

    def _best_of(self, starts: Sequence[WindowStart], track_evidence: float
                 ) -> JointExplanation | None:
        """Joint explanation by refined starts, against `track_evidence`; None if unusable."""
        _, _, log_w, paths = self._run_starts(starts)
        order = np.argsort(-log_w, kind='stable')[:MAX_EXPLANATIONS]
        starts = self._add_turning_starts([replace(starts[k], path=paths[k]) for k in order.tolist()
                                           if log_w[k] >= log_w.max() - MAX_LOSS_NATS])
        bank, log_likelihood, log_w, paths = self._run_starts(starts)
        rows = np.flatnonzero(np.isfinite(log_w))
        if not len(rows):
            return None
        n, n_targets, n_frames = len(rows), len(starts[0].kind), len(self._window.frames)
        evidence = float(log_sum_exp(log_w[rows]))
        latest = replace(bank.rows(rows), log_w=log_w[rows] - evidence, origin=np.arange(n))
        anchor = replace(latest.copy(), x=np.array([starts[k].x for k in rows]),
                         P=np.array([starts[k].P for k in rows]), log_w=np.full(n, -np.log(n)))
        per_frame = log_likelihood[rows] / n_frames
        window = Window(anchor, self._window.is_updated, self._window.max_hypotheses,
                        self._window.frames, self._window.intervals,
                        [np.ascontiguousarray(paths[rows, k]) for k in range(n_frames)],
                        [per_frame.copy() for _ in range(n_frames)],
                        [evidence / n_frames] * n_frames)
        adds = n_targets > self._n_targets
        log_odds = float(log_sum_exp(log_w)) + (LOG_P_ARRIVAL if adds else LOG_P_LOST) \
            - track_evidence
        return JointExplanation(latest, window, self._filter_of(n_targets), log_odds,
                                starts[0].replaced, adds)

    def _current_track(self) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """Run the leading hypotheses of the track along their paths; return their indices (n,),
        log-likelihoods (n,), log-weights (n,) and paths (n, n_frames, n_x)."""
        window, bank = self._window, self._bank
        order = np.argsort(-bank.log_w, kind='stable')[:window.max_hypotheses]
        rows = window.rows_of(bank)[order]
        anchor, paths = window.anchor.rows(rows), np.stack([p[rows] for p in window.paths], axis=1)
        begin = int(window.is_updated)
        anchor_log_w = bank.log_w[order] + window.evidence \
            - np.sum([values[rows] for values in window.log_likelihoods[begin:]], axis=0)
        log_likelihood = self._run_along(anchor, paths, self._n_targets)
        return order, log_likelihood, anchor_log_w + log_likelihood, paths

    def _run_along(self, bank: FilterBank, paths: FloatArray, n_targets: int) -> FloatArray:
        """Run a bank along its paths, both in place; return log-likelihoods (n,)."""
        result = self._filter_of(n_targets).run_along(
            bank, self._window.frames, self._window.intervals, paths, passes=PASSES, step=STEP,
            first_is_updated=self._window.is_updated)
        is_usable = np.isfinite(result.log_likelihood) & np.isfinite(paths).all(axis=(1, 2))
        return np.where(is_usable, result.log_likelihood, -np.inf)

    def _leading_indices(self, rows: IntArray, log_w: FloatArray) -> list[int]:
        """Indices into `rows` of the hypotheses to be tried: the best of each arrival and kind."""
        tried: set[tuple[int, ...]] = set()
        n_max = MAX_KNOWN if self._n_targets == 1 else 1
        chosen: list[int] = []
        for k in np.argsort(-log_w, kind='stable').tolist():
            combination = (*np.ravel(self._bank.label[rows[k]]).tolist(),
                           *np.ravel(self._bank.kind[rows[k]]).tolist())
            if np.isfinite(log_w[k]) and combination not in tried and len(chosen) < n_max:
                tried.add(combination)
                chosen.append(k)
        return chosen

    def _known_vehicles(self, row: int, log_w: float, path: FloatArray) -> KnownVehicles:
        """Vehicles of hypothesis `row` of the track; `log_w` is its log-weight at the anchor."""
        at_anchor = self._window.anchor.rows(self._window.rows_of(self._bank)[[row]])
        label, kind = (tuple(np.ravel(of[row]).tolist())
                       for of in (self._bank.label, self._bank.kind))
        return KnownVehicles(at_anchor.x[0], at_anchor.P[0], path, label, kind, log_w, self._filter)

    def _is_elsewhere(self, joint: JointExplanation) -> bool:
        """Whether the relocated vehicle is more than `MIN_DISPLACEMENT_M` from its track."""
        assert joint.replaced is not None
        first, last = (k * self._n_one for k in (joint.replaced, self._n_targets - 1))
        before, found = (bank.x[bank.best()] for bank in (self._bank, joint.bank))
        return bool(np.hypot(*(found[last:last + 2] - before[first:first + 2]))
                    > MIN_DISPLACEMENT_M)

    def _remove_vehicle(self, known: KnownVehicles, i: int) -> KnownVehicles:
        """Known vehicles without vehicle `i`; initial sensor states if none remain."""
        n = self._n_one
        if self._n_targets == 1:
            observation, std = self._filter.observation, self._vehicles.background_std
            sensor_P = block_diag(*observation.own_covariance,
                                  std**2 * np.eye(3 * len(observation.positions)))
            sensor_path = np.zeros((len(self._search.times), len(sensor_P)))
            return KnownVehicles(sensor_path[0], sensor_P, sensor_path, (), (), 0.0, None)
        rows = np.delete(np.arange(known.path.shape[1]), np.arange(i * n, (i + 1) * n))
        return KnownVehicles(
            known.x[rows], known.P[np.ix_(rows, rows)], known.path[:, rows],
            known.label[:i] + known.label[i + 1:], known.kind[:i] + known.kind[i + 1:],
            known.log_w, self._filter_of(self._n_targets - 1))

    def _starts_beside(self, known: KnownVehicles, replaced: int | None = None
                       ) -> list[WindowStart]:
        """Starts with an additional vehicle, which is new or replaces vehicle `replaced`."""
        search = self._search.beside(known)
        return [start for theta in search.best(self._search.grid, MAX_FIRST)
                for start in self._starts_on(known, theta[None], search.moments(theta), replaced)]

    def _pair_starts(self, others: KnownVehicles, i: int) -> list[WindowStart]:
        """Starts of two vehicles in place of vehicle `i`."""
        search = self._search.beside(others)
        starts: list[WindowStart] = []
        for found in search.pairs(self._search.grid, MAX_FIRST, MAX_SECOND)[:MAX_FIRST]:
            pair = in_order_of(self._pairs.setdefault(i, found), found)
            starts += self._starts_on(others, pair, search.moments(pair.ravel()), i)
        return starts

    def _starts_on(self, known: KnownVehicles, paths: FloatArray, moments: FloatArray,
                   replaced: int | None) -> list[WindowStart]:
        """One start for each combination of kinds of k vehicles on `paths` (k, 7)."""
        n_known, times = len(known.kind) * self._n_one, self._search.times
        labels = self._search.prior.nearest_line(paths)[0].tolist()
        starts = []
        for kinds in product(range(len(self._vehicles.settings.kinds)), repeat=len(paths)):
            x, P, path = known.x, known.P, [known.path[:, :n_known]]
            for theta, m, kind, label in zip(paths, moments, kinds, labels, strict=True):
                at = n_known + (len(path) - 1) * self._n_one
                mean, covariance = self._vehicles.prior(theta, m, times[0], kind, label)
                x, P = np.insert(x, at, mean), window_search.inserted(P, covariance, at)
                path.append(self._vehicles.along(theta, m, times, kind))
            starts.append(WindowStart(
                x, P, np.hstack([*path, known.path[:, n_known:]]), (*known.label, *labels),
                (*known.kind, *kinds), known.log_w + len(paths) * self._log_prior,
                range(len(known.kind), len(known.kind) + len(paths)), replaced))
        return starts

    def _add_turning_starts(self, starts: Sequence[WindowStart]) -> list[WindowStart]:
        """Return the starts and copies of them, in each of which one new vehicle turns."""
        out = []
        for start in starts:
            turning = [P for P in (self._vehicles.turning(start.x, start.P, i)
                                   for i in start.new) if P is not None]
            out.append(start if not turning else replace(
                start, log_w=start.log_w + float(np.log(1.0 - TURN_SHARE))))
            out += [replace(start, P=P, log_w=start.log_w + float(
                np.log(TURN_SHARE / len(turning)))) for P in turning]
        return out

    def _run_starts(self, starts: Sequence[WindowStart]
                    ) -> tuple[FilterBank, FloatArray, FloatArray, FloatArray]:
        """Run starts along their paths; return the bank at the last frame, log-likelihoods (n,),
        log-weights (n,) and paths (n, n_frames, n_x)."""
        n, labels_of = len(starts), window_search.labels_of
        bank = FilterBank(
            np.array([s.x for s in starts]), np.array([s.P for s in starts]), np.zeros(n),
            labels_of([s.label for s in starts]), labels_of([s.kind for s in starts]), np.arange(n),
            np.full((n, len(self._vehicles.network)), np.nan))
        paths = np.array([s.path for s in starts])
        log_likelihood = self._run_along(bank, paths, len(starts[0].kind))
        is_usable: BoolArray = np.isfinite(log_likelihood) & np.isfinite(bank.x).all(axis=1) \
            & [self._are_plausible(s, x) for s, x in zip(starts, bank.x, strict=True)]
        log_likelihood = np.where(is_usable, log_likelihood, -np.inf)
        depths = [window_search.overlap_depth(path, self._n_one, len(s.kind),
                                              self._vehicles.length_column)
                  for s, path in zip(starts, paths, strict=True)]
        log_w = log_likelihood + [s.log_w for s in starts] \
            - 0.5 * np.square(np.array(depths) / window_search.DEPTH_STD)
        return bank, log_likelihood, log_w, paths

    def _are_plausible(self, start: WindowStart, x: FloatArray) -> bool:
        """Whether the new vehicles in the state `x` (n_x,) have plausible speeds and moments; a
        stationary vehicle cannot have arrived during the window."""
        settings, n = self._vehicles.settings, self._n_one
        for i in start.new:
            speed = np.hypot(*x[i * n + 3:i * n + 5])
            moment = np.linalg.norm(self._vehicles.hard_moments(x[i * n:]).sum(axis=0))
            if not self._search.prior.min_speed <= speed <= MAX_RATIO * max(settings.speeds) \
                    or moment > MAX_RATIO * max(kind.moment for kind in settings.kinds):
                return False
        return True
