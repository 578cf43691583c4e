"""Samples of many sensors that wait for their frame, as arrays."""

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, void

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.compiled import compiled_when_used
from mag_tracking.units import NEVER

ROOM = 32
"""Samples of a sensor that there is room for at first."""

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

    def grow(self) -> None:
        """Room for twice as many."""
        order = (self.first[:, None] + np.arange(self.room)) % self.room
        rows = np.arange(len(self.first))[:, None]
        for name in ('stamp', 'field', 'covariance'):
            old = getattr(self, name)[rows, order]
            setattr(self, name, np.concatenate([old, np.zeros_like(old)], axis=1))
        self.first[:] = 0


@compiled_when_used(
    void(int64, boolean, _I, _I, _II, float64[:, :, ::1], float64[:, :, :, ::1], _I, float64[:,
    ::1], float64[:, ::1], float64[:, :, ::1], _I, _I))
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
