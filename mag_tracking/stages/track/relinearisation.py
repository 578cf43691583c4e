"""Relinearisation of the leading hypotheses of a running track along their smoothed paths.

An extended Kalman filter linearises each frame at the state predicted at that time. Far from the
sensors, the error of the prediction is several metres. The filter becomes overconfident there and
remains so. Therefore the latest frames are filtered and smoothed again, with motion and field
linearised along the smoothed path of each leading hypothesis. Each such pass is a damped
Gauss-Newton step on the path. If the steps converge, the state at the end of the path replaces the
state of the filter, with the larger of both covariances. If they do not converge, the state is
retained, but the covariance of the path is adopted if it is larger. The filter may be overconfident
in this case: a filter that is linearised at different states gains information about directions
that no single path can observe (Julier and Uhlmann 2001 found this for maps).

The likelihood of the frames along the path does not measure convergence. The model error and the
drift of a moment are proportional to the moment, so the steps minimise a different cost. For the
same reason a path may diverge to moments that explain any field. The path of a long vehicle, whose
model error is largest, is adopted only if it explains the frames no worse than the filter did.
Weights are not changed, because the likelihoods of relinearised and other hypotheses are not
comparable.

The method is the iterated Kalman smoother of Bell 1994.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank, InitialBank
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter, PathResult
from mag_tracking.units import NS

MAX_LOG_RATIO = np.log(1e3)
"""Maximum difference between the largest log-weight and the log-weight of a hypothesis that is
relinearised."""

PASSES = 3
"""Number of Gauss-Newton steps per relinearisation. The next relinearisation continues from the
result."""

STEP_SIZE = 0.5
"""Damping factor of each step. Undamped steps overshoot where the field is strongly nonlinear, and
diverge."""

CONVERGED = 0.3
"""Maximum distance of the smoothed positions from a converged path in the last step, in standard
deviations of the position."""

ATTEMPTED, FAILED = 'paths relinearised', 'paths relinearised without success'
"""Keys of the event counts: all relinearised paths, and paths whose states were not adopted."""

MAX_FRAMES = 64
"""Maximum number of frames in a window. When the window moves, at most half of this number remain.
Without this limit, a window of several seconds at 100 frames per second would exceed the capacity
of one core."""

MAX_ELEMENTS = 5_000_000
"""Maximum product of frames, hypotheses and squared number of states. With many sensors, fewer
hypotheses are relinearised."""


@dataclass(frozen=True)
class Window:
    """The latest frames of a running track, and the path of each hypothesis through them."""

    anchor: FilterBank | InitialBank
    """Bank at the first frame."""
    is_updated: bool
    """Whether the anchor has been updated with the first frame."""
    frames: list[FieldFrame]
    intervals: list[float]
    """[s] Time from the previous frame to each frame."""
    paths: list[FloatArray]
    """For each frame, states (n_hyp, n_x) at which the hypotheses of the anchor are linearised."""
    log_likelihoods: list[FloatArray]
    """For each frame, log-likelihoods (n_hyp,) in the filter; -inf for dropped hypotheses."""
    evidence: float
    """Log-evidence, in the filter, of the frames with which the anchor has not been updated."""
    max_hypotheses: int
    """Maximum number of hypotheses that are relinearised."""


class Relinearisation:
    """Relinearisation of a bank over a window of the latest frames ([Bell94]_; [JulierUhlmann01]_).

    Hypotheses are relinearised at intervals of at least `interval_s`, and at most `max_hypotheses`.
    A window of duration 0 disables relinearisation.
    """

    def __init__(self, interval_s: float, window_s: float, max_hypotheses: int) -> None:
        self._interval_ns, self._window_ns, self._max_hypotheses = \
            interval_s * NS, window_s * NS, max_hypotheses
        self.clear()

    def clear(self) -> None:
        """Discard the window."""
        self._anchor: FilterBank | InitialBank | None = None
        # Log-likelihood gain of each path at the last relinearisation, by origin; see `gain`.
        self._gain: dict[int, float] = {}

    def begin(self, anchor: FilterBank | InitialBank) -> None:
        """Start the window with the bank before the update with the first frame of a track; the
        caller must not modify the bank afterwards."""
        if not self._window_ns:
            return
        self._anchor, self._is_updated = anchor, False
        self._frames: list[FieldFrame] = []
        self._intervals: list[float] = []
        # For each frame and each hypothesis of the anchor: state of the linearisation, and
        # log-likelihood in the filter.
        self._paths: list[FloatArray] = []
        self._log_likelihoods: list[FloatArray] = []
        self._evidence: list[float] = []
        self._last_ns: int | None = None
        self._is_stale = False
        self._gain = {}

    def restart(self) -> None:
        """Start a new window at the next frame, after a change of the filter."""
        self._is_stale = self._anchor is not None

    def add(self, bank: FilterBank, predicted: FloatArray, log_likelihood: FloatArray,
            evidence: float, frame: FieldFrame, dt: float) -> None:
        """Add a frame with which the bank has been updated.

        `predicted` (n_hyp, n_x) are the states at which the frame was first linearised. `evidence`
        is the log-density of the frame over all hypotheses, `log_likelihood` (n_hyp,) that of each
        hypothesis.
        """
        if self._anchor is None:
            return
        if self._is_stale:
            self.begin(bank.copy())
            self._is_updated = True
        if len(bank) < len(self._anchor) // 2:
            self._keep_hypotheses(self._anchor, np.isin(self._anchor.origin, bank.origin))
        rows = _rows(self._anchor, bank)
        path, anchor_log_likelihood = self._anchor.x.copy(), np.full(len(self._anchor), -np.inf)
        path[rows], anchor_log_likelihood[rows] = predicted, log_likelihood
        self._frames.append(frame)
        self._intervals.append(dt)
        self._paths.append(path)
        self._log_likelihoods.append(anchor_log_likelihood)
        self._evidence.append(evidence)
        if self._last_ns is None:
            self._last_ns = frame.stamp_ns

    def _keep_hypotheses(self, anchor: FilterBank | InitialBank, mask: BoolArray) -> None:
        """Drop all hypotheses of the anchor that are not in `mask`."""
        anchor.keep(mask)
        self._paths = [path[mask] for path in self._paths]
        self._log_likelihoods = [values[mask] for values in self._log_likelihoods]

    def relinearise_leading(self, bank_filter: BankFilter, bank: FilterBank) -> 'Counter[str]':
        """Relinearise the leading hypotheses of a bank in place, if the interval has elapsed;
        return the numbers of relinearised paths and of those whose states were not adopted."""
        anchor = self._anchor
        if anchor is None or self._last_ns is None \
                or self._frames[-1].stamp_ns - self._last_ns < self._interval_ns:
            return Counter()
        self._last_ns = self._frames[-1].stamp_ns
        anchor = self._move_window(bank_filter, anchor, bank)
        if self._is_updated and len(self._frames) == 1:
            return Counter()
        leading = self._leading_rows(bank)
        rows = _rows(anchor, bank)[leading]
        leading_bank = anchor.rows(rows)
        paths = np.stack([path[rows] for path in self._paths], axis=1)
        # This also moves the bank from the anchor to the last frame.
        path_result = self._run_along(bank_filter, leading_bank, paths, PASSES)
        is_finite = np.isfinite(path_result.log_likelihood) & np.isfinite(paths).all(axis=(1, 2))
        for path, improved in zip(self._paths, np.swapaxes(paths, 0, 1), strict=True):
            path[rows[is_finite]] = improved[is_finite]
        filtered = np.sum(self._log_likelihoods[int(self._is_updated):], axis=0)[rows]
        gain = np.subtract(path_result.log_likelihood, filtered, where=is_finite,
                           out=np.full(len(rows), -np.inf))
        self._gain = dict(zip(anchor.origin[rows[is_finite]].tolist(), gain[is_finite].tolist(),
                              strict=True))
        converged = path_result.max_shift <= CONVERGED
        is_accepted = is_finite & converged & (
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
        if self._anchor is None or self._is_stale or not self._frames:
            return None
        begin = int(self._is_updated)
        return Window(self._anchor, self._is_updated, self._frames, self._intervals, self._paths,
                      self._log_likelihoods, float(sum(self._evidence[begin:])),
                      self._max_hypotheses)

    def without_target(self, bank_filter: BankFilter, bank: FilterBank, i: int, n: int) -> None:
        """Remove target `i` from the window of a bank and filter that include it.

        The window is shortened to begin at frame `n`, from which the field of the target is weak;
        see `first_weak_frame`.
        """
        if self._anchor is None or self._is_stale or n >= len(self._frames):
            self.restart()
            return
        anchor = self._move_to(bank_filter, self._anchor, bank, n)
        n_one = bank_filter.observation.n_one
        self._anchor = anchor.without_target(i, n_one)
        columns = np.arange(i * n_one, (i + 1) * n_one)
        self._paths = [np.delete(path, columns, axis=1) for path in self._paths]
        self._gain = {}

    def resume(self, window: Window) -> None:
        """Continue with another window, whose hypotheses replace the hypotheses of the track."""
        self.begin(window.anchor)
        self._is_updated = window.is_updated
        self._frames, self._intervals = list(window.frames), list(window.intervals)
        self._paths, self._log_likelihoods = list(window.paths), list(window.log_likelihoods)
        n = len(window.frames)
        self._evidence = [window.evidence / n] * n
        self._last_ns = window.frames[-1].stamp_ns

    def gain(self, origin: int) -> float:
        """Increase of the window's log-likelihood over that in the filter by relinearising the path
        of hypothesis `origin`, nats; 0 if it was not part of the last relinearisation."""
        return self._gain.get(origin, 0.0)

    def _leading_rows(self, bank: FilterBank) -> IntArray:
        """Indices of the heaviest hypotheses, as many as are to be relinearised."""
        n_affordable = MAX_ELEMENTS // (len(self._frames) * bank.x.shape[1]**2)
        order = np.argsort(-bank.log_w, kind='stable')
        leading: IntArray = order[bank.log_w[order] >= bank.log_w.max() - MAX_LOG_RATIO]
        return leading[:max(1, min(self._max_hypotheses, n_affordable))]

    def _move_window(self, bank_filter: BankFilter, anchor: FilterBank | InitialBank,
                     bank: FilterBank) -> FilterBank | InitialBank:
        """Shorten the window to its nominal duration if it is too long; return its anchor."""
        now_ns, n_frames = self._frames[-1].stamp_ns, len(self._frames)
        if now_ns - self._frames[0].stamp_ns <= 2 * self._window_ns and n_frames <= MAX_FRAMES:
            return anchor
        n = next(k for k, f in enumerate(self._frames) if now_ns - f.stamp_ns <= self._window_ns
                 and n_frames - k <= MAX_FRAMES // 2)
        return self._move_to(bank_filter, anchor, bank, n)

    def _move_to(self, bank_filter: BankFilter, anchor: FilterBank | InitialBank,
                 bank: FilterBank, n: int) -> FilterBank:
        """Move the anchor to frame `n`, the new start of the window, and return it."""
        self._keep_hypotheses(anchor, np.isin(anchor.origin, bank.origin))
        moved = self._anchor = anchor.rows(np.arange(len(anchor)))
        self._run_along(bank_filter, moved, np.stack(self._paths[:n + 1], axis=1), 1)
        self._frames, self._intervals = self._frames[n:], self._intervals[n:]
        self._paths, self._log_likelihoods = self._paths[n:], self._log_likelihoods[n:]
        self._evidence = self._evidence[n:]
        self._is_updated = True
        return moved

    def _run_along(self, bank_filter: BankFilter, bank: FilterBank, paths: FloatArray,
                   passes: int) -> PathResult:
        """Run `bank` along `paths` (n_rows, n, n_x) from the anchor; update both in place."""
        n = paths.shape[1]
        return bank_filter.run_along(
            bank, self._frames[:n], self._intervals[:n], paths, passes=passes, step=STEP_SIZE,
            first_is_updated=self._is_updated)


def _replace_states(bank: FilterBank, rows: IntArray, x: FloatArray, P: FloatArray) -> None:
    """Replace states `rows` in place, and covariances with a smaller position variance than `P`."""
    bank_variance, path_variance = (np.einsum('nii->n', C[:, :3, :3]) for C in (bank.P[rows], P))
    bank.x[rows] = x
    bank.P[rows[path_variance > bank_variance]] = P[path_variance > bank_variance]


def _widen_covariances(bank: FilterBank, rows: IntArray, x: FloatArray, P: FloatArray,
                       linear_range: Callable[[FloatArray], FloatArray]) -> None:
    """Replace covariances `rows` in place where `P` has a larger position variance.

    The new covariance includes the difference between `x` and the state of the bank. It is not
    adopted if it is too large for the next linear update.
    """
    difference = x - bank.x[rows]
    wide_P = P + difference[:, :, None] * difference[:, None]
    own_variance, path_variance, wide_variance = (
        np.einsum('nii->n', C[:, :3, :3]) for C in (bank.P[rows], P, wide_P))
    is_wider = (path_variance > own_variance) \
        & (wide_variance < np.square(linear_range(bank.x[rows])))
    bank.P[rows[is_wider]] = wide_P[is_wider]


def _rows(anchor: FilterBank | InitialBank, bank: FilterBank) -> IntArray:
    """For each hypothesis of the bank, its index in the anchor."""
    return np.searchsorted(anchor.origin, bank.origin)
