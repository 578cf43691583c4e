"""Smooth: a track once more, by what came before and after each of its poses.

One hypothesis of the bank, the one that stands at the end, is run through the frames again and
then back, linearised once anew. Hypotheses do not touch each other, so it can be done alone. Frames
that contradict it are left out: one of them would bend the whole track. What was published last
need not be where the smoothed track ends: each was linearised elsewhere.
"""

from collections import deque
from copy import copy

import numpy as np

from mag_tracking.inference.smoother import Step, smoothed_covariances, smoothed_states
from mag_tracking.units import NS

RELINEARISATIONS = 1
"""How often the whole is linearised anew, at what came of it before: far ahead of the sensors the
filter did not yet know where to linearise."""

MOST_NUMBERS = 10_000_000
"""Frames times states squared that are smoothed at most: 80 MB, and a few seconds."""


def smoothed_track(bank_filter, bank, frames, intervals, updated=False,
                   relinearisations=RELINEARISATIONS):
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

    Returns
    -------
    states : list of n (x (n_x,), P (n_x, n_x))
    left_out : int
        Frames that the hypothesis contradicted; it coasted through them.
    """
    x_lin = [None] * len(frames)
    for _ in range(relinearisations + 1):
        states, left_out = _forth_and_back(bank_filter, bank.alone(0), frames, intervals, updated,
                                           x_lin)
        x_lin = [x[None] for x, _ in states]
    return states, left_out


def _forth_and_back(bank_filter, bank, frames, intervals, updated, x_lin):
    """One pass of filter and smoother, linearised at `x_lin`; None = at the predictions."""
    steps, left_out = [], 0
    for k, (frame, dt) in enumerate(zip(frames, intervals, strict=True)):
        F, decay = bank_filter.predict(bank, dt) if k else (None, None)
        gains = None
        if k or not updated:
            before = bank.x.copy(), bank.P.copy()
            _, gains = bank_filter.update_with_gains(bank, frame, dt, x_lin[k])
            if bank_filter.is_strange(bank, 0, frame):
                bank.x, bank.P = before
                gains = None
                left_out += 1
        steps.append(Step(bank.x.copy(), bank.P.copy(), gains, F, decay))
    return [(x[0], P[0]) for x, P in zip(smoothed_states(steps), smoothed_covariances(steps),
                                         strict=True)], left_out


class WholeTrack:
    """The frames of a running track, to smooth it when it ends."""

    def __init__(self, longest_s):
        self._longest_s = longest_s
        self.clear()

    def clear(self):
        """Nothing is kept."""
        self._filter = self._x = self._P = self._origin = None
        self._frames, self._intervals, self._published = [], [], []
        self._length_s, self.too_long = 0.0, False

    def begin(self, bank, bank_filter):
        """A track begins with `bank`, before its first frame; its settings stay those of now."""
        self.clear()
        if self._longest_s:
            self._filter = copy(bank_filter)
            self._x, self._P, self._origin = bank.x.copy(), bank.P.copy(), bank.origin

    def give_up(self):
        """It cannot be smoothed as a whole."""
        self.clear()
        self.too_long = True

    def add(self, bank, frame, dt, published):
        """A frame was used, `dt` [s] after the one before."""
        if self._filter is None:
            return
        self._length_s += dt
        n_numbers = (len(self._frames) + 1) * bank.x.shape[1]**2
        if self._length_s > self._longest_s or n_numbers > MOST_NUMBERS:
            self.give_up()
            return
        self._frames.append(frame)
        self._intervals.append(dt)
        self._published.append(published)
        if len(bank) < len(self._origin) // 2:
            rows = np.isin(self._origin, bank.origin)
            self._x, self._P, self._origin = self._x[rows], self._P[rows], self._origin[rows]

    def smoothed(self, bank, best):
        """[(stamp_ns, x, P)] of the published frames, and how many frames did not fit.

        By the hypothesis `best` of the `bank`.
        """
        if not self._frames:
            return [], 0
        one, row = bank.alone(best), np.flatnonzero(self._origin == bank.origin[best])
        one.x, one.P = self._x[row].copy(), self._P[row].copy()
        states, left_out = smoothed_track(self._filter, one, self._frames, self._intervals)
        return [(frame.stamp_ns, x, P) for frame, (x, P), published in zip(
            self._frames, states, self._published, strict=True) if published], left_out


class FixedLag:
    """The latest frames of a running track and the bank at each, to smooth the oldest."""

    def __init__(self, lag_s):
        self._lag_s = lag_s
        self._kept = deque()

    def clear(self):
        """Nothing is kept: a track has ended."""
        self._kept.clear()

    def smoothed(self, bank_filter, bank, best, frame, dt, published):
        """[(stamp_ns, x, P)] of the frames that now lie `lag_s` back: none or one, rarely more.

        `bank` after the update with `frame`, which came `dt` [s] after the one before.
        """
        self._kept.append((frame, dt, published, bank.origin, bank.x.copy(), bank.P.copy()))
        if len(bank) < len(self._kept[0][3]) // 2:
            self._kept = deque((f, d, p, origin[rows], x[rows], P[rows]) for f, d, p, origin, x, P
                               in self._kept for rows in [np.isin(origin, bank.origin)])
        out = []
        while (frame.stamp_ns - self._kept[0][0].stamp_ns) / NS >= self._lag_s:
            if self._kept[0][2]:
                out.append((self._kept[0][0].stamp_ns, *self._states(bank_filter, bank, best)[0]))
            self._kept.popleft()
        return out

    def rest(self, bank_filter, bank, best):
        """[(stamp_ns, x, P)] of all frames that are left: the track ends."""
        if not self._kept:
            return []
        return [(kept[0].stamp_ns, *state) for kept, state in zip(
            self._kept, self._states(bank_filter, bank, best), strict=True) if kept[2]]

    def _states(self, bank_filter, bank, best):
        """Smoothed states of the frames that are kept, linearised once: it is done every frame."""
        _, _, _, origin, x, P = self._kept[0]
        one, row = bank.alone(best), np.flatnonzero(origin == bank.origin[best])
        one.x, one.P = x[row].copy(), P[row].copy()
        return smoothed_track(bank_filter, one, [k[0] for k in self._kept],
                              [k[1] for k in self._kept], updated=True, relinearisations=0)[0]
