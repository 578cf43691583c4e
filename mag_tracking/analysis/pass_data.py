"""Readings of a network during a pass, as arrays for a fit."""

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
"""Makes a model from times (n,) [s], positions (n, 3) [m] and matrices (n, 3, 3) that multiply the
field."""


@dataclass(frozen=True)
class PassData:
    """Samples of several sensors over one interval; the samples of one sensor are contiguous."""

    network: SensorNetwork
    stamp_ns: int
    """Timestamp at which `t` is zero [ns]."""
    t: FloatArray
    """(n,) [s], ascending for each sensor."""
    sensor: IntArray
    """(n,) int, rows of the network, ascending."""
    field: FloatArray
    """(n, 3) [T], sensor frame; NaN = axis not measured."""
    covariance: FloatArray
    """(n, 3, 3) [T²] of each sample, or of one of the samples that it is the mean of; ignored for
    missing axes."""
    count: IntArray | None = None
    """(n,) number of samples that each one is the mean of; None = one."""

    @classmethod
    def of_frames(cls, network: SensorNetwork, stamps_ns: Sequence[int],
                  fields: Sequence[FloatArray], covariances: Sequence[FloatArray],
                  offsets: Sequence[FloatArray] | None = None) -> 'PassData':
        """Create the data of a pass from frames.

        Parameters
        ----------
        network : SensorNetwork
        stamps_ns : sequence of n int, ns
        fields : sequence of n (n_sensors, 3) array, T
        covariances : sequence of n (n_sensors, 3, 3) array, T²
        offsets : sequence of n (n_sensors,) array, s, optional
            Time of each sensor's sample relative to the timestamp of the frame.

        Returns
        -------
        PassData
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
        """Number of measured values."""
        return int(np.count_nonzero(~np.isnan(self.field)))

    @cached_property
    def n_independent(self) -> float:
        """Number of independent values.

        A coarse sensor at rest repeats its reading, and its variance is increased accordingly
        (`calibration.resolution`). Each value counts by the smallest variance of its axis over its
        own variance.
        """
        total = 0.0
        for j in self.sensors:
            mine = self.sensor == j
            variance = np.where(np.isnan(self.field[mine]), np.nan,
                                np.einsum('nii->ni', self.covariance[mine]))
            variance = variance[:, ~np.isnan(variance).all(axis=0)]
            share = np.nanmin(variance, axis=0) / variance
            # The estimated noise varies slightly over time. At rest, dozens of readings repeat.
            total += float(np.nansum(np.where(share > 0.5, 1.0, share)))
        return total

    @property
    def sensors(self) -> IntArray:
        """Rows of the network that have measurements, (k,)."""
        return np.unique(self.sensor[~np.isnan(self.field).all(axis=1)])

    @property
    def positions(self) -> FloatArray:
        """Position of the sensor of each sample, (n, 3) m, world frame."""
        return self.network.positions[self.sensor]

    def shifted(self, seconds: float) -> 'PassData':
        """Return the same data with time zero moved.

        Parameters
        ----------
        seconds : float, s
            Positive moves time zero later.

        Returns
        -------
        PassData
        """
        return replace(self, stamp_ns=self.stamp_ns + int(round(1e9 * seconds)),
                       t=self.t - seconds)

    @cached_property
    def whitening(self) -> FloatArray:
        """Matrices W, (n, 3, 3), with W C Wᵀ = I over the measured axes and zero rows elsewhere."""
        W = np.zeros((len(self.t), 3, 3))
        present = ~np.isnan(self.field)
        for axes in np.unique(present, axis=0):
            rows = (present == axes).all(axis=1)
            if axes.any():
                block = np.ix_(rows, axes, axes)
                W[block] = np.linalg.inv(np.linalg.cholesky(self.covariance[block]))
        return W if self.count is None else W * np.sqrt(self.count)[:, None, None]

    def averaged(self, max_samples: int) -> 'PassData':
        """Reduce the data to means of adjacent samples.

        Parameters
        ----------
        max_samples : int
            Maximum number of means for each sensor. Each is over fewer samples where the field is
            strong.

        Returns
        -------
        PassData
        """
        size = np.sqrt(np.linalg.norm(self.departure, axis=1))
        rows = []
        for j in np.unique(self.sensor):
            mine = np.flatnonzero(self.sensor == j)
            share = 1.0 / len(mine) + size[mine] / max(size[mine].sum(), 1e-300)
            part = np.floor(np.cumsum(share) / share.sum() * max_samples * (1.0 - 1e-9)).astype(int)
            first = np.flatnonzero(np.diff(part, prepend=-1))
            n = np.diff(first, append=len(mine))
            # If an axis is missing in some samples, its mean would belong to another time: NaN.
            rows.append((np.add.reduceat(self.t[mine], first) / n, np.full(len(n), j),
                         np.add.reduceat(self.field[mine], first) / n[:, None],
                         np.add.reduceat(self.covariance[mine], first) / n[:, None, None], n))
        t, sensor, field, covariance, n = (np.concatenate(c) for c in zip(*rows, strict=True))
        return replace(self, t=t, sensor=sensor, field=field, covariance=covariance, count=n)

    @cached_property
    def departure(self) -> FloatArray:
        """Field minus the median of each sensor, (n, 3) T: approximately that of the target."""
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
    """Fit of a pass as a separable problem with unknown backgrounds.

    Parameters
    ----------
    data : PassData
    model_of : function
        Takes t (n,), positions (n, 3) and M (n, 3, 3) (world to sensor, whitened) and returns a
        `SeparableModel`.
    relative_error : float
        Model error relative to the field of each sample, added to the noise.
    prior : (mean, std), optional
        Prior of the path; see `SeparableProblem`.

    Returns
    -------
    SeparableProblem
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
    """Whitened columns of the constant fields of all measured axes.

    Parameters
    ----------
    data : PassData
    W : (n, 3, 3) array
        Whitening matrices.

    Returns
    -------
    (3 n, q) array
    """
    columns = np.zeros((len(data.t), 3, len(data.network), 3))
    columns[np.arange(len(data.t)), :, data.sensor] = W
    flat = columns.reshape(3 * len(data.t), -1)
    return flat[:, (flat != 0.0).any(axis=0)]
