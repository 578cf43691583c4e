"""Smooth: a track once more, by what came before and after each of its poses.

One hypothesis of the bank, the one that stands at the end, is run through the frames again
and then back. Hypotheses do not touch each other, so this is what it did in the bank.
"""

from collections import deque

import numpy as np

from mag_tracking.inference.smoother import smooth

RELINEARISATIONS = 1
"""How often the whole is linearised anew, at what came of it before. Far ahead of the sensors the
filter did not yet know where to linearise; a second time changes little."""


def smoothed_states(bank_filter, bank, frames, intervals, updated):
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

    Returns
    -------
    list of n (x (n_x,), P (n_x, n_x))
    """
    x_lin = [None] * len(frames)
    for _ in range(RELINEARISATIONS + 1):
        states = _forth_and_back(bank_filter, bank.alone(0), frames, intervals, updated, x_lin)
        x_lin = [x[None] for x, _ in states]
    return states


def _forth_and_back(bank_filter, bank, frames, intervals, updated, x_lin):
    """One pass of filter and smoother, linearised at `x_lin`; None = at the predictions."""
    filtered, predicted, jacobians = [], [], []
    for k, (frame, dt) in enumerate(zip(frames, intervals, strict=True)):
        if k:
            F, decay = bank_filter.predict(bank, dt)
            predicted.append((bank.x[0].copy(), bank.P[0].copy()))
            jacobians.append(_whole(F, decay))
        if k or not updated:
            bank_filter.update(bank, frame, dt, x_lin[k])
        filtered.append((bank.x[0].copy(), bank.P[0].copy()))
    return smooth(filtered, predicted, jacobians)


def _whole(F, decay):
    """(n_x, n_x) from the target's Jacobian and the factors of the other states."""
    n_t = F.shape[-1]
    A = np.diag(np.append(np.ones(n_t), decay))
    A[:n_t, :n_t] = F if F.ndim == 2 else F[0]
    return A


class WholeTrack:
    """The frames of a running track, to smooth it when it ends."""

    def __init__(self, longest_s):
        self._longest_s = longest_s

    def begin(self, bank):
        """A track begins with `bank`, before its first frame."""
        self._x, self._P = bank.x.copy(), bank.P.copy()
        self._frames, self._intervals, self._published = [], [], []
        self._length_s = 0.0

    @property
    def too_long(self):
        """The track is longer than is kept."""
        return self._length_s > self._longest_s

    def add(self, frame, dt, published):
        """A frame was used, `dt` [s] after the one before."""
        self._length_s += dt
        if self.too_long:
            self._frames, self._intervals, self._published = [], [], []
            return
        self._frames.append(frame)
        self._intervals.append(dt)
        self._published.append(published)

    def smoothed(self, bank_filter, bank, best):
        """[(stamp_ns, x, P)] of the published frames, by the hypothesis `best` of the `bank`."""
        if not self._frames:
            return []
        one, row = bank.alone(best), bank.origin[best]
        one.x, one.P = self._x[row:row + 1].copy(), self._P[row:row + 1].copy()
        states = smoothed_states(bank_filter, one, self._frames, self._intervals, False)
        return [(frame.stamp_ns, x, P) for frame, (x, P), published in zip(
            self._frames, states, self._published, strict=True) if published]


class FixedLag:
    """The latest frames of a running track and the bank at each, to smooth the oldest."""

    def __init__(self, lag_s):
        self._lag_s = lag_s
        self._kept = deque()

    def begin(self):
        """A track begins."""
        self._kept.clear()

    def smoothed(self, bank_filter, bank, best, frame, dt, published):
        """[(stamp_ns, x, P)] of the frames that now lie `lag_s` back: none or one, rarely more.

        `bank` after the update with `frame`, which came `dt` [s] after the one before.
        """
        self._kept.append((frame, dt, published, bank.origin, bank.x.copy(), bank.P.copy()))
        out = []
        while (frame.stamp_ns - self._kept[0][0].stamp_ns) / 1e9 >= self._lag_s:
            first, _, was_published, origin, x, P = self._kept[0]
            if was_published:
                row = int(np.flatnonzero(origin == bank.origin[best])[0])
                one = bank.alone(best)
                one.x, one.P = x[row:row + 1].copy(), P[row:row + 1].copy()
                state = smoothed_states(bank_filter, one, [k[0] for k in self._kept],
                                        [k[1] for k in self._kept], True)[0]
                out.append((first.stamp_ns, *state))
            self._kept.popleft()
        return out
