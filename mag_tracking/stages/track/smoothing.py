"""Smooth: a track once more, by what came before and after each of its poses.

One hypothesis of the bank, the one that stands at the end, is run through the frames again and
then back, and is relinearised once. Hypotheses do not touch each other, so one can be run alone.
Frames that contradict it are left out: one of them would bend the whole track. What was published
last need not be where the smoothed track ends: each was linearised elsewhere.
"""

from collections import deque
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.initial_bank import InitialBank
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.units import NS

State: TypeAlias = tuple[FloatArray, FloatArray]
"""State (n_x,) and covariance (n_x, n_x)."""

TrackState: TypeAlias = tuple[int, FloatArray, FloatArray]
"""Timestamp [ns], state (n_x,) and covariance (n_x, n_x)."""

RELINEARISATIONS = 1
"""How often the whole is linearised anew, at what came of it before: far ahead of the sensors the
filter did not yet know where to linearise. It has not settled then: four times bring turning cars
and trucks nearer, but the car along a corridor further off."""

MAX_NUMBERS = 10_000_000
"""Frames times states squared that are smoothed at most: 80 MB, and less than a second."""


def smoothed_track(bank_filter: BankFilter, bank: FilterBank, frames: Sequence[FieldFrame],
                   intervals: Sequence[float], updated: bool = False,
                   relinearisations: int = RELINEARISATIONS, path: Sequence[FloatArray] = ()
                   ) -> tuple[list[State], int]:
    """States of a hypothesis at each frame, given all of them.

    Parameters
    ----------
    bank_filter : BankFilter
    bank : FilterBank
        The hypothesis alone, at the first frame.
    frames : list of n FieldFrame
    intervals : list of n float [s]
        Time from the frame before.
    updated : bool
        The bank has been updated with the first frame.
    relinearisations : int
    path : list of FloatArray (n_x,)
        States at the first frames, as far as they are known; the first pass is linearised there.

    Returns
    -------
    states : list of n (x (n_x,), P (n_x, n_x))
    left_out : int
        Frames that the hypothesis contradicted; it coasted through them.
    """
    paths = np.full((1, len(frames), bank.x.shape[1]), np.nan)
    for at, known in zip(paths[0], path, strict=False):
        at[:] = known
    along = bank_filter.run_along(
        bank.alone(0), frames, intervals, paths, passes=relinearisations + 1, step=1.0,
        first_is_updated=updated, rejects_outliers=True, wants_covariances=True)
    left_out = np.count_nonzero(~along.used[0, int(updated):])
    return list(zip(paths[0], along.covariances[0], strict=True)), int(left_out)


@dataclass
class _Start:
    """Where a track began, and the filter that it was moved with."""

    bank_filter: BankFilter
    bank: FilterBank | InitialBank
    paths: tuple[FloatArray, ...] = ()
    """(n_hyp, n_x) states of all hypotheses at the first frames, as far as they are known."""
    origin: IntArray | None = None
    """(n_hyp,) of the `paths`."""

    def path_of(self, origin: int) -> list[FloatArray]:
        """The path of a hypothesis through the first frames, as far as it is known."""
        return [path[self.origin == origin][0] for path in self.paths]


class WholeTrack:
    """The frames of a running track, to smooth it when it ends."""

    def __init__(self, longest_s: float) -> None:
        self._longest_s = longest_s
        self.clear()

    def clear(self) -> None:
        """Nothing is kept."""
        self._start: _Start | None = None
        self._frames: list[FieldFrame] = []
        self._intervals: list[float] = []
        self._published: list[bool] = []
        self._length_s, self.too_long = 0.0, False
        self._updated = False

    def begin(self, bank: FilterBank | InitialBank, bank_filter: BankFilter) -> None:
        """A track begins with a bank like `bank`, before its first frame, with the settings of now.

        Nobody else may write into `bank`.
        """
        self.clear()
        if self._longest_s:
            self._start = _Start(copy(bank_filter), bank)

    def resume(self, window: Window, bank_filter: BankFilter) -> None:
        """Go on from a window of another filter, of which all frames count as published."""
        anchor = window.anchor.rows(np.arange(len(window.anchor)))
        self.begin(anchor, bank_filter)
        if self._start is not None:
            # The window moves its paths on.
            self._start = replace(self._start, origin=anchor.origin.copy(),
                                  paths=tuple(path.copy() for path in window.paths))
        self._updated = window.is_updated
        for frame, dt in zip(window.frames, window.intervals, strict=True):
            self.add(anchor, frame, dt, True)

    def give_up(self) -> None:
        """It cannot be smoothed as a whole."""
        self.clear()
        self.too_long = True

    def add(self, bank: FilterBank, frame: FieldFrame, dt: float, published: bool) -> None:
        """A frame was used, `dt` [s] after the one before."""
        if self._start is None:
            return
        self._length_s += dt
        n_numbers = (len(self._frames) + 1) * bank.x.shape[1]**2
        if self._length_s > self._longest_s or n_numbers > MAX_NUMBERS:
            self.give_up()
            return
        self._frames.append(frame)
        self._intervals.append(dt)
        self._published.append(published)
        if len(bank) < len(self._start.bank) // 2:
            self._start.bank.keep(np.isin(self._start.bank.origin, bank.origin))

    def smoothed(self, bank: FilterBank, best: int) -> tuple[list[TrackState], int]:
        """[(stamp_ns, x, P)] of the published frames, and how many frames did not fit.

        By the hypothesis `best` of the `bank`.
        """
        start = self._start
        if start is None or not self._frames:
            return [], 0
        origin = int(bank.origin[best])
        one = start.bank.rows(np.flatnonzero(start.bank.origin == origin))
        states, left_out = smoothed_track(start.bank_filter, one, self._frames, self._intervals,
                                          self._updated, path=start.path_of(origin))
        return [(frame.stamp_ns, x, P) for frame, (x, P), published in zip(
            self._frames, states, self._published, strict=True) if published], left_out


class _Kept(NamedTuple):
    """A frame of a running track, and its bank after the update with it."""

    frame: FieldFrame
    dt: float
    published: bool
    origin: IntArray
    x: FloatArray
    P: FloatArray

    def rows(self, mask: BoolArray) -> '_Kept':
        """The hypotheses of the `mask` (n_hyp,) alone."""
        return self._replace(origin=self.origin[mask], x=self.x[mask], P=self.P[mask])


class FixedLag:
    """The latest frames of a running track and the bank at each, to smooth the oldest."""

    def __init__(self, lag_s: float) -> None:
        self._lag_s = lag_s
        self._kept: deque[_Kept] = deque()

    def clear(self) -> None:
        """Nothing is kept: a track has ended."""
        self._kept.clear()

    def smoothed(self, bank_filter: BankFilter, bank: FilterBank, best: int, frame: FieldFrame,
                 dt: float, published: bool) -> list[TrackState]:
        """[(stamp_ns, x, P)] of the frames that now lie `lag_s` back: none or one, rarely more.

        `bank` after the update with `frame`, which came `dt` [s] after the one before.
        """
        self._kept.append(_Kept(frame, dt, published, bank.origin, bank.x.copy(), bank.P.copy()))
        if len(bank) < len(self._kept[0].origin) // 2:
            self._kept = deque(k.rows(np.isin(k.origin, bank.origin)) for k in self._kept)
        out: list[TrackState] = []
        while (frame.stamp_ns - self._kept[0].frame.stamp_ns) / NS >= self._lag_s:
            if self._kept[0].published:
                out.append((self._kept[0].frame.stamp_ns,
                            *self._states(bank_filter, bank, best)[0]))
            self._kept.popleft()
        return out

    def rest(self, bank_filter: BankFilter, bank: FilterBank, best: int) -> list[TrackState]:
        """[(stamp_ns, x, P)] of all frames that are left: the track ends."""
        if not self._kept:
            return []
        return [(kept.frame.stamp_ns, *state) for kept, state in zip(
            self._kept, self._states(bank_filter, bank, best), strict=True) if kept.published]

    def _states(self, bank_filter: BankFilter, bank: FilterBank, best: int) -> list[State]:
        """Smoothed states of the frames that are kept, linearised once: it is done every frame."""
        oldest = self._kept[0]
        one, row = bank.alone(best), np.flatnonzero(oldest.origin == bank.origin[best])
        one.x, one.P = oldest.x[row].copy(), oldest.P[row].copy()
        return smoothed_track(bank_filter, one, [k.frame for k in self._kept],
                              [k.dt for k in self._kept], updated=True, relinearisations=0)[0]
