"""Newcomers: a vehicle more in the frames of a running track, believed only if evidence demands it.

Where the latest innovations are improbable, the frames of the window that is kept for
relinearising are explained once more with a vehicle more. It is sought beside the paths of those
that are tracked; where the track is as young as the window, both are sought anew, as a filter that
knew of one vehicle has been misled by two. What is found is filtered and smoothed along its path
like any hypothesis, and its evidence is compared with that of the track as it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.axes import whitened_energy
from mag_tracking.inference.filter_bank import FilterBank, log_sum_exp
from mag_tracking.inference.latest_frames import LatestFrames
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.vehicle_state import VehicleState
from mag_tracking.stages.track.initiation_vehicle import moment_directions
from mag_tracking.stages.track.pass_samples import PassSamples
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.stages.track.steady_search import PathPrior, SteadySearch
from mag_tracking.units import NS

FALSE_ALARM = 1e-3
"""Probability that innovations as large as that of the latest frames are noise: a newcomer is then
sought."""

WINDOW_S, AGAIN_S = 0.25, 0.15
"""[s] The latest frames; and at least so much time is between two searches."""

LONG_AGAIN_S, LONGER = 0.3, 1.5
"""[s] A long vehicle is compared with two so long after the last comparison; then after so many
times as long."""

PASSES, STEP = 3, 0.5
"""Gauss-Newton steps along each path, and the share that each goes."""

MOST_ROWS = 320
"""Samples that a search is of: of more frames than that only every other one, or fewer."""

KNOWN_ROWS, FIRST, SECOND = 3, 3, 2
"""So many hypotheses of the tracked vehicles, and paths of a first and of a second vehicle beside
each, are tried."""

KNOWN_STD, KNOWN_SHARE = 0.7, 0.3
"""[m], [m/s] By so much may vehicles that are tracked be off while another is sought; and by this
share their moments."""

NATS_KEPT, MOST_KEPT = 10.0, 12
"""Of the kinds that a newcomer may be those are kept that are no less probable than the best."""

ARRIVES = np.log(0.05)
"""Log-probability that another vehicle comes while one passes."""

ELSEWHERE_M = 2.0
"""[m] A vehicle that was sought anew, and is found nearer than this, was followed rightly."""

WAS_LOST = np.log(0.01)
"""Log-probability that a vehicle has been elsewhere than its track for the whole window."""

FELT = 4.0
"""A vehicle of which the last frame has less energy, in units of its noise, is not sought again."""

WIDTH, OVERHANG, DEPTH_STD = 1.5, 1.0, 1.0
"""[m] Two bodies are in each other's way that are less than so much apart across their heading; by
so much they are longer than their rows together; and by so much their paths may be off."""

N_DISTANCES = 10
"""Places on its line where a newcomer may be when the window begins."""

LEAST_NATS, AGAIN_NATS, UNDECIDED_NATS = 10.0, 5.0, -5.0
"""Another explanation is believed if the frames are so much more probable with it; or, if less, by
two comparisons in turn. If they are not much less probable with it, the track is in doubt."""


ODD, LONG = 'improbable innovations', 'a long vehicle'
"""Why a track is compared with other explanations."""


class NewcomerTest:
    """Whether a track is to be compared with one of a vehicle more.

    That is so where the latest innovations are improbable. A long vehicle explains two short ones
    without any; it is compared from time to time.
    """

    def __init__(self) -> None:
        self._latest = LatestFrames(WINDOW_S)
        self._last_ns: int | None = None
        self._was_probable = False
        self._was_rejected = self._is_long = False
        self._long_wait_s = LONG_AGAIN_S

    def add(self, nis: float, degrees_of_freedom: int, stamp_ns: int, rejected: bool,
            is_long: bool) -> None:
        """Count a frame.

        Parameters
        ----------
        nis : float
            Normalised innovation squared.
        degrees_of_freedom : int
        stamp_ns : int
        rejected : bool
            A sensor was left out, which is as good as a large innovation.
        is_long : bool
            The best hypothesis is a long vehicle.
        """
        self._latest.add(stamp_ns, [nis, degrees_of_freedom])
        self._was_rejected, self._is_long = rejected, is_long

    def due(self, stamp_ns: int) -> str | None:
        """`ODD` or `LONG` if the track is to be compared now, else None."""
        total, freedom = self._latest.total
        since = np.inf if self._last_ns is None else (stamp_ns - self._last_ns) / NS
        reason = None
        if self._was_rejected or chdtrc(max(freedom, 1.0), total) <= FALSE_ALARM:
            reason = ODD if since >= AGAIN_S else None
        elif self._is_long and since >= self._long_wait_s:
            reason = LONG
            self._long_wait_s *= LONGER
        if reason is not None:
            self._last_ns = stamp_ns
        return reason


    def believes(self, log_odds: float) -> bool:
        """Whether another explanation is believed, given those compared before."""
        believes = log_odds > LEAST_NATS or self._was_probable and log_odds > AGAIN_NATS
        self._was_probable = log_odds > AGAIN_NATS and not believes
        return believes


@dataclass(frozen=True)
class Joint:
    """Hypotheses of the tracked vehicles and a newcomer; what is new comes last in their states."""

    bank: FilterBank
    """At the latest frame of the window."""
    window: Window
    """With the hypotheses of all as its anchor."""
    bank_filter: BankFilter
    log_odds: float
    """[nats] Against the track as it is."""
    replaced: int | None
    """This vehicle of the track was sought anew: one of the last two is it, or the last."""
    adds: bool
    """There is a vehicle more."""


@dataclass(frozen=True)
class _Start:
    """A hypothesis at the beginning of a window, with the path to linearise it along."""

    x: FloatArray
    """(n_x,)"""
    P: FloatArray
    """(n_x, n_x)"""
    path: FloatArray
    """(n, n_x)"""
    label: tuple[int, ...]
    kind: tuple[int, ...]
    log_w: float
    n_new: int
    """So many vehicles were sought: the last ones."""
    replaced: int | None
    """As of `Joint`."""

    @property
    def are_new(self) -> range:
        """Places of the vehicles that were sought."""
        return range(len(self.kind) - self.n_new, len(self.kind))


@dataclass(frozen=True)
class _Known:
    """Vehicles that are known, beside which others are sought."""

    x: FloatArray
    """(n_x,) at the beginning of the window."""
    P: FloatArray
    path: FloatArray
    """(n, n_x)"""
    label: tuple[int, ...]
    kind: tuple[int, ...]
    log_w: float
    filter: BankFilter | None
    """Of them; None where there are none."""


class NewcomerSearch:
    """Explains a window with one vehicle more."""

    def __init__(self, bank: FilterBank, window: Window, filter_of: Callable[[int], BankFilter],
                 n_targets: int, vehicles: VehicleState, reason: str, may_be_more: bool
                 ) -> None:
        """`bank` of a track of `n_targets` vehicles; `filter_of` makes the filter of so many.

        The `reason` is that of `NewcomerTest.due`: nobody is sought beside a long vehicle, or
        elsewhere, if the innovations are as they should be. Unless there `may_be_more`, only the
        track's own vehicles are sought anew.
        """
        self._is_odd = reason == ODD
        self._bank, self._window = bank, window
        self._filter_of, self._n_targets, self._vehicles = filter_of, n_targets, vehicles
        self._filter, self._may_be_more = filter_of(n_targets), may_be_more
        network, settings = vehicles.network, vehicles.settings
        self._n_one = self._filter.observation.n_one
        self._times = np.array([(f.stamp_ns - window.frames[-1].stamp_ns) / NS
                                for f in window.frames])
        step = -(-len(window.frames) * len(network) // MOST_ROWS)
        self._thinned = np.arange(len(window.frames))[::-1][::step][::-1]
        self._prior = PathPrior.of(settings, network)
        self._samples = PassSamples.of(network, [window.frames[k] for k in self._thinned],
                                       window.frames[-1].stamp_ns, len(network))
        self._starts = self._prior.starts(settings, network)
        # The first pair that was found in place of a vehicle: all have its order.
        self._pairs: dict[int, FloatArray] = {}
        self._of_cell = -float(np.log(
            len(settings.arrival_names) * len(settings.lateral_offsets) * len(settings.speeds)
            * len(settings.kinds) * len(moment_directions()) * N_DISTANCES))

    def find(self) -> Joint | None:
        """The best explanation with a newcomer, or with a vehicle elsewhere; None where there is
        none at all."""
        rows, of_track, log_w, paths = self._as_it_is()
        more: list[_Start] = []
        elsewhere: list[_Start] = []
        for k in self._leaders(rows, log_w):
            known = self._known(rows[k], log_w[k] - of_track[k], paths[k])
            if self._may_be_more and self._is_odd:
                more += self._beside(known)
            for i in range(self._n_targets):
                others = self._without(known, i)
                if self._is_odd and self._is_felt(known, i):
                    elsewhere += self._beside(others, i)
                if self._may_be_more and self._may_be_two(known, i):
                    more += self._anew(others, i)
        alone = float(log_sum_exp(log_w))
        found = [self._best_of(starts, alone) for starts in (more, elsewhere) if starts]
        return max((joint for joint in found if joint is not None
                    and (joint.adds or self._is_elsewhere(joint))),
                   key=lambda joint: joint.log_odds, default=None)

    def _best_of(self, starts: Sequence[_Start], alone: float) -> Joint | None:
        """What comes of hypotheses of as many vehicles; `alone` is the log-evidence of the track
        as it is."""
        kept = self._with_turns(self._kept(starts))
        prior = ARRIVES if len(kept[0].kind) > self._n_targets else WAS_LOST
        bank, log_likelihood, log_w, paths = self._run(kept)
        return self._made(kept, bank, log_likelihood, log_w, paths,
                          float(log_sum_exp(log_w)) + prior - alone)

    def _as_it_is(self) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """The leading hypotheses of the track along their paths: rows of the bank (n,), the
        log-likelihood of each, its log-weight with that, and its path (n, n_frames, n_x)."""
        window, bank = self._window, self._bank
        order = np.argsort(-bank.log_w, kind='stable')[:window.most]
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
        """Which of the `rows` are tried with a newcomer: the best of each arrival and kind."""
        seen: set[tuple[int, ...]] = set()
        chosen = []
        for k in np.argsort(-log_w, kind='stable').tolist():
            what = (*np.ravel(self._bank.label[rows[k]]).tolist(),
                    *np.ravel(self._bank.kind[rows[k]]).tolist())
            if np.isfinite(log_w[k]) and what not in seen and len(chosen) < KNOWN_ROWS:
                seen.add(what)
                chosen.append(k)
        return chosen

    def _known(self, row: int, log_w: float, path: FloatArray) -> '_Known':
        """The vehicles of a hypothesis of the track, with its log-weight at the anchor."""
        at = np.searchsorted(self._window.anchor.origin, self._bank.origin[[row]])
        before = self._window.anchor.rows(at)
        return _Known(before.x[0], before.P[0], path, tuple(np.ravel(self._bank.label[row]).tolist()),
                      tuple(np.ravel(self._bank.kind[row]).tolist()), log_w, self._filter)

    def _may_be_two(self, known: '_Known', i: int) -> bool:
        """Whether vehicle `i` is long, or alone."""
        return self._n_targets == 1 or bool(
            self._filter.are_long(np.array([known.kind[i]]))[0])

    def _is_felt(self, known: '_Known', i: int) -> bool:
        """Whether the sensors feel vehicle `i` in the last frame."""
        frame = self._window.frames[-1]
        field = self._filter.observation.field_of(known.path[-1], [i], np.zeros(len(frame.field)))
        energy, _ = whitened_energy(np.where(np.isnan(frame.field), np.nan, field),
                                    frame.covariance)
        return bool(energy.sum() > FELT)

    def _is_elsewhere(self, joint: Joint) -> bool:
        """Whether a vehicle that was sought anew is far from where the track has it."""
        n, now = self._n_one, self._bank.x[self._bank.best()]
        assert joint.replaced is not None
        found = joint.bank.x[joint.bank.best()]
        last = n * (self._n_targets - 1)
        before = now[joint.replaced * n:joint.replaced * n + 2]
        return bool(np.hypot(*(found[last:last + 2] - before)) > ELSEWHERE_M)

    def _without(self, known: '_Known', i: int) -> '_Known':
        """The same without vehicle `i`; of one alone nothing is left that is known."""
        n, n_t = self._n_one, len(known.kind) * self._n_one
        if self._n_targets == 1:
            own = self._sensors_at_start()
            return _Known(np.zeros(len(own)), own, np.zeros((len(self._times), len(own))), (), (),
                          0.0, None)
        rows = np.delete(np.arange(known.path.shape[1]), np.arange(i * n, (i + 1) * n))
        assert n_t > n
        return _Known(known.x[rows], known.P[np.ix_(rows, rows)], known.path[:, rows],
                      known.label[:i] + known.label[i + 1:], known.kind[:i] + known.kind[i + 1:],
                      known.log_w, self._filter_of(self._n_targets - 1))

    def _beside(self, known: '_Known', replaced: int | None = None) -> list[_Start]:
        """One vehicle beside known ones: a newcomer, or in place of vehicle `replaced`."""
        search = self._search_beside(known)
        return [start for theta in search.best(self._starts, FIRST)
                for start in self._started(known, theta[None], [search.moments(theta)], replaced)]

    def _anew(self, others: '_Known', i: int) -> list[_Start]:
        """Two vehicles in place of vehicle `i`, whose filter may have been misled by them."""
        search = self._search_beside(others)
        starts = []
        for found in search.pairs(self._starts, FIRST, SECOND)[:FIRST]:
            pair = _in_order_of(self._pairs.setdefault(i, found), found)
            moments = [search.beside(pair[1 - k]).moments(pair[k]) for k in (0, 1)]
            starts += self._started(others, pair, moments, i)
        return starts

    def _started(self, known: '_Known', paths: FloatArray, moments: Sequence[FloatArray],
                 replaced: int | None) -> list[_Start]:
        """Known vehicles and new ones on `paths` (k, 7), of any kinds."""
        n_known, labels = len(known.kind) * self._n_one, self._prior.nearest(paths)[0].tolist()
        starts = []
        for kinds in product(range(len(self._vehicles.settings.kinds)), repeat=len(paths)):
            x, P, path = known.x, known.P, [known.path[:, :n_known]]
            for theta, m, kind, label in zip(paths, moments, kinds, labels, strict=True):
                at = n_known + (len(path) - 1) * self._n_one
                mean, covariance = self._vehicles.prior(theta, m, self._times[0], kind, label)
                x, P = np.insert(x, at, mean), _inserted(P, covariance, at)
                path.append(self._vehicles.along(theta, m, self._times, kind))
            starts.append(_Start(x, P, np.hstack([*path, known.path[:, n_known:]]),
                                 (*known.label, *labels), (*known.kind, *kinds),
                                 known.log_w + len(paths) * self._of_cell, len(paths),
                                 replaced))
        return starts

    def _search_beside(self, known: '_Known') -> SteadySearch:
        """The search for a vehicle beside those that are known."""
        samples = self._samples
        if known.filter is None:
            return SteadySearch(samples, self._prior, np.zeros(len(samples.y)), self._backgrounds())
        path, t = known.path[self._thinned], self._times[self._thinned]
        n, kind = len(path), np.array([known.kind])
        fields = [known.filter.fields_at(path[k], kind, self._window.frames[i],
                                         self._window.intervals[i])
                  for k, i in enumerate(self._thinned.tolist())]
        h, H = (np.array(part) for part in zip(*fields, strict=True))
        W = samples.M @ np.swapaxes(
            np.tile(self._vehicles.network.R_sw[samples.compared], (n, 1, 1)), 1, 2)
        h = h[:, samples.compared].reshape(-1, 3)
        columns = self._columns(H, path[-1], t)[:, samples.compared].reshape(len(W), 3, -1)
        return SteadySearch(samples, self._prior, np.einsum('nij,nj->ni', W, h).ravel(),
                            np.hstack([self._backgrounds(), (W @ columns).reshape(3 * len(W), -1)]))

    def _backgrounds(self) -> FloatArray:
        """(3 n, q) whitened columns of the backgrounds, each times its standard deviation."""
        return self._vehicles.background_std * self._samples.backgrounds

    def _columns(self, H: FloatArray, x: FloatArray, t: FloatArray) -> FloatArray:
        """(n, n_sensors, 3, q) fields of one deviation of what is not known of the vehicles.

        By the derivatives `H` (n, n_sensors, 3, n_t) along a path that ends with `x` (n_x,), at the
        times `t` (n,) [s] before that.
        """
        out = []
        for first in range(0, H.shape[-1], self._n_one):
            part = H[..., first:first + self._n_one]
            by_velocity = part[..., 3:6] + t[:, None, None, None] * part[..., :3]
            hard = self._vehicles.hard_moments(x[first:first + self._n_one])
            of_moment = part[..., 6:6 + hard.size].reshape(*part.shape[:3], -1, 3).mean(axis=3)
            size = float(np.linalg.norm(hard.sum(axis=0)))
            out += [KNOWN_STD * part[..., :3], KNOWN_STD * by_velocity,
                    KNOWN_SHARE * size * of_moment]
        return np.concatenate(out, axis=3)

    def _sensors_at_start(self) -> FloatArray:
        """Covariance of the states of the sensors when a track begins."""
        observation, std = self._filter.observation, self._vehicles.background_std
        return block_diag(*observation.own_covariance,
                          std**2 * np.eye(3 * len(observation.positions)))

    def _kept(self, starts: Sequence[_Start]) -> list[_Start]:
        """Those that explain the frames about as well as the best one; moved along."""
        _, _, log_w, paths = self._run(starts)
        order = np.argsort(-log_w, kind='stable')[:MOST_KEPT]
        return [replace(starts[k], path=paths[k]) for k in order.tolist()
                if log_w[k] >= log_w.max() - NATS_KEPT]

    def _with_turns(self, starts: Sequence[_Start]) -> list[_Start]:
        """Each as it is, and with one of the new vehicles turning."""
        share = self._vehicles.settings.turn_share
        out = []
        for start in starts:
            turning = [P for P in (self._vehicles.turning(start.x, start.P, i)
                                   for i in start.are_new) if P is not None]
            out.append(replace(start, log_w=start.log_w + float(np.log(1.0 - share))
                               if turning else start.log_w))
            out += [replace(start, P=P, log_w=start.log_w + float(np.log(share / len(turning))))
                    for P in turning]
        return out

    def _run(self, starts: Sequence[_Start]) -> tuple[FilterBank, FloatArray, FloatArray,
                                                      FloatArray]:
        """Bank at the end, log-likelihoods (n,), log-weights (n,) and paths (n, n_frames, n_x)."""
        window, n = self._window, len(starts)
        bank = FilterBank(
            np.array([s.x for s in starts]), np.array([s.P for s in starts]), np.zeros(n),
            _labels([s.label for s in starts]), _labels([s.kind for s in starts]), np.arange(n),
            np.full((n, len(self._vehicles.network)), np.nan))
        paths = np.array([s.path for s in starts])
        along = self._filter_of(len(starts[0].kind)).run_along(
            bank, window.frames, window.intervals, paths, passes=PASSES, step=STEP,
            first_is_updated=window.is_updated)
        usable: BoolArray = np.isfinite(along.log_likelihood) \
            & np.isfinite(paths).all(axis=(1, 2)) & np.isfinite(bank.x).all(axis=1)
        log_likelihood = np.where(usable, along.log_likelihood, -np.inf)
        log_w = log_likelihood + [s.log_w for s in starts] - 0.5 * np.square(
            [_depth(path, self._n_one, len(s.kind), self._vehicles.length_column) / DEPTH_STD
             for s, path in zip(starts, paths, strict=True)])
        return bank, log_likelihood, log_w, paths

    def _made(self, starts: Sequence[_Start], bank: FilterBank, log_likelihood: FloatArray,
              log_w: FloatArray, paths: FloatArray, log_odds: float) -> Joint | None:
        """The `Joint` of those that can be used, and have the states of the best in their order."""
        best = int(np.argmax(log_w))
        if not np.isfinite(log_w[best]):
            return None
        replaced = starts[best].replaced
        rows = np.flatnonzero(np.isfinite(log_w) & [s.replaced == replaced for s in starts])
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
                        self._window.is_start, self._window.most)
        n_targets = len(starts[best].kind)
        return Joint(now, window, self._filter_of(n_targets), log_odds, replaced,
                     n_targets > self._n_targets)


def _inserted(P: FloatArray, block: FloatArray, at: int) -> FloatArray:
    """The covariance `P` (n, n) with an independent `block` (k, k) from row `at` on."""
    n, k = len(P), len(block)
    rows = np.append(np.arange(at), np.arange(at + k, n + k))
    out = np.zeros((n + k, n + k))
    out[rows[:, None], rows] = P
    out[at:at + k, at:at + k] = block
    return out


def _in_order_of(first: FloatArray, pair: FloatArray) -> FloatArray:
    """A pair of paths (2, 7), the nearer one of the `first` pair's first coming first."""
    away = np.linalg.norm(pair[:, None, :2] - first[:, :2], axis=2)
    return pair if away[0, 0] + away[1, 1] <= away[0, 1] + away[1, 0] else pair[::-1].copy()


def _labels(labels: Sequence[tuple[int, ...]]) -> IntArray:
    """(n,) or (n, n_targets) as of a `FilterBank`."""
    out = np.array(labels)
    return out[:, 0].copy() if out.shape[1] == 1 else out


def _depth(path: FloatArray, n_one: int, n_targets: int, length: int | None) -> float:
    """[m] by how much two vehicles of a `path` (n, n_x) are in each other at most.

    Each has `n_one` states, of which `length` is the column of its length; None: all are points.
    """
    x = path[:, :n_one * n_targets].reshape(len(path), n_targets, n_one)
    forward = x[:, :, 3:5] / np.maximum(np.linalg.norm(x[:, :, 3:5], axis=2), 1e-6)[:, :, None]
    depth = 0.0
    for i in range(n_targets):
        for k in range(i):
            away = x[:, i, :2] - x[:, k, :2]
            along = np.abs(np.einsum('ni,ni->n', away, forward[:, k]))
            across = np.abs(away[:, 0] * forward[:, k, 1] - away[:, 1] * forward[:, k, 0])
            need = OVERHANG + (0.0 if length is None else
                               0.5 * (np.abs(x[:, i, length]) + np.abs(x[:, k, length])))
            depth = max(depth, float(np.where(across < WIDTH, need - along, 0.0).max()))
    return depth
