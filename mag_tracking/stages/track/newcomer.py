"""Newcomers: a vehicle more in the frames of a running track, believed only if evidence demands it.

Where the latest innovations are improbable, the frames of the window that is kept for
relinearising are explained once more with a vehicle more. It is sought beside the paths of those
that are tracked; where the track is as young as the window, both are sought anew, as a filter that
knew of one vehicle has been misled by two. What is found is filtered and smoothed along its path
like any hypothesis, and its evidence is compared with that of the track as it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank, log_sum_exp
from mag_tracking.inference.latest_frames import LatestFrames
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.vehicle_state import VehicleState
from mag_tracking.stages.track.pass_samples import PassSamples
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.stages.track.steady_search import PathPrior, SteadySearch
from mag_tracking.units import NS

FALSE_ALARM = 1e-3
"""Probability that innovations as large as that of the latest frames are noise: a newcomer is then
sought."""

WINDOW_S, AGAIN_S = 0.25, 0.15
"""[s] The latest frames; and at least so much time is between two searches."""

PASSES, STEP = 3, 0.5
"""Gauss-Newton steps along each path, and the share that each goes."""

MOST_ROWS = 320
"""Samples that a search is of: of more frames than that only every other one, or fewer."""

KNOWN_ROWS, FIRST, SECOND = 3, 3, 2
"""So many hypotheses of the tracked vehicles, and paths of a first and of a second vehicle beside
each, are tried."""

NATS_KEPT, MOST_KEPT = 10.0, 12
"""Of the kinds that a newcomer may be those are kept that are no less probable than the best."""

ARRIVES = np.log(0.05)
"""Log-probability that another vehicle comes while one passes."""

N_DISTANCES = 10
"""Places on its line where a newcomer may be when the window begins."""

LEAST_NATS = 10.0
"""A newcomer is believed if the frames are so much more probable with it."""


class NewcomerTest:
    """Whether the latest innovations of a track ask for a newcomer."""

    def __init__(self) -> None:
        self._latest = LatestFrames(WINDOW_S)
        self._last_ns: int | None = None
        self._was_rejected = False

    def add(self, nis: float, degrees_of_freedom: int, stamp_ns: int, rejected: bool) -> None:
        """Count a frame; a sensor that was `rejected` is as good as a large innovation."""
        self._latest.add(stamp_ns, [nis, degrees_of_freedom])
        self._was_rejected = rejected

    def is_due(self, stamp_ns: int) -> bool:
        """Whether a newcomer is to be sought now."""
        total, freedom = self._latest.total
        if not self._was_rejected and chdtrc(max(freedom, 1.0), total) > FALSE_ALARM:
            return False
        if self._last_ns is not None and stamp_ns - self._last_ns < AGAIN_S * NS:
            return False
        self._last_ns = stamp_ns
        return True


@dataclass(frozen=True)
class Joint:
    """Hypotheses of the tracked vehicles and a newcomer, which comes last in their states."""

    bank: FilterBank
    """At the latest frame of the window."""
    window: Window
    """With the hypotheses of all as its anchor."""
    bank_filter: BankFilter
    log_odds: float
    """[nats] Against the track as it is."""
    is_anew: bool
    """The tracked vehicle was sought anew, too."""


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
    is_anew: bool


class NewcomerSearch:
    """Explains a window with one vehicle more."""

    def __init__(self, bank: FilterBank, window: Window, bank_filter: BankFilter,
                 joint_filter: BankFilter, vehicles: VehicleState) -> None:
        """`bank` of the track, moved by `bank_filter`; `joint_filter` is that of one vehicle more.
        """
        self._bank, self._window, self._filter = bank, window, bank_filter
        self._joint_filter, self._vehicles = joint_filter, vehicles
        network, settings = vehicles.network, vehicles.settings
        self._n_one = bank_filter.observation.n_one
        self._n_t = bank_filter.observation.n_target
        self._times = np.array([(f.stamp_ns - window.frames[-1].stamp_ns) / NS
                                for f in window.frames])
        step = -(-len(window.frames) * len(network) // MOST_ROWS)
        self._thinned = np.arange(len(window.frames))[::-1][::step][::-1]
        self._prior = PathPrior.of(settings, network)
        self._samples = PassSamples.of(network, [window.frames[k] for k in self._thinned],
                                       window.frames[-1].stamp_ns, len(network))
        self._starts = self._prior.starts(settings, network)
        self._of_cell = -float(np.log(
            len(settings.arrival_names) * len(settings.lateral_offsets) * len(settings.speeds)
            * len(settings.kinds) * N_DISTANCES))

    def find(self) -> Joint | None:
        """The best explanation with a newcomer; None where there is none at all."""
        rows, of_track, log_w, paths = self._as_it_is()
        starts = [start for k in self._leaders(rows, log_w)
                  for start in self._beside(rows[k], log_w[k] - of_track[k], paths[k])]
        if self._window.is_start and self._bank.label.ndim == 1:
            starts += self._anew()
        if not starts:
            return None
        kept = self._with_turns(self._kept(starts))
        joint, evidence, log_w_joint, joint_paths = self._run(kept)
        alone = float(log_sum_exp(log_w))
        return self._made(kept, joint, evidence, log_w_joint, joint_paths,
                          float(log_sum_exp(log_w_joint)) + ARRIVES - alone)

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

    def _beside(self, row: int, log_w: float, path: FloatArray) -> list[_Start]:
        """A newcomer beside the vehicles of a hypothesis of the track, on its `path` (n, n_x)."""
        search = self._search_beside(row, path)
        window, n_t = self._window, self._n_t
        at = np.searchsorted(window.anchor.origin, self._bank.origin[[row]])
        before = window.anchor.rows(at)
        labels = tuple(np.ravel(self._bank.label[row]).tolist())
        kinds = tuple(np.ravel(self._bank.kind[row]).tolist())
        starts = []
        for theta in search.best(self._starts, FIRST):
            moments = search.moments(theta)
            label = int(self._prior.nearest(theta[None])[0][0])
            for kind in range(len(self._vehicles.settings.kinds)):
                x, P = self._vehicles.prior(theta, self._times[0], kind, label)
                states = self._vehicles.along(theta, moments, self._times, kind)
                starts.append(_Start(
                    np.insert(before.x[0], n_t, x), _inserted(before.P[0], P, n_t),
                    np.hstack([path[:, :n_t], states, path[:, n_t:]]), (*labels, label),
                    (*kinds, kind), log_w + self._of_cell, False))
        return starts

    def _search_beside(self, row: int, path: FloatArray) -> SteadySearch:
        """The search for a vehicle beside those of a hypothesis on its `path` (n, n_x)."""
        samples, observation = self._samples, self._filter.observation
        path, t = path[self._thinned], self._times[self._thinned]
        n = len(path)
        known, H = np.zeros((n, len(observation.positions), 3)), []
        for k in range(n):
            frame = self._window.frames[self._thinned[k]]
            dt = self._window.intervals[self._thinned[k]]
            h, H_k = self._filter.fields_at(path[k], self._bank.kind[row:row + 1], frame, dt)
            known[k] = h
            H.append(H_k)
        columns = self._columns(np.array(H), path[-1], t)
        W = samples.M @ np.swapaxes(
            np.tile(self._vehicles.network.R_sw[samples.compared], (n, 1, 1)), 1, 2)
        known = known[:, samples.compared].reshape(-1, 3)
        columns = columns[:, samples.compared].reshape(len(W), 3, -1)
        return SteadySearch(samples, self._prior, np.einsum('nij,nj->ni', W, known).ravel(),
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
        for first in range(0, self._n_t, self._n_one):
            part = H[..., first:first + self._n_one]
            out += [part[..., :3] * 0.7,
                    0.7 * (part[..., 3:6] + t[:, None, None, None] * part[..., :3])]
            hard = self._vehicles.hard_moments(x[first:first + self._n_one])
            size = float(np.linalg.norm(hard.sum(axis=0)))
            of_moment = part[..., 6:6 + hard.size].reshape(*part.shape[:3], -1, 3).mean(axis=3)
            out.append(0.3 * size * of_moment)
        return np.concatenate(out, axis=3)

    def _anew(self) -> list[_Start]:
        """Both vehicles sought anew, in a window that begins with the track."""
        n = len(self._window.frames)
        search = SteadySearch(self._samples, self._prior, np.zeros(len(self._samples.y)),
                              self._backgrounds())
        sensors = self._window.anchor.rows(np.zeros(1, dtype=int))
        own = (sensors.x[0, self._n_t:], sensors.P[0, self._n_t:, self._n_t:])
        starts = []
        n_kinds = len(self._vehicles.settings.kinds)
        for pair in search.pairs(self._starts, FIRST, SECOND)[:FIRST]:
            moments = [search.beside(pair[1 - i]).moments(pair[i]) for i in (0, 1)]
            label = tuple(self._prior.nearest(pair)[0].tolist())
            for kinds in np.ndindex(n_kinds, n_kinds):
                priors = [self._vehicles.prior(pair[i], self._times[0], kinds[i], label[i])
                          for i in (0, 1)]
                states = [self._vehicles.along(pair[i], moments[i], self._times, kinds[i])
                          for i in (0, 1)]
                x = np.concatenate([priors[0][0], priors[1][0], own[0]])
                P = _inserted(_inserted(own[1], priors[1][1], 0), priors[0][1], 0)
                starts.append(_Start(x, P, np.hstack([*states, np.zeros((n, len(own[0])))]), label,
                                     kinds, 2.0 * self._of_cell, True))
        return starts

    def _kept(self, starts: Sequence[_Start]) -> list[_Start]:
        """Those that explain the frames about as well as the best one; moved along."""
        _, _, log_w, paths = self._run(starts)
        order = np.argsort(-log_w, kind='stable')[:MOST_KEPT]
        return [_moved(starts[k], paths[k]) for k in order.tolist()
                if log_w[k] >= log_w.max() - NATS_KEPT]

    def _with_turns(self, starts: Sequence[_Start]) -> list[_Start]:
        """Each as it is, and with every newcomer turning."""
        out = list(starts)
        for start in starts:
            for i in range(len(start.kind)):
                if start.is_anew or i == len(start.kind) - 1:
                    turning = self._vehicles.turning(start.x, start.P, i)
                    if turning is not None:
                        out.append(_with_P(start, turning))
        return out

    def _run(self, starts: Sequence[_Start]) -> tuple[FilterBank, FloatArray, FloatArray,
                                                      FloatArray]:
        """Bank at the end, log-likelihoods (n,), log-weights (n,) and paths (n, n_frames, n_x)."""
        window, n = self._window, len(starts)
        bank = FilterBank(
            np.array([s.x for s in starts]), np.array([s.P for s in starts]), np.zeros(n),
            np.array([s.label for s in starts]), np.array([s.kind for s in starts]), np.arange(n),
            np.full((n, len(self._vehicles.network)), np.nan))
        paths = np.array([s.path for s in starts])
        along = self._joint_filter.run_along(
            bank, window.frames, window.intervals, paths, passes=PASSES, step=STEP,
            first_is_updated=window.is_updated)
        usable: BoolArray = np.isfinite(along.log_likelihood) \
            & np.isfinite(paths).all(axis=(1, 2)) & np.isfinite(bank.x).all(axis=1)
        log_likelihood = np.where(usable, along.log_likelihood, -np.inf)
        return bank, log_likelihood, log_likelihood + [s.log_w for s in starts], paths

    def _made(self, starts: Sequence[_Start], bank: FilterBank, log_likelihood: FloatArray,
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
                        [each.copy() for _ in range(n_frames)], 0.0, self._window.is_start,
                        self._window.most)
        is_anew = starts[int(rows[np.argmax(log_w[rows])])].is_anew
        return Joint(now, window, self._joint_filter, log_odds, is_anew)


def _inserted(P: FloatArray, block: FloatArray, at: int) -> FloatArray:
    """The covariance `P` (n, n) with an independent `block` (k, k) from row `at` on."""
    n, k = len(P), len(block)
    rows = np.append(np.arange(at), np.arange(at + k, n + k))
    out = np.zeros((n + k, n + k))
    out[rows[:, None], rows] = P
    out[at:at + k, at:at + k] = block
    return out


def _moved(start: _Start, path: FloatArray) -> _Start:
    """The same along another path (n, n_x)."""
    return _Start(start.x, start.P, path, start.label, start.kind, start.log_w, start.is_anew)


def _with_P(start: _Start, P: FloatArray) -> _Start:
    """The same with another covariance (n_x, n_x)."""
    return _Start(start.x, P, start.path, start.label, start.kind, start.log_w, start.is_anew)
