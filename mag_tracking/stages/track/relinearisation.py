"""Relinearisation of the leading hypotheses of a running track along their smoothed paths.

An extended Kalman filter linearises each frame at its prediction. Far from the sensors, this is
wrong by metres, and the filter becomes and remains overconfident. Therefore the latest frames are
filtered and smoothed again along the smoothed path of each leading hypothesis, in damped
Gauss-Newton steps on the path: the iterated Kalman smoother of Bell 1994. If the steps converge,
the state at the end of the path replaces that of the filter, with the larger of both covariances.
Otherwise only a larger covariance of the path is adopted: a filter that is linearised at different
states gains information that no single path has (Julier and Uhlmann 2001 found this for maps).

The likelihood along the path does not measure convergence: the model error and the drift of a
moment are proportional to the moment, so the steps minimise a different cost, and a path may
diverge to moments that explain any field. The path of a long vehicle, whose model error is largest,
is adopted only if it explains the frames no worse than the filter did. Weights are not changed,
because the likelihoods of relinearised and other hypotheses are not comparable.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank, InitialBank
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import WEAK_ENERGY, BankFilter, PathResult
from mag_tracking.units import NS

MAX_LOG_RATIO = np.log(1e3)
"""Maximum difference between the largest log-weight and that of a relinearised hypothesis."""
PASSES, STEP_SIZE = 3, 0.5
"""Number of Gauss-Newton steps per relinearisation, which continues from the previous one, and
their damping factor. Undamped steps diverge where the field is strongly nonlinear."""
CONVERGED = 0.3
"""Maximum shift of the positions of a converged path in the last step, in their stds."""
ATTEMPTED, FAILED = 'paths relinearised', 'paths relinearised without success'
"""Keys of the event counts: all relinearised paths, and paths whose states were not adopted."""
MAX_FRAMES = 64
"""Maximum number of frames in a window, for the capacity of one core; half remain when it moves."""
MAX_ELEMENTS = 5_000_000
"""Maximum product of frames, hypotheses and squared states; limits the hypotheses."""


@dataclass
class Window:
    """The latest frames of a running track, and the path of each hypothesis through them."""

    anchor: FilterBank | InitialBank
    """Bank at the first frame."""
    is_updated: bool
    """Whether the anchor has been updated with the first frame."""
    max_hypotheses: int
    """Maximum number of hypotheses that are relinearised."""
    frames: list[FieldFrame] = field(default_factory=list)
    intervals: list[float] = field(default_factory=list)
    """[s] Time from the previous frame to each frame."""
    paths: list[FloatArray] = field(default_factory=list)
    """For each frame, states (n_hyp, n_x) at which the hypotheses of the anchor are linearised."""
    log_likelihoods: list[FloatArray] = field(default_factory=list)
    """For each frame, log-likelihoods (n_hyp,) in the filter; -inf for dropped hypotheses."""
    evidences: list[float] = field(default_factory=list)
    """For each frame, log-evidence in the filter."""

    @property
    def evidence(self) -> float:
        """Log-evidence of the frames with which the anchor has not been updated."""
        return float(sum(self.evidences[int(self.is_updated):]))

    def keep(self, mask: BoolArray) -> None:
        """Keep the hypotheses of the anchor that are in `mask`."""
        self.anchor.keep(mask)
        self.paths = [path[mask] for path in self.paths]
        self.log_likelihoods = [values[mask] for values in self.log_likelihoods]

    def rows_of(self, bank: FilterBank) -> IntArray:
        """For each hypothesis of the bank, its index in the anchor."""
        return np.searchsorted(self.anchor.origin, bank.origin)


class Relinearisation:
    """Relinearisation of a bank over a window of frames ([Bell94]_; [JulierUhlmann01]_), at
    intervals of `interval_s`, of at most `max_hypotheses`; a window of duration 0 disables it."""

    def __init__(self, interval_s: float, window_s: float, max_hypotheses: int) -> None:
        self._interval_ns, self._window_ns, self._max_hypotheses = \
            interval_s * NS, window_s * NS, max_hypotheses
        self._window: Window | None = None
        self._last_ns: int | None = None
        self._is_stale = False
        # Log-likelihood gain of each path at the last relinearisation, by origin; see `gain`.
        self._gain: dict[int, float] = {}

    def begin(self, anchor: FilterBank | InitialBank, is_updated: bool = False) -> None:
        """Start the window with a bank, not to be modified, before its first update."""
        if self._window_ns:
            self.resume(Window(anchor, is_updated, self._max_hypotheses))

    def resume(self, window: Window) -> None:
        """Continue with another window, whose hypotheses replace the hypotheses of the track."""
        if self._window_ns:
            self._window, self._is_stale, self._gain = window, False, {}
            self._last_ns = window.frames[-1].stamp_ns if window.frames else None

    def restart(self) -> None:
        """Start a new window at the next frame, after a change of the filter."""
        self._is_stale = self._window is not None

    def add(self, bank: FilterBank, predicted: FloatArray, log_likelihood: FloatArray,
            evidence: float, frame: FieldFrame, dt: float) -> None:
        """Add a frame with which the bank has been updated, its linearisation points `predicted`
        (n_hyp, n_x), and its log-densities, by hypothesis (n_hyp,) and over all, `evidence`."""
        if self._is_stale:
            self.begin(bank.copy(), True)
        window = self._window
        if window is None:
            return
        if len(bank) < len(window.anchor) // 2:
            window.keep(np.isin(window.anchor.origin, bank.origin))
        rows = window.rows_of(bank)
        path, of_anchor = window.anchor.x.copy(), np.full(len(window.anchor), -np.inf)
        path[rows], of_anchor[rows] = predicted, log_likelihood
        window.frames.append(frame)
        window.intervals.append(dt)
        window.paths.append(path)
        window.log_likelihoods.append(of_anchor)
        window.evidences.append(evidence)
        if self._last_ns is None:
            self._last_ns = frame.stamp_ns

    def relinearise_leading(self, bank_filter: BankFilter, bank: FilterBank) -> 'Counter[str]':
        """Relinearise the leading hypotheses of a bank in place, if the interval has elapsed;
        return the numbers of relinearised paths and of those whose states were not adopted."""
        window = self._window
        if window is None or self._last_ns is None \
                or window.frames[-1].stamp_ns - self._last_ns < self._interval_ns:
            return Counter()
        self._last_ns = window.frames[-1].stamp_ns
        self._move_window(window, bank_filter, bank)
        if window.is_updated and len(window.frames) == 1:
            return Counter()
        leading = self._leading_rows(window, bank)
        rows = window.rows_of(bank)[leading]
        leading_bank = window.anchor.rows(rows)
        paths = np.stack([path[rows] for path in window.paths], axis=1)
        # This also moves the bank from the anchor to the last frame.
        path_result = _run_along(window, bank_filter, leading_bank, paths, PASSES)
        is_finite = np.isfinite(path_result.log_likelihood) & np.isfinite(paths).all(axis=(1, 2))
        for path, improved in zip(window.paths, np.swapaxes(paths, 0, 1), strict=True):
            path[rows[is_finite]] = improved[is_finite]
        filtered = np.sum(window.log_likelihoods[int(window.is_updated):], axis=0)[rows]
        gain = np.subtract(path_result.log_likelihood, filtered, where=is_finite,
                           out=np.full(len(rows), -np.inf))
        self._gain = dict(zip(window.anchor.origin[rows[is_finite]].tolist(),
                              gain[is_finite].tolist(), strict=True))
        is_accepted = is_finite & (path_result.max_shift <= CONVERGED) & (
            (gain >= 0.0) | ~bank_filter.are_long(bank.kind[leading]))
        _replace_states(bank, leading[is_accepted], leading_bank.x[is_accepted],
                        leading_bank.P[is_accepted])
        is_rejected = is_finite & ~is_accepted
        _widen_covariances(bank, leading[is_rejected], leading_bank.x[is_rejected],
                           leading_bank.P[is_rejected], bank_filter.linear_range)
        return Counter({ATTEMPTED: len(is_accepted), FAILED: int(np.count_nonzero(~is_accepted))})

    @property
    def window(self) -> Window | None:
        """Frames and paths of the window; None if it is empty or about to restart."""
        return None if self._window is None or self._is_stale or not self._window.frames \
            else self._window

    def without_target(self, bank_filter: BankFilter, bank: FilterBank, i: int) -> None:
        """Remove target `i`, and the frames up to the last one in which its field is strong."""
        window, best = self.window, bank.best()
        is_strong = [] if window is None else [
            bank_filter.field_energies(i, path[window.rows_of(bank)[best]], frame).sum()
            > WEAK_ENERGY for path, frame in zip(window.paths, window.frames, strict=True)]
        n = int(np.flatnonzero(is_strong).max(initial=-1)) + 1
        if window is None or n >= len(window.frames):
            self.restart()
            return
        n_one = bank_filter.observation.n_one
        window.anchor = _shorten(window, bank_filter, bank, n).without_target(i, n_one)
        columns = np.arange(i * n_one, (i + 1) * n_one)
        window.paths = [np.delete(path, columns, axis=1) for path in window.paths]
        self._gain = {}

    def gain(self, origin: int) -> float:
        """Increase of the window's log-likelihood over that in the filter by relinearising the path
        of hypothesis `origin`, nats; 0 if it was not part of the last relinearisation."""
        return self._gain.get(origin, 0.0)

    def _leading_rows(self, window: Window, bank: FilterBank) -> IntArray:
        """Indices of the heaviest hypotheses, as many as are to be relinearised."""
        n_affordable = MAX_ELEMENTS // (len(window.frames) * bank.x.shape[1]**2)
        order = np.argsort(-bank.log_w, kind='stable')
        leading: IntArray = order[bank.log_w[order] >= bank.log_w.max() - MAX_LOG_RATIO]
        return leading[:max(1, min(window.max_hypotheses, n_affordable))]

    def _move_window(self, window: Window, bank_filter: BankFilter, bank: FilterBank) -> None:
        """Shorten the window to its nominal duration if it is too long."""
        now_ns, n_frames = window.frames[-1].stamp_ns, len(window.frames)
        if now_ns - window.frames[0].stamp_ns > 2 * self._window_ns or n_frames > MAX_FRAMES:
            _shorten(window, bank_filter, bank, next(
                k for k, f in enumerate(window.frames) if now_ns - f.stamp_ns <= self._window_ns
                and n_frames - k <= MAX_FRAMES // 2))


def _shorten(window: Window, bank_filter: BankFilter, bank: FilterBank, n: int) -> FilterBank:
    """Move the anchor to frame `n`, the new start of the window, and return it."""
    window.keep(np.isin(window.anchor.origin, bank.origin))
    moved = window.anchor.rows(np.arange(len(window.anchor)))
    _run_along(window, bank_filter, moved, np.stack(window.paths[:n + 1], axis=1), 1)
    window.anchor, window.is_updated = moved, True
    window.frames, window.intervals = window.frames[n:], window.intervals[n:]
    window.paths, window.log_likelihoods = window.paths[n:], window.log_likelihoods[n:]
    window.evidences = window.evidences[n:]
    return moved


def _run_along(window: Window, bank_filter: BankFilter, bank: FilterBank, paths: FloatArray,
               passes: int) -> PathResult:
    """Run `bank` along `paths` (n_rows, n, n_x) from the anchor; update both in place."""
    n = paths.shape[1]
    return bank_filter.run_along(
        bank, window.frames[:n], window.intervals[:n], paths, passes=passes, step=STEP_SIZE,
        first_is_updated=window.is_updated)


def _replace_states(bank: FilterBank, rows: IntArray, x: FloatArray, P: FloatArray) -> None:
    """Replace states `rows` in place, and covariances with a smaller position variance than `P`."""
    bank_variance, path_variance = (np.einsum('nii->n', C[:, :3, :3]) for C in (bank.P[rows], P))
    bank.x[rows] = x
    bank.P[rows[path_variance > bank_variance]] = P[path_variance > bank_variance]


def _widen_covariances(bank: FilterBank, rows: IntArray, x: FloatArray, P: FloatArray,
                       linear_range: Callable[[FloatArray], FloatArray]) -> None:
    """Replace covariances `rows` in place where `P` has a larger position variance, plus the
    difference of `x` from the state of the bank, unless it is too large for a linear update."""
    difference = x - bank.x[rows]
    wide_P = P + difference[:, :, None] * difference[:, None]
    own_variance, path_variance, wide_variance = (
        np.einsum('nii->n', C[:, :3, :3]) for C in (bank.P[rows], P, wide_P))
    is_wider = (path_variance > own_variance) \
        & (wide_variance < np.square(linear_range(bank.x[rows])))
    bank.P[rows[is_wider]] = wide_P[is_wider]
