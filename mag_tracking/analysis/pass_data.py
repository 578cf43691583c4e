"""What a network measured while something passed, as arrays that can be fitted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.separable_fit import SeparableModel, SeparableProblem
from mag_tracking.network import SensorNetwork
from mag_tracking.units import NS

ModelOf: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray], SeparableModel]
"""Of times (n,) [s], positions (n, 3) [m] and matrices (n, 3, 3) that a field is multiplied by."""


@dataclass(frozen=True)
class PassData:
    """Samples of some sensors over one stretch of time; a sensor's samples are neighbours."""

    network: SensorNetwork
    stamp_ns: int
    """Where `t` is zero."""
    t: FloatArray
    """(n,) [s], ascending for each sensor."""
    sensor: IntArray
    """(n,) int, rows of the network, ascending."""
    field: FloatArray
    """(n, 3) [T], sensor frame; NaN = axis not measured."""
    covariance: FloatArray
    """(n, 3, 3) [T^2] of each sample (of one of those that it is the mean of); not read where the
    axis is missing."""
    count: IntArray | None = None
    """(n,) of how many samples each is the mean; None = of one."""

    @classmethod
    def of_frames(cls, network: SensorNetwork, stamps_ns: Sequence[int],
                  fields: Sequence[FloatArray], covariances: Sequence[FloatArray],
                  offsets: Sequence[FloatArray] | None = None) -> 'PassData':
        """The frames of a network.

        Parameters
        ----------
        network : SensorNetwork
        stamps_ns : n int
        fields : n arrays (n_sensors, 3) [T]
        covariances : n arrays (n_sensors, 3, 3) [T^2]
        offsets : n arrays (n_sensors,) [s], optional
            Of the sensors' times from the timestamps.
        """
        n, n_sensors = len(stamps_ns), len(network)
        t = np.tile((np.array(stamps_ns, dtype=np.int64) - stamps_ns[0]) / NS, (n_sensors, 1))
        if offsets is not None:
            t = t + np.array(offsets).T
        return cls(network, stamps_ns[0], t.ravel(), np.repeat(np.arange(n_sensors), n),
                   np.array(fields).transpose(1, 0, 2).reshape(-1, 3),
                   np.array(covariances).transpose(1, 0, 2, 3).reshape(-1, 3, 3))

    @property
    def n_values(self) -> int:
        """How many numbers were measured."""
        return int(np.count_nonzero(~np.isnan(self.field)))

    @cached_property
    def n_independent(self) -> float:
        """How many of these numbers are independent.

        A coarse sensor at rest says the same again and again, with a variance that says so
        (`calibration.resolution`): its readings count by the smallest variance of their axis.
        """
        total = 0.0
        for j in self.sensors:
            mine = self.sensor == j
            variance = np.where(np.isnan(self.field[mine]), np.nan,
                                np.einsum('nii->ni', self.covariance[mine]))
            variance = variance[:, ~np.isnan(variance).all(axis=0)]
            share = np.nanmin(variance, axis=0) / variance
            # Noise that is learnt along the way varies a little; a rest is of dozens of readings.
            total += float(np.nansum(np.where(share > 0.5, 1.0, share)))
        return total

    @property
    def sensors(self) -> IntArray:
        """(k,) rows of the network of which there are measurements."""
        return np.unique(self.sensor[~np.isnan(self.field).all(axis=1)])

    @property
    def positions(self) -> FloatArray:
        """(n, 3) [m], world, of each sample's sensor."""
        return self.network.positions[self.sensor]

    def shifted(self, seconds: float) -> 'PassData':
        """The same with time zero `seconds` later."""
        return replace(self, stamp_ns=self.stamp_ns + int(round(1e9 * seconds)),
                       t=self.t - seconds)

    @cached_property
    def whitening(self) -> FloatArray:
        """(n, 3, 3) W with W C W' = I over the axes measured; the other rows are zero."""
        W = np.zeros((len(self.t), 3, 3))
        present = ~np.isnan(self.field)
        for axes in np.unique(present, axis=0):
            rows = (present == axes).all(axis=1)
            if axes.any():
                block = np.ix_(rows, axes, axes)
                W[block] = np.linalg.inv(np.linalg.cholesky(self.covariance[block]))
        return W if self.count is None else W * np.sqrt(self.count)[:, None, None]

    def averaged(self, most: int) -> 'PassData':
        """The same with at most `most` means of neighbours for each sensor, of fewer where the
        field is strong."""
        size = np.sqrt(np.linalg.norm(self.departure, axis=1))
        rows = []
        for j in np.unique(self.sensor):
            mine = np.flatnonzero(self.sensor == j)
            share = 1.0 / len(mine) + size[mine] / max(size[mine].sum(), 1e-300)
            part = np.floor(np.cumsum(share) / share.sum() * most * (1.0 - 1e-9)).astype(int)
            first = np.flatnonzero(np.diff(part, prepend=-1))
            n = np.diff(first, append=len(mine))
            # The mean of an axis that is missing in part would belong to another time: NaN.
            rows.append((np.add.reduceat(self.t[mine], first) / n, np.full(len(n), j),
                         np.add.reduceat(self.field[mine], first) / n[:, None],
                         np.add.reduceat(self.covariance[mine], first) / n[:, None, None], n))
        t, sensor, field, covariance, n = (np.concatenate(c) for c in zip(*rows, strict=True))
        return replace(self, t=t, sensor=sensor, field=field, covariance=covariance, count=n)

    @cached_property
    def departure(self) -> FloatArray:
        """(n, 3) [T], what departs from each sensor's median: the target, more or less."""
        out = np.zeros_like(self.field)
        for j in self.sensors:
            mine = self.sensor == j
            seen = ~np.isnan(self.field[mine]).all(axis=0)
            level = np.zeros(3)
            level[seen] = np.nanmedian(self.field[mine][:, seen], axis=0)
            out[mine] = np.nan_to_num(self.field[mine] - level)
        return out


def separable_problem(data: PassData, model_of: ModelOf, relative_error: float = 0.0,
                      prior: tuple[FloatArray, FloatArray] | None = None) -> SeparableProblem:
    """The fit of a pass as a `SeparableProblem`, the sensors' backgrounds being unknown.

    Parameters
    ----------
    data : PassData
    model_of : function
        Takes t (n,), positions (n, 3) and M (n, 3, 3) (world to sensor, and whitening), gives a
        `SeparableModel`.
    relative_error : float
        Each sample counts as if its field were wrong by this share of itself, too.
    prior : (mean, std), optional
        Of the path; see `SeparableProblem`.

    Returns a `SeparableProblem`.
    """
    W = data.whitening
    if relative_error > 0.0:
        signal = np.einsum('nij,nj->ni', W, data.departure)
        size2 = np.einsum('ni,ni->n', signal, signal)
        W = W / np.sqrt(1.0 + relative_error**2 * size2)[:, None, None]
    model = model_of(data.t, data.positions, W @ data.network.R_sw[data.sensor])
    y = np.einsum('nij,nj->ni', W, np.nan_to_num(data.field)).ravel()
    return SeparableProblem(model, y, background_columns(data, W), prior)


def background_columns(data: PassData, W: FloatArray) -> FloatArray:
    """(3 n, q): the constant field of each axis of each sensor that was measured, whitened."""
    columns = np.zeros((len(data.t), 3, len(data.network), 3))
    columns[np.arange(len(data.t)), :, data.sensor] = W
    flat = columns.reshape(3 * len(data.t), -1)
    return flat[:, (flat != 0.0).any(axis=0)]
