"""Smoothing of a track with the frames before and after each of its poses.

The best hypothesis at the end is filtered again through all frames that do not contradict it,
smoothed backward, and relinearised once, so that its last pose may differ from the published one.
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.filter_bank import FilterBank, InitialBank
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.units import NS

NOT_SMOOTHED = 'tracks without smoothing'
"""Key of the number of tracks that could not be smoothed as a whole."""
State: TypeAlias = tuple[FloatArray, FloatArray]
"""State (n_x,) and covariance (n_x, n_x)."""
TrackState: TypeAlias = tuple[int, FloatArray, FloatArray]
"""Timestamp [ns], state (n_x,) and covariance (n_x, n_x)."""
RELINEARISATIONS = 1
"""Number of relinearisations along the previous result. Four would improve the tracks of turning
cars and trucks, but degrade that of a car along a corridor of sensors."""
MAX_ELEMENTS = 10_000_000
"""Maximum product of frames and squared number of states: 80 MB, less than a second."""


def smoothed_track(bank_filter: BankFilter, bank: FilterBank, frames: Sequence[FieldFrame],
                   intervals: Sequence[float], updated: bool = False,
                   relinearisations: int = RELINEARISATIONS, path: Sequence[FloatArray] = ()
                   ) -> tuple[list[State], int]:
    """Smoothed states of the only hypothesis of a bank, and number of contradicting frames
    excluded.

    `intervals` [s] are times since the previous frame; `updated` tells whether the bank includes
    the first frame; `path` are known states (n_x,) at the first frames, for the first pass.
    """
    paths = np.full((1, len(frames), bank.x.shape[1]), np.nan)
    for at, known in zip(paths[0], path, strict=False):
        at[:] = known
    path_result = bank_filter.run_along(
        bank.alone(0), frames, intervals, paths, passes=relinearisations + 1, step=1.0,
        first_is_updated=updated, rejects_outliers=True, wants_covariances=True)
    n_excluded = np.count_nonzero(~path_result.used[0, int(updated):])
    return list(zip(paths[0], path_result.covariances[0], strict=True)), int(n_excluded)


class WholeTrack:
    """Stored frames of a running track, for smoothing at its end; a `max_duration_s` of 0 disables
    it, and it `is_abandoned` above a limit or after a change of sensors."""

    def __init__(self, max_duration_s: float) -> None:
        self._max_duration_s = max_duration_s
        self.abandon(False)

    def abandon(self, is_abandoned: bool = True) -> None:
        """Discard all stored frames, and mark the track as not smoothable as a whole."""
        self.is_abandoned = is_abandoned
        self._start: tuple[BankFilter, FilterBank | InitialBank] | None = None
        self._frames: list[FieldFrame] = []
        self._intervals: list[float] = []
        self._is_published: list[bool] = []
        self._duration_s, self._is_updated = 0.0, False
        # Known states (n_hyp, n_x) at the first frames, of the hypotheses with these origins.
        self._paths: list[FloatArray] = []
        self._origin: IntArray = np.zeros(0, dtype=np.int64)

    def begin(self, bank: FilterBank | InitialBank, bank_filter: BankFilter) -> None:
        """Discard all frames; start with a bank, not to be modified, and its filter."""
        self.abandon(False)
        if self._max_duration_s:
            self._start = bank_filter, bank

    def resume(self, window: Window, bank_filter: BankFilter) -> None:
        """Restart with a window of another filter; the frames of the window count as published."""
        anchor = window.anchor.rows(np.arange(len(window.anchor)))
        self.begin(anchor, bank_filter)
        self._is_updated, self._origin = window.is_updated, anchor.origin.copy()
        # The paths are copied, because the window modifies them.
        self._paths = [path.copy() for path in window.paths]
        for frame, dt in zip(window.frames, window.intervals, strict=True):
            self.add(anchor, frame, dt, True)

    def add(self, bank: FilterBank, frame: FieldFrame, dt: float, published: bool) -> None:
        """Add a frame with which the bank has been updated, and whether it was published."""
        if self._start is None:
            return
        self._duration_s += dt
        n_elements = (len(self._frames) + 1) * bank.x.shape[1]**2
        if self._duration_s > self._max_duration_s or n_elements > MAX_ELEMENTS:
            self.abandon()
            return
        self._frames.append(frame)
        self._intervals.append(dt)
        self._is_published.append(published)
        start = self._start[1]
        if len(bank) < len(start) // 2:
            start.keep(np.isin(start.origin, bank.origin))

    def smoothed(self, bank: FilterBank, best: int) -> tuple[list[TrackState], int]:
        """Smoothed states of published frames, if possible, and number of excluded frames."""
        if self._start is None or not self._frames:
            return [], 0
        bank_filter, start = self._start
        origin = int(bank.origin[best])
        states, n_excluded = smoothed_track(
            bank_filter, start.rows(np.flatnonzero(start.origin == origin)), self._frames,
            self._intervals, self._is_updated,
            path=[path[self._origin == origin][0] for path in self._paths])
        return [(frame.stamp_ns, x, P) for frame, (x, P), published in zip(
            self._frames, states, self._is_published, strict=True) if published], n_excluded


class _LaggedFrame(NamedTuple):
    """A frame of a running track, and the bank after the update with this frame."""

    frame: FieldFrame
    dt: float
    published: bool
    origin: IntArray
    x: FloatArray
    P: FloatArray


class FixedLag:
    """Fixed-lag smoother of the latest frames of a track; a `lag_s` of 0 disables it."""

    def __init__(self, lag_s: float) -> None:
        self._lag_s = lag_s
        self._frames: deque[_LaggedFrame] = deque()

    def clear(self) -> None:
        """Drop all frames."""
        self._frames.clear()

    def smoothed(self, bank_filter: BankFilter, bank: FilterBank, best: int, frame: FieldFrame,
                 dt: float, published: bool) -> list[TrackState]:
        """Add a frame; return the states of hypothesis `best` at frames older than the lag."""
        if not self._lag_s:
            return []
        self._frames.append(_LaggedFrame(
            frame, dt, published, bank.origin, bank.x.copy(), bank.P.copy()))
        if len(bank) < len(self._frames[0].origin) // 2:
            masks = [np.isin(k.origin, bank.origin) for k in self._frames]
            self._frames = deque(k._replace(origin=k.origin[mask], x=k.x[mask], P=k.P[mask])
                                 for k, mask in zip(self._frames, masks, strict=True))
        out: list[TrackState] = []
        while (frame.stamp_ns - self._frames[0].frame.stamp_ns) / NS >= self._lag_s:
            if self._frames[0].published:
                out += self.remaining(bank_filter, bank, best)[:1]
            self._frames.popleft()
        return out

    def remaining(self, bank_filter: BankFilter, bank: FilterBank, best: int) -> list[TrackState]:
        """Smoothed states of hypothesis `best` at published frames not returned yet."""
        if not self._frames:
            return []
        oldest = self._frames[0]
        single, row = bank.alone(best), np.flatnonzero(oldest.origin == bank.origin[best])
        single.x, single.P = oldest.x[row].copy(), oldest.P[row].copy()
        states, _ = smoothed_track(bank_filter, single, [k.frame for k in self._frames],
                                   [k.dt for k in self._frames], updated=True, relinearisations=0)
        return [(k.frame.stamp_ns, *state) for k, state in zip(self._frames, states, strict=True)
                if k.published]
