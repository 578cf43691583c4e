"""Summaries of short stretches of readings, which a background is fitted to."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.calibration import core
from mag_tracking.records import plain

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


def block_of(sensors: StructArray) -> Block:
    """`Block` of the complete block of a sensor, (1,) SENSOR."""
    return Block(*core.block_moments(sensors))


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
    centre = float(blocks.time.mean())
    return centre, *core.line_through(
        plain(blocks.time), plain(blocks.n), plain(blocks.mean), centre)


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
    return core.pooled_covariance(plain(blocks.scatter), plain(blocks.n))
