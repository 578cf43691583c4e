"""Samples of many sensors that wait for their frame: arrays, and what each of them costs, compiled.

What `stages.align` does with a sample that nothing is odd about is here a second
time, for many at once; at the first that is odd it stops.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float64, from_dtype, int64, njit, void

from mag_tracking.arrays import FloatArray, IntArray, StructArray
from mag_tracking.calibration.ordinary import NEVER

ROOM = 32
"""Samples of a sensor that there is room for at first."""

CLOCK = np.dtype([(name, np.int64) for name in (
    'first', 'newest', 'end', 'start', 'due', 'period', 'wait', 'watch', 'passed', 'limit',
    'most', 'is_complete')])
"""[ns] The oldest stamp there was, and the newest; the end of the latest frame; where the next
begins at the earliest, and before what it ends; its length; how long a sensor may be silent; a
sensor that the next frame has to wait for, or -1; the newest stamp that was not ahead of all
others, and how far ahead one may be. `most` samples of a sensor are held. `is_complete`: nobody is
known any more for whom the frame would have to wait."""

_CLOCK = from_dtype(CLOCK)[::1]
_I, _II = int64[::1], int64[:, ::1]


class Taken(NamedTuple):
    """Sums over the samples of each sensor."""

    n: IntArray
    """(n_sensors,) how many."""
    n_axis: FloatArray
    """(n_sensors, 3) how many have the axis."""
    field: FloatArray
    """(n_sensors, 3) [T]"""
    covariance: FloatArray
    """(n_sensors, 3, 3) [T^2]"""
    since: IntArray
    """(n_sensors,) [ns] of the stamps, from the end that was asked for."""
    last: IntArray
    """(n_sensors,) [ns] the latest stamp; NEVER where there is none."""


class SampleBuffer:
    """Of each sensor its samples in the order of their stamps: stamp, field, covariance.

    There is room for as many of all as the one that has most needed.
    """

    def __init__(self, n: int) -> None:
        self.first, self.count = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self.stamp, self.field = np.zeros((n, ROOM), dtype=np.int64), np.zeros((n, ROOM, 3))
        self.covariance = np.zeros((n, ROOM, 3, 3))

    def __len__(self) -> int:
        return int(self.count.sum())

    @property
    def room(self) -> int:
        """How many samples of a sensor there is room for."""
        return self.stamp.shape[1]

    def append(self, i: int, stamp: int, field: FloatArray, covariance: FloatArray) -> None:
        """The newest sample of sensor `i`."""
        if self.count[i] == self.room:
            self._grow()
        k = (self.first[i] + self.count[i]) % self.room
        self.stamp[i, k], self.field[i, k], self.covariance[i, k] = stamp, field, covariance
        self.count[i] += 1

    def drop(self, i: int) -> None:
        """Without the oldest sample of sensor `i`."""
        self.first[i] = (self.first[i] + 1) % self.room
        self.count[i] -= 1

    def oldest(self) -> IntArray:
        """(n,) stamps; NEVER where there is no sample."""
        stamps = self.stamp[np.arange(len(self.count)), self.first]
        return np.where(self.count > 0, stamps, NEVER)

    def take(self, end: int, one_each: bool) -> Taken:
        """The samples of before `end`, or with `one_each` the oldest of these; they wait no more.

        Returns
        -------
        Taken
        """
        n = len(self.count)
        taken = Taken(np.zeros(n, dtype=np.int64), np.zeros((n, 3)), np.zeros((n, 3)),
                      np.zeros((n, 3, 3)), np.zeros(n, dtype=np.int64), np.full(n, NEVER))
        _take(end, one_each, self.first, self.count, self.stamp, self.field, self.covariance,
              *taken)
        return taken

    def _grow(self) -> None:
        """Room for twice as many."""
        order = (self.first[:, None] + np.arange(self.room)) % self.room
        rows = np.arange(len(self.first))[:, None]
        for name in ('stamp', 'field', 'covariance'):
            old = getattr(self, name)[rows, order]
            setattr(self, name, np.concatenate([old, np.zeros_like(old)], axis=1))
        self.first[:] = 0


@njit(void(int64, boolean, _I, _I, _II, float64[:, :, ::1], float64[:, :, :, ::1],
                 _I, float64[:, ::1], float64[:, ::1], float64[:, :, ::1], _I, _I), cache=True)
def _take(end: int, one_each: bool, first: IntArray, count: IntArray, stamp: IntArray,
          field: FloatArray, covariance: FloatArray, n: IntArray, n_axis: FloatArray,
          total: FloatArray, total_covariance: FloatArray, since: IntArray,
          last: IntArray) -> None:
    """Take samples out; `since` is the sum of their stamps from `end`."""
    room = stamp.shape[1]
    for i in range(len(first)):
        while count[i] and stamp[i, first[i]] < end and not (one_each and n[i]):
            k = first[i]
            first[i], count[i] = (k + 1) % room, count[i] - 1
            n[i] += 1
            since[i] += stamp[i, k] - end
            last[i] = stamp[i, k]
            for a in range(3):
                if not np.isnan(field[i, k, a]):
                    n_axis[i, a] += 1.0
                    total[i, a] += field[i, k, a]
                for b in range(3):
                    total_covariance[i, a, b] += covariance[i, k, a, b]


@njit(cache=True)
def _is_behind(c: Any, latest: int) -> bool:
    """Whether a sensor is alive, and may still give a sample of before the end of the frame."""
    if latest == NEVER:
        return bool(c.newest - c.first < c.wait)
    return bool(c.newest - c.wait <= latest and latest < c.due)


@njit(cache=True)
def _is_one_behind(c: Any, latest: IntArray) -> bool:
    """Whether there is one; it is watched from now on, until it is behind no more."""
    if c.watch >= 0 and _is_behind(c, latest[c.watch]):
        return True
    for j in range(len(latest)):
        if _is_behind(c, latest[j]):
            c.watch = j
            return True
    return False


@njit(boolean(_CLOCK, _I), cache=True)
def is_one_behind(clocks: StructArray, latest: IntArray) -> bool:
    """Whether there is a sensor that the next frame has to wait for; it is watched then.

    As `hold_ordinary` has them.
    """
    return _is_one_behind(clocks[0], latest)


@njit(int64(_CLOCK, _I, _I, _I, _I, _II, float64[:, :, ::1], float64[:, :, :, ::1],
            _I, _I, float64[:, ::1], float64[:, :, ::1], int64), cache=True)
def hold_ordinary(clocks: StructArray, latest: IntArray, passed: IntArray, first: IntArray,
                  count: IntArray, stamp: IntArray, field: FloatArray, covariance: FloatArray,
                  rows: IntArray, stamps: IntArray, fields: FloatArray, covariances: FloatArray,
                  begin: int) -> int:
    """Hold samples from the one at `begin` on, as long as nothing is odd and the frame waits.

    Parameters
    ----------
    clocks : (1,) CLOCK
        Changed, as all of the next.
    latest, passed : (n_sensors,) [ns]
        The latest stamp of each, also of those that were not ahead of all others.
    first, count, stamp, field, covariance
        `SampleBuffer`.
    rows, stamps, fields, covariances : (n,), (n,) [ns], (n, 3) [T], (n, 3, 3) [T^2]
        The samples; whose they are, negative = odd.
    begin : int

    Returns
    -------
    int
        The first sample that was not held; if `is_complete` because the frame may be complete,
        else because it is odd.
    """
    c, room = clocks[0], stamp.shape[1]
    c.is_complete = 0
    for k in range(begin, len(rows)):
        i, t = rows[k], stamps[k]
        if i < 0 or latest[i] == NEVER or t <= latest[i] or t < c.end or t - c.passed > c.limit \
                or count[i] == room or count[i] >= c.most or np.isnan(covariances[k, 0, 0]) \
                or not np.isfinite(fields[k, 0] + fields[k, 1] + fields[k, 2]):
            return k
        latest[i] = passed[i] = t
        c.newest, c.passed = max(c.newest, t), max(c.passed, t)
        c.first = min(c.first, t)
        if count[i] == 0:
            start = c.end if c.end != NEVER and t < c.end + c.period else t
            c.start = min(c.start, start)
            c.due = c.start + c.period
        place = (first[i] + count[i]) % room
        stamp[i, place] = t
        field[i, place] = fields[k]
        covariance[i, place] = covariances[k]
        count[i] += 1
        if c.due < 0 or not _is_one_behind(c, latest):
            c.is_complete = 1
            return k + 1
    return len(rows)
