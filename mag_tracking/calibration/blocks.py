"""Summaries of short stretches of readings, which a background is fitted to."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import float64, njit, void

from mag_tracking.arrays import FloatArray, Record
from mag_tracking.compiled import compiled_when_used

LEAST_SAMPLES = 8
"""A block has at least so many readings, however slow the sensor: fewer tell nothing of noise."""


LOUDEST = 100.0
"""A block whose variance is so many times that of the quietest is no noise: a target passed within
it, as it can within the long blocks of a slow sensor. Noise and coarse steps stay well below."""


@dataclass(frozen=True)
class Block:
    """Summary of one short stretch."""

    time: float
    """[s], centre."""
    mean: FloatArray
    """(3,) [T]; NaN = axis not reported."""
    scatter: FloatArray
    """(3, 3) [T^2], sum of squared deviations."""
    n: FloatArray
    """(3,) samples per axis."""


def block_of(sensor: np.void) -> Block:
    """`Block` of the sums of a SENSOR over the readings of its complete block."""
    k, mean, scatter = 1 - sensor['now'], np.empty(3), np.empty((3, 3))
    count = sensor['count'][k]
    _moments(sensor['origin'][k], count, sensor['sum'][k], sensor['product'][k], mean, scatter)
    return Block(float(sensor['time'][k] / sensor['n'][k]), mean, scatter,
                 count.diagonal().copy())


@njit(inline='always')
def begin_block_if_due(s: Record, time: float) -> None:
    """Begin the next block where a reading at `time` [s] is the first after the present one.

    What was complete before (`is_full`) must have been used by now.
    """
    if np.isnan(s.end):
        s.end = time + s.length * (1.0 if np.isnan(s.phase) else 1.0 + s.phase)
        return
    if not (time >= s.end and s.n[s.now] >= LEAST_SAMPLES):
        return
    s.now, s.is_full = 1 - s.now, 1
    s.n[s.now] = 0
    if np.isnan(s.phase):
        s.end = time + s.length
    else:
        # With jittering timestamps the blocks of all sensors would sooner or later end with the
        # same reading, and from then on always.
        s.end += ((time - s.end) // s.length + 1.0) * s.length


@njit(inline='always')
def collect(s: Record, time: float, field: FloatArray) -> None:
    """Add a reading, `field` (3,) [T] at `time` [s], to the present block."""
    k = s.now
    if s.n[k] == 0:
        s.time[k] = 0.0
        for a in range(3):
            s.origin[k, a] = np.nan
            for b in range(3):
                s.count[k, a, b] = s.sum[k, a, b] = s.product[k, a, b] = 0.0
    s.n[k] += 1
    s.time[k] += time
    for a in range(3):
        if np.isnan(field[a]):
            continue
        if np.isnan(s.origin[k, a]):
            s.origin[k, a] = field[a]
        d = field[a] - s.origin[k, a]
        for b in range(3):
            if not np.isnan(field[b]):
                # Where it has not been heard before, this reading is the origin of that axis.
                e = 0.0 if np.isnan(s.origin[k, b]) else field[b] - s.origin[k, b]
                s.count[k, a, b] += 1.0
                s.sum[k, a, b] += d
                s.product[k, a, b] += d * e


@compiled_when_used(
    void(float64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[::1], float64[:,
    ::1]))
def _moments(origin: FloatArray, count: FloatArray, total: FloatArray, product: FloatArray,
             mean: FloatArray, scatter: FloatArray) -> None:
    """Mean and sum of squared deviations; an axis that is missing is so in its products only."""
    for a in range(3):
        mean[a] = total[a, a] / count[a, a] if count[a, a] else np.nan
    for a in range(3):
        for b in range(3):
            scatter[a, b] = product[a, b] - total[a, b] * mean[b] - total[b, a] * mean[a] \
                + count[a, b] * mean[a] * mean[b] if count[a, b] else 0.0
    for a in range(3):
        mean[a] += origin[a]


class Blocks(NamedTuple):
    """Many, as arrays: time (k,), mean (k, 3), scatter (k, 3, 3), n (k, 3); as in `Block`."""

    time: FloatArray
    mean: FloatArray
    scatter: FloatArray
    n: FloatArray


class BlockWindow:
    """The latest blocks, as arrays: a line is put through them as often as one comes."""

    def __init__(self, most: int) -> None:
        """`most` are kept."""
        self._time, self._n = np.zeros(most), np.zeros((most, 3))
        self._mean, self._scatter = np.zeros((most, 3)), np.zeros((most, 3, 3))
        self.clear()

    def __len__(self) -> int:
        return min(self._count, len(self._time))

    def clear(self) -> None:
        """Without any block."""
        self._count = 0

    def append(self, block: Block) -> None:
        """The latest; it takes the place of the oldest."""
        i = self._count % len(self._time)
        self._time[i], self._mean[i], self._scatter[i] = block.time, block.mean, block.scatter
        self._n[i] = block.n
        self._count += 1

    def blocks(self) -> Blocks:
        """The `Blocks`, in no order."""
        k = len(self)
        return Blocks(self._time[:k], self._mean[:k], self._scatter[:k], self._n[:k])


def line_through(blocks: Blocks) -> tuple[float, FloatArray, FloatArray]:
    """Weighted least-squares line per axis: centre [s], mean (3,) and slope (3,) there.

    NaN for an axis that no block reports.
    """
    centre, mean, slope = float(blocks.time.mean()), np.empty(3), np.empty(3)
    _line(blocks.time, blocks.n, blocks.mean, centre, mean, slope)
    return centre, mean, slope


@compiled_when_used(
    void(float64[::1], float64[:, ::1], float64[:, ::1], float64, float64[::1], float64[::1]),
    error_model='numpy')
def _line(time: FloatArray, n: FloatArray, y: FloatArray, centre: float, mean: FloatArray,
          slope: FloatArray) -> None:
    """`line_through`; `y` (k, 3) are the means of the blocks."""
    for a in range(3):
        total = mean_t = mean_y = 0.0
        for k in range(len(time)):
            if n[k, a] > 0.0:
                total += n[k, a]
                mean_t += n[k, a] * time[k]
                mean_y += n[k, a] * y[k, a]
        mean_t, mean_y = mean_t / total, mean_y / total
        spread = along = 0.0
        for k in range(len(time)):
            if n[k, a] > 0.0:
                d = time[k] - mean_t
                spread += n[k, a] * d * d
                along += n[k, a] * d * (y[k, a] - mean_y)
        slope[a] = along / spread if spread > 0.0 else 0.0
        mean[a] = mean_y + slope[a] * (centre - mean_t)


def stacked(blocks: Iterable[Block]) -> Blocks:
    """`Blocks` of `Block`s."""
    return Blocks(*(np.array(values, dtype=float) for values in zip(*(
        (b.time, b.mean, b.scatter, b.n) for b in blocks), strict=True)))


def one_is_loud(blocks: Blocks, step_variance: FloatArray) -> bool:
    """Whether a block scatters far more than the others, on any axis.

    `step_variance` (3,) [T^2] is what the sensor's steps add.
    """
    n = blocks.n
    variance = np.where(n > 1, np.einsum('kii->ki', blocks.scatter) / np.maximum(n - 1, 1), np.nan)
    variance = np.maximum(variance, step_variance)
    known = variance[:, ~np.isnan(variance).all(axis=0)]
    return bool((np.nanmax(known, axis=0) > LOUDEST * np.nanmin(known, axis=0)).any())


def pooled_covariance(blocks: Blocks) -> FloatArray | None:
    """(3, 3) scatter within blocks, pooled; None = too few samples, NaN = axis not reported."""
    freedom = blocks.n.sum(axis=0) - np.count_nonzero(blocks.n, axis=0)
    if freedom.max() <= 3:
        return None
    freedom = np.where(freedom > 3, freedom, np.nan)
    covariance: FloatArray = \
        blocks.scatter.sum(axis=0) / np.sqrt(freedom[:, None] * freedom[None, :])
    return covariance
