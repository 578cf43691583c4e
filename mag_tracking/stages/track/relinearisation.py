"""Relinearise: the leading hypotheses of a running track once more, by what is known by now.

An extended Kalman filter linearises each frame where it then believed the target to be. Far ahead
of the sensors that is metres off, and what it wrongly took for known there it never unlearns. So
the latest frames are filtered and smoothed again, motion and field linearised along the smoothed
path of each leading hypothesis: damped Gauss-Newton steps on its path. Where they have settled, the
state at its end takes the place of the filter's, with the wider of both covariances. Where they
have not, the state stays, but the filter may be surer than it should be: linearised at one place
and then at another it learns of directions that no single path learns of (Julier and Uhlmann 2001
saw it in maps). So a wider covariance of the path is taken there, too.

How probable the frames are along the path is no measure of it: what a model leaves out of the
field, and how a moment wanders, is in proportion to the moment, so that the steps minimise
something else. For the same reason a path may run away to moments that explain everything. That of
a long vehicle, whose model leaves out most, is taken only where it explains the frames no worse
than the filter did. Weights stay: those of hypotheses that are done again and of others could not
be compared.

Source: Bell 1994, The iterated Kalman smoother as a Gauss-Newton method.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.initial_bank import InitialBank
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter, PathResult
from mag_tracking.units import NS

LEADING = np.log(1e3)
"""A hypothesis leads that is not lighter than the heaviest by more than this."""

PASSES = 3
"""Gauss-Newton steps each time; the next time goes on from where they led."""

STEP = 0.5
"""Each goes so far. Whole ones overshoot where the field is far from linear, and run away."""

SETTLED = 0.3
"""In deviations of the position: a path has settled that the last step moved no more than this
anywhere."""

TRIED, IN_VAIN = 'paths linearised anew', 'paths linearised anew in vain'
"""What is counted."""

MAX_FRAMES = 64
"""The window is shorter where it would hold more than half of these: at 100 frames a second one of
seconds would take more than a core."""

MAX_NUMBERS = 5_000_000
"""Frames times hypotheses times states squared: with many sensors it is done for fewer of them."""


@dataclass(frozen=True)
class Window:
    """The latest frames of a running track, and the path of each hypothesis through them."""

    anchor: FilterBank | InitialBank
    """At the first of the frames."""
    is_updated: bool
    """The anchor has been updated with the first frame."""
    frames: list[FieldFrame]
    intervals: list[float]
    """[s] From the frame before to each."""
    paths: list[FloatArray]
    """(n_hyp, n_x) at each frame: where the hypotheses of the anchor are linearised."""
    log_likelihoods: list[FloatArray]
    """(n_hyp,) of each frame, in the filter; -inf of what was dropped."""
    evidence: float
    """Log-evidence of the frames that the anchor was not updated with, in the filter."""
    most: int
    """So many hypotheses are linearised at most."""


class Relinearisation:
    """The latest frames of a running track, and the path of each hypothesis through them."""

    def __init__(self, interval_s: float, window_s: float, most: int) -> None:
        self._interval_ns, self._window_ns, self._most = interval_s * NS, window_s * NS, most
        self.clear()

    def clear(self) -> None:
        """Nothing is kept: no track is running."""
        self._anchor: FilterBank | InitialBank | None = None
        # {origin: log-likelihood along the path minus that in the filter}, as of the last time.
        self._gain: dict[int, float] = {}

    def begin(self, anchor: FilterBank | InitialBank) -> None:
        """A track begins with a bank like the `anchor`, which is not yet updated with its first
        frame. The passes start from the anchor, and nobody else may write into it. Without a
        window nothing is done.
        """
        if not self._window_ns:
            return
        self._anchor, self._updated = anchor, False
        self._frames: list[FieldFrame] = []
        self._intervals: list[float] = []
        # At each frame, and of each hypothesis of the anchor: where it is linearised, and the
        # log-likelihood that the filter gave it.
        self._paths: list[FloatArray] = []
        self._log_likelihoods: list[FloatArray] = []
        self._evidence: list[float] = []
        self._last_ns: int | None = None
        self._stale = False
        self._gain = {}

    def restart(self) -> None:
        """The filter has changed: what it did before the next frame is not to be done again."""
        self._stale = self._anchor is not None

    def add(self, bank: FilterBank, predicted: FloatArray, log_likelihood: FloatArray,
            evidence: float, frame: FieldFrame, dt: float) -> None:
        """The `FilterBank` was updated with a `FieldFrame`, `dt` [s] after the one before.

        `log_likelihood` (n_hyp,) of it, linearised at the states `predicted` (n_hyp, n_x); where
        the filter iterates its updates that is not quite where it ended. `evidence` is the
        log-density of the frame by all hypotheses.
        """
        if self._anchor is None:
            return
        if self._stale:
            self.begin(bank.copy())
            self._updated = True
        if len(bank) < len(self._anchor) // 2:
            self._keep(self._anchor, np.isin(self._anchor.origin, bank.origin))
        rows = _rows(self._anchor, bank)
        path, of_frame = self._anchor.x.copy(), np.full(len(self._anchor), -np.inf)
        path[rows], of_frame[rows] = predicted, log_likelihood
        self._frames.append(frame)
        self._intervals.append(dt)
        self._paths.append(path)
        self._log_likelihoods.append(of_frame)
        self._evidence.append(evidence)
        if self._last_ns is None:
            self._last_ns = frame.stamp_ns

    def _keep(self, anchor: FilterBank | InitialBank, mask: BoolArray) -> None:
        """Keep the rows of `mask` of all that is kept for each hypothesis of the `anchor`."""
        anchor.keep(mask)
        self._paths = [path[mask] for path in self._paths]
        self._log_likelihoods = [of_frame[mask] for of_frame in self._log_likelihoods]

    def improve(self, bank_filter: BankFilter, bank: FilterBank) -> 'Counter[str]':
        """Linearise the leading hypotheses of the `FilterBank` anew, in place, if it is time to.

        By the `BankFilter` that it is moved with. Returns a Counter of those it was tried for, and
        of those for which it was of no use: they keep their states.
        """
        anchor = self._anchor
        if anchor is None or self._last_ns is None \
                or self._frames[-1].stamp_ns - self._last_ns < self._interval_ns:
            return Counter()
        self._last_ns = self._frames[-1].stamp_ns
        anchor = self._moved_on(bank_filter, anchor, bank)
        if self._updated and len(self._frames) == 1:
            return Counter()
        leading = self._leading(bank)
        rows = _rows(anchor, bank)[leading]
        last = anchor.rows(rows)
        paths = np.stack([path[rows] for path in self._paths], axis=1)
        along = self._run_along(bank_filter, last, paths, PASSES)
        finite = np.isfinite(along.log_likelihood) & np.isfinite(paths).all(axis=(1, 2))
        for path, improved in zip(self._paths, np.swapaxes(paths, 0, 1), strict=True):
            path[rows[finite]] = improved[finite]
        filtered = np.sum(self._log_likelihoods[int(self._updated):], axis=0)[rows]
        gain = np.subtract(along.log_likelihood, filtered, where=finite,
                           out=np.full(len(rows), -np.inf))
        self._gain = dict(zip(anchor.origin[rows[finite]].tolist(), gain[finite].tolist(),
                              strict=True))
        settled = along.unsettled <= SETTLED
        taken = finite & settled & ((gain >= 0.0) | ~bank_filter.are_long(bank.kind[leading]))
        _take(bank, leading[taken], last.x[taken], last.P[taken])
        rest = finite & ~taken
        _widen(bank, leading[rest], last.x[rest], last.P[rest], bank_filter.nearly_linear)
        return Counter({TRIED: len(taken), IN_VAIN: int(np.count_nonzero(~taken))})

    @property
    def window(self) -> Window | None:
        """What is kept; None where nothing is."""
        if self._anchor is None or self._stale or not self._frames:
            return None
        begin = int(self._updated)
        return Window(self._anchor, self._updated, self._frames, self._intervals, self._paths,
                      self._log_likelihoods, float(sum(self._evidence[begin:])), self._most)

    def without_target(self, bank_filter: BankFilter, bank: FilterBank, i: int, n: int) -> None:
        """Target `i` of several is no longer followed, and is not felt from the frame `n` on.

        By the `BankFilter` and the `FilterBank` with that target.
        """
        if self._anchor is None or self._stale or n >= len(self._frames):
            self.restart()
            return
        anchor = self._move_to(bank_filter, self._anchor, bank, n)
        n_one = bank_filter.observation.n_one
        self._anchor = anchor.without_target(i, n_one)
        columns = np.arange(i * n_one, (i + 1) * n_one)
        self._paths = [np.delete(path, columns, axis=1) for path in self._paths]
        self._gain = {}

    def resume(self, window: Window) -> None:
        """Go on from another window, whose hypotheses are now those of the track."""
        self.begin(window.anchor)
        self._updated = window.is_updated
        self._frames, self._intervals = list(window.frames), list(window.intervals)
        self._paths, self._log_likelihoods = list(window.paths), list(window.log_likelihoods)
        n = len(window.frames)
        self._evidence = [window.evidence / n] * n
        self._last_ns = window.frames[-1].stamp_ns

    def gain(self, origin: int) -> float:
        """Log-likelihood [nats] of the latest frames along the path of a hypothesis, minus that in
        its filter; 0 where there is no path, or it was not done last time.
        """
        return self._gain.get(origin, 0.0)

    def _leading(self, bank: FilterBank) -> IntArray:
        """Rows of the heaviest hypotheses, as many as it is done for."""
        affordable = MAX_NUMBERS // (len(self._frames) * bank.x.shape[1]**2)
        order = np.argsort(-bank.log_w, kind='stable')
        leading: IntArray = order[bank.log_w[order] >= bank.log_w.max() - LEADING]
        return leading[:max(1, min(self._most, affordable))]

    def _moved_on(self, bank_filter: BankFilter, anchor: FilterBank | InitialBank,
                  bank: FilterBank) -> FilterBank | InitialBank:
        """The anchor: once the frames are of twice the window, it moves to where the window begins.
        """
        now, n_frames = self._frames[-1].stamp_ns, len(self._frames)
        if now - self._frames[0].stamp_ns <= 2 * self._window_ns and n_frames <= MAX_FRAMES:
            return anchor
        n = next(k for k, f in enumerate(self._frames) if now - f.stamp_ns <= self._window_ns
                 and n_frames - k <= MAX_FRAMES // 2)
        return self._move_to(bank_filter, anchor, bank, n)

    def _move_to(self, bank_filter: BankFilter, anchor: FilterBank | InitialBank,
                 bank: FilterBank, n: int) -> FilterBank:
        """The anchor, moved to the frame `n`, where the window begins from now on."""
        self._keep(anchor, np.isin(anchor.origin, bank.origin))
        moved = self._anchor = anchor.rows(np.arange(len(anchor)))
        self._run_along(bank_filter, moved, np.stack(self._paths[:n + 1], axis=1), 1)
        self._frames, self._intervals = self._frames[n:], self._intervals[n:]
        self._paths, self._log_likelihoods = self._paths[n:], self._log_likelihoods[n:]
        self._evidence = self._evidence[n:]
        self._updated = True
        return moved

    def _run_along(self, bank_filter: BankFilter, bank: FilterBank, paths: FloatArray,
                   passes: int) -> PathResult:
        """Run rows of the anchor, `bank`, along their `paths` (n_rows, n, n_x) through the first n
        of the frames; both are moved.
        """
        n = paths.shape[1]
        return bank_filter.run_along(
            bank, self._frames[:n], self._intervals[:n], paths, passes=passes, step=STEP,
            first_is_updated=self._updated)


def _take(bank: FilterBank, rows: IntArray, x: FloatArray, P: FloatArray) -> None:
    """Take states `x` (n, n_x) for the `rows` (n,) of the bank, and the wider covariances of
    theirs and of `P` (n, n_x, n_x), in place.
    """
    own, path = (np.einsum('nii->n', C[:, :3, :3]) for C in (bank.P[rows], P))
    bank.x[rows] = x
    bank.P[rows[path > own]] = P[path > own]


def _widen(bank: FilterBank, rows: IntArray, x: FloatArray, P: FloatArray,
           nearly_linear: Callable[[FloatArray], FloatArray]) -> None:
    """Take the covariances `P` (n, n_x, n_x) of paths that lead to `x` (n, n_x) where they are
    wider than those of the `rows` (n,) of the bank, in place, with how far the two are apart.

    Not where they are so wide that the next update, linearised at one place, would lead astray.
    """
    difference = x - bank.x[rows]
    apart = P + difference[:, :, None] * difference[:, None]
    own, path, both = (np.einsum('nii->n', C[:, :3, :3]) for C in (bank.P[rows], P, apart))
    wider = (path > own) & (both < np.square(nearly_linear(bank.x[rows])))
    bank.P[rows[wider]] = apart[wider]


def _rows(anchor: FilterBank | InitialBank, bank: FilterBank) -> IntArray:
    """Rows of the `anchor` that the hypotheses of `bank` started from."""
    return np.searchsorted(anchor.origin, bank.origin)
