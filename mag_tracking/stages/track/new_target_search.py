"""Newcomers: a vehicle more in the frames of a running track, believed only if evidence demands it.

The frames of the window that is kept for relinearising are explained once more: by a vehicle beside
those that are tracked, by two in place of one, whose filter two may have misled, or by one of them
elsewhere. Each explanation is filtered and smoothed along its path like any hypothesis, and its
evidence is compared with that of the track as it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
from scipy.linalg import block_diag

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank, log_sum_exp
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.initiation_vehicle import moment_directions
from mag_tracking.stages.track.joint import Joint, are_felt_by_two
from mag_tracking.stages.track.new_target_evidence import ODD
from mag_tracking.stages.track.reach import DETECTABLE_ENERGY, field_energy
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.stages.track.vehicle_state import VehicleState
from mag_tracking.stages.track.window_search import WindowSearch
from mag_tracking.stages.track.window_start import (
    DEPTH_STD,
    KnownVehicles,
    WindowStart,
    in_order_of,
    inserted,
    labels_of,
    overlap_depth,
)

PASSES, STEP = 3, 0.5
"""Gauss-Newton steps along each path, and the share that each goes."""

KNOWN_ROWS, FIRST, SECOND = 2, 3, 2
"""Number of hypotheses of a tracked vehicle that are tried (one of several), and of paths of a
first and of a second vehicle beside each."""

NATS_KEPT, MAX_KEPT = 10.0, 12
"""[nats] A kind is dropped if it is less probable than the best by more than this; and the number
of kinds that are kept."""

ARRIVES = np.log(0.05)
"""Log-probability that another vehicle comes while one passes."""

ELSEWHERE_M = 2.0
"""[m] A vehicle that is found nearer to its track than this was followed rightly."""

MAX_TIMES = 5.0
"""No vehicle is so many times faster, or stronger, than the largest of the settings."""

WAS_LOST = np.log(0.01)
"""Log-probability that a vehicle has been elsewhere than its track for the whole window."""

N_DISTANCES = 10
"""Places on its line where a new target may be when the window begins."""


class NewTargetSearch:
    """Explains a window with one vehicle more."""

    def __init__(self, bank: FilterBank, window: Window, filter_of: Callable[[int], BankFilter],
                 n_targets: int, vehicles: VehicleState, reason: str, may_be_more: bool
                 ) -> None:
        """`bank` of a track of `n_targets` vehicles; `filter_of` makes the filter of so many.

        The `reason` is that of `NewTargetEvidence.due`: nobody is sought beside a long vehicle, or
        elsewhere, if the innovations are as they should be. Without `may_be_more` no vehicle is
        added.
        """
        self._is_odd = reason == ODD
        self._bank, self._window = bank, window
        self._filter_of, self._n_targets, self._vehicles = cache(filter_of), n_targets, vehicles
        self._filter, self._may_be_more = self._filter_of(n_targets), may_be_more
        settings = vehicles.settings
        self._n_one = self._filter.observation.n_one
        self._search = WindowSearch(window, vehicles)
        # The first pair that was found in place of a vehicle: all have its order.
        self._pairs: dict[int, FloatArray] = {}
        self._of_cell = -float(np.log(
            len(settings.arrival_names) * len(settings.lateral_offsets) * len(settings.speeds)
            * len(settings.kinds) * len(moment_directions()) * N_DISTANCES))

    def find(self) -> Joint | None:
        """The best explanation with a new target, or with a vehicle elsewhere; None where there is
        none at all."""
        if not len(self._search.samples.t):
            return None
        rows, of_track, log_w, paths = self._as_it_is()
        # By the number of vehicles, and which one of the track is replaced.
        explanations: dict[tuple[int, int | None], list[WindowStart]] = {}
        for k in self._leaders(rows, log_w):
            known = self._known(rows[k], log_w[k] - of_track[k], paths[k])
            for start in self._starts_with(known):
                explanations.setdefault((len(start.kind), start.replaced), []).append(start)
        alone = float(log_sum_exp(log_w))
        found = [self._best_of(starts, alone) for starts in explanations.values()]
        return max((joint for joint in found if joint is not None
                    and (are_felt_by_two(joint) if joint.adds
                         else self._is_elsewhere(joint))),
                   key=lambda joint: joint.log_odds, default=None)

    def _starts_with(self, known: KnownVehicles) -> list[WindowStart]:
        """Starts of all explanations by a hypothesis of the track: a vehicle beside those that it
        has, one elsewhere, two in place of one."""
        starts = self._beside(known) if self._may_be_more and self._is_odd else []
        for i in range(self._n_targets):
            others = self._without(known, i)
            if self._is_odd and self._is_felt(known, i):
                starts += self._beside(others, i)
            if self._may_be_more and self._may_be_two(known, i):
                starts += self._pair_in_place_of(others, i)
        return starts

    def _best_of(self, starts: Sequence[WindowStart], alone: float) -> Joint | None:
        """The `Joint` of the starts of one explanation; `alone` is the log-evidence of the track as
        it is."""
        kept = self._with_turns(self._kept(starts))
        prior = ARRIVES if len(kept[0].kind) > self._n_targets else WAS_LOST
        bank, log_likelihood, log_w, paths = self._run(kept)
        return self._made(kept, bank, log_likelihood, log_w, paths,
                          float(log_sum_exp(log_w)) + prior - alone)

    def _as_it_is(self) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """The leading hypotheses of the track along their paths: rows of the bank (n,), the
        log-likelihood of each, its log-weight with that, and its path (n, n_frames, n_x)."""
        window, bank = self._window, self._bank
        order = np.argsort(-bank.log_w, kind='stable')[:window.max_hypotheses]
        rows = np.searchsorted(window.anchor.origin, bank.origin[order])
        anchor, paths = window.anchor.rows(rows), np.stack([p[rows] for p in window.paths], axis=1)
        begin = int(window.is_updated)
        before = bank.log_w[order] + window.evidence \
            - np.sum([of_frame[rows] for of_frame in window.log_likelihoods[begin:]], axis=0)
        along = self._filter.run_along(anchor, window.frames, window.intervals, paths,
                                       passes=PASSES, step=STEP,
                                       first_is_updated=window.is_updated)
        usable = np.isfinite(along.log_likelihood) & np.isfinite(paths).all(axis=(1, 2))
        of_track = np.where(usable, along.log_likelihood, -np.inf)
        return order, of_track, before + of_track, paths

    def _leaders(self, rows: IntArray, log_w: FloatArray) -> list[int]:
        """Which of the `rows` are tried with a new target: the best of each arrival and kind."""
        seen: set[tuple[int, ...]] = set()
        most = KNOWN_ROWS if self._n_targets == 1 else 1
        chosen: list[int] = []
        for k in np.argsort(-log_w, kind='stable').tolist():
            what = (*np.ravel(self._bank.label[rows[k]]).tolist(),
                    *np.ravel(self._bank.kind[rows[k]]).tolist())
            if np.isfinite(log_w[k]) and what not in seen and len(chosen) < most:
                seen.add(what)
                chosen.append(k)
        return chosen

    def _known(self, row: int, log_w: float, path: FloatArray) -> KnownVehicles:
        """The vehicles of a hypothesis of the track, with its log-weight at the anchor."""
        at = np.searchsorted(self._window.anchor.origin, self._bank.origin[[row]])
        before = self._window.anchor.rows(at)
        label, kind = (tuple(np.ravel(of[row]).tolist())
                       for of in (self._bank.label, self._bank.kind))
        return KnownVehicles(before.x[0], before.P[0], path, label, kind, log_w, self._filter)

    def _may_be_two(self, known: KnownVehicles, i: int) -> bool:
        """Whether vehicle `i` is long, or alone."""
        return self._n_targets == 1 or bool(
            self._filter.are_long(np.array([known.kind[i]]))[0])

    def _is_felt(self, known: KnownVehicles, i: int) -> bool:
        """Whether the sensors feel vehicle `i` in the last frame."""
        return field_energy(
            self._filter, i, known.path[-1], self._window.frames[-1]) > DETECTABLE_ENERGY

    def _is_elsewhere(self, joint: Joint) -> bool:
        """Whether a vehicle that was sought elsewhere is far from where the track has it."""
        n, now = self._n_one, self._bank.x[self._bank.best()]
        assert joint.replaced is not None
        found = joint.bank.x[joint.bank.best()]
        last = n * (self._n_targets - 1)
        before = now[joint.replaced * n:joint.replaced * n + 2]
        return bool(np.hypot(*(found[last:last + 2] - before)) > ELSEWHERE_M)

    def _without(self, known: KnownVehicles, i: int) -> KnownVehicles:
        """The same without vehicle `i`; of one alone nothing is left that is known."""
        n = self._n_one
        if self._n_targets == 1:
            own = self._sensors_at_start()
            nowhere = np.zeros((len(self._search.times), len(own)))
            return KnownVehicles(nowhere[0], own, nowhere, (), (), 0.0, None)
        rows = np.delete(np.arange(known.path.shape[1]), np.arange(i * n, (i + 1) * n))
        return KnownVehicles(
            known.x[rows], known.P[np.ix_(rows, rows)], known.path[:, rows],
            known.label[:i] + known.label[i + 1:], known.kind[:i] + known.kind[i + 1:],
            known.log_w, self._filter_of(self._n_targets - 1))

    def _beside(self, known: KnownVehicles, replaced: int | None = None) -> list[WindowStart]:
        """One vehicle beside known ones: a new target, or in place of vehicle `replaced`."""
        search = self._search.beside(known)
        return [start for theta in search.best(self._search.grid, FIRST)
                for start in self._started(known, theta[None], search.moments(theta), replaced)]

    def _pair_in_place_of(self, others: KnownVehicles, i: int) -> list[WindowStart]:
        """Two vehicles in place of vehicle `i`, whose filter may have been misled by them."""
        search = self._search.beside(others)
        starts: list[WindowStart] = []
        for found in search.pairs(self._search.grid, FIRST, SECOND)[:FIRST]:
            pair = in_order_of(self._pairs.setdefault(i, found), found)
            starts += self._started(others, pair, search.moments(pair.ravel()), i)
        return starts

    def _started(self, known: KnownVehicles, paths: FloatArray, moments: FloatArray,
                 replaced: int | None) -> list[WindowStart]:
        """Known vehicles and new ones on `paths` (k, 7) with `moments` (k, 3, 3), of any kinds."""
        n_known, times = len(known.kind) * self._n_one, self._search.times
        labels = self._search.prior.nearest_line(paths)[0].tolist()
        starts = []
        for kinds in product(range(len(self._vehicles.settings.kinds)), repeat=len(paths)):
            x, P, path = known.x, known.P, [known.path[:, :n_known]]
            for theta, m, kind, label in zip(paths, moments, kinds, labels, strict=True):
                at = n_known + (len(path) - 1) * self._n_one
                mean, covariance = self._vehicles.prior(theta, m, times[0], kind, label)
                x, P = np.insert(x, at, mean), inserted(P, covariance, at)
                path.append(self._vehicles.along(theta, m, times, kind))
            starts.append(WindowStart(
                x, P, np.hstack([*path, known.path[:, n_known:]]), (*known.label, *labels),
                (*known.kind, *kinds), known.log_w + len(paths) * self._of_cell, len(paths),
                replaced))
        return starts

    def _sensors_at_start(self) -> FloatArray:
        """Covariance of the states of the sensors when a track begins."""
        observation, std = self._filter.observation, self._vehicles.background_std
        return block_diag(*observation.own_covariance,
                          std**2 * np.eye(3 * len(observation.positions)))

    def _kept(self, starts: Sequence[WindowStart]) -> list[WindowStart]:
        """Those that explain the frames about as well as the best one; moved along."""
        _, _, log_w, paths = self._run(starts)
        order = np.argsort(-log_w, kind='stable')[:MAX_KEPT]
        return [replace(starts[k], path=paths[k]) for k in order.tolist()
                if log_w[k] >= log_w.max() - NATS_KEPT]

    def _with_turns(self, starts: Sequence[WindowStart]) -> list[WindowStart]:
        """Each as it is, and with one of the new vehicles turning."""
        share = self._vehicles.settings.turn_share
        out = []
        for start in starts:
            turning = [P for P in (self._vehicles.turning(start.x, start.P, i)
                                   for i in start.new_indices) if P is not None]
            out.append(replace(start, log_w=start.log_w + float(np.log(1.0 - share))
                               if turning else start.log_w))
            out += [replace(start, P=P, log_w=start.log_w + float(np.log(share / len(turning))))
                    for P in turning]
        return out

    def _run(self, starts: Sequence[WindowStart]
             ) -> tuple[FilterBank, FloatArray, FloatArray, FloatArray]:
        """Bank at the end, log-likelihoods (n,), log-weights (n,) and paths (n, n_frames, n_x)."""
        window, n = self._window, len(starts)
        bank = FilterBank(
            np.array([s.x for s in starts]), np.array([s.P for s in starts]), np.zeros(n),
            labels_of([s.label for s in starts]), labels_of([s.kind for s in starts]), np.arange(n),
            np.full((n, len(self._vehicles.network)), np.nan))
        paths = np.array([s.path for s in starts])
        along = self._filter_of(len(starts[0].kind)).run_along(
            bank, window.frames, window.intervals, paths, passes=PASSES, step=STEP,
            first_is_updated=window.is_updated)
        usable: BoolArray = np.isfinite(along.log_likelihood) \
            & np.isfinite(paths).all(axis=(1, 2)) & np.isfinite(bank.x).all(axis=1) \
            & [self._all_come(s, x) for s, x in zip(starts, bank.x, strict=True)]
        log_likelihood = np.where(usable, along.log_likelihood, -np.inf)
        log_w = log_likelihood + [s.log_w for s in starts] - 0.5 * np.square(
            [overlap_depth(path, self._n_one, len(s.kind), self._vehicles.length_column) / DEPTH_STD
             for s, path in zip(starts, paths, strict=True)])
        return bank, log_likelihood, log_w, paths

    def _all_come(self, start: WindowStart, x: FloatArray) -> bool:
        """Whether the vehicles that were sought are as fast and as strong, in the state `x` (n_x,),
        as what comes: what stands was there before."""
        settings, n = self._vehicles.settings, self._n_one
        for i in start.new_indices:
            speed = np.hypot(*x[i * n + 3:i * n + 5])
            moment = np.linalg.norm(self._vehicles.hard_moments(x[i * n:]).sum(axis=0))
            if not self._search.prior.min_speed <= speed <= MAX_TIMES * max(settings.speeds) \
                    or moment > MAX_TIMES * max(settings.moments):
                return False
        return True

    def _made(self, starts: Sequence[WindowStart], bank: FilterBank, log_likelihood: FloatArray,
              log_w: FloatArray, paths: FloatArray, log_odds: float) -> Joint | None:
        """The `Joint` of those that can be used."""
        rows = np.flatnonzero(np.isfinite(log_w))
        if not len(rows):
            return None
        n = len(rows)
        anchor = FilterBank(
            np.array([starts[k].x for k in rows]), np.array([starts[k].P for k in rows]),
            np.full(n, -np.log(n)), bank.label[rows], bank.kind[rows], np.arange(n), bank.nis[rows])
        now = FilterBank(bank.x[rows], bank.P[rows], log_w[rows] - log_sum_exp(log_w[rows]),
                         anchor.label.copy(), anchor.kind.copy(), np.arange(n), bank.nis[rows])
        n_frames = len(self._window.frames)
        each = log_likelihood[rows] / n_frames
        window = Window(anchor, self._window.is_updated, self._window.frames,
                        self._window.intervals,
                        [np.ascontiguousarray(paths[rows, k]) for k in range(n_frames)],
                        [each.copy() for _ in range(n_frames)], float(log_sum_exp(log_w[rows])),
                        self._window.max_hypotheses)
        n_targets = len(starts[0].kind)
        return Joint(now, window, self._filter_of(n_targets), log_odds, starts[0].replaced,
                     n_targets > self._n_targets)
