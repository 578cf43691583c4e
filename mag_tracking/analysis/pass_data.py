"""Readings of a network during a pass, as arrays for a fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import SeparableModel, SeparableProblem
from mag_tracking.network import SensorNetwork
from mag_tracking.units import NS

ModelFactory: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray], SeparableModel]
"""Creates a model from times (n,) [s], positions (n, 3) [m] and factors (n, 3, 3) of the field."""


@dataclass(frozen=True)
class PassData:
    """Samples of several sensors in one interval, sorted by sensor."""

    network: SensorNetwork
    stamp_ns: int
    """Timestamp at which `t` is zero [ns]."""
    t: FloatArray
    """(n,) [s], ascending for each sensor."""
    sensor: IntArray
    """(n,) index of the sensor of each sample, ascending."""
    field: FloatArray
    """(n, 3) [T], sensor frame; NaN for axes that were not measured."""
    covariance: FloatArray
    """(n, 3, 3) [T²] covariance of each sample, or mean of those of averaged samples."""
    count: IntArray | None = None
    """(n,) number of averaged samples; None if no samples were averaged."""
    doubt: str = ''
    """Reason why the readings are wrong, so that no fit is accepted; empty if none is known."""

    @classmethod
    def from_frames(cls, network: SensorNetwork, stamps_ns: Sequence[int],
                    fields: Sequence[FloatArray], covariances: Sequence[FloatArray],
                    offsets: Sequence[FloatArray] | None = None) -> 'PassData':
        """Create the data of a pass from frames of all sensors.

        `fields` (n_sensors, 3) and `covariances` are in the sensor frame, NaN if not measured;
        `offsets` (n_sensors,) [s] are sampling times relative to the timestamp of the frame.
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

        Repeated readings of a coarse sensor at rest have an increased variance
        (`calibration/resolution.hpp`); each counts as the smallest variance of its axis over its
        own.
        """
        total = 0.0
        for j in self.sensors:
            sensor_mask = self.sensor == j
            variance = np.where(np.isnan(self.field[sensor_mask]), np.nan,
                                np.einsum('nii->ni', self.covariance[sensor_mask]))
            variance = variance[:, ~np.isnan(variance).all(axis=0)]
            fraction = np.nanmin(variance, axis=0) / variance
            # Small variations of the estimated noise do not indicate repeated readings.
            total += float(np.nansum(np.where(fraction > 0.5, 1.0, fraction)))
        return total

    @property
    def sensors(self) -> IntArray:
        """Indices of the sensors that have measurements, (k,)."""
        return np.unique(self.sensor[~np.isnan(self.field).all(axis=1)])

    @property
    def positions(self) -> FloatArray:
        """Position of the sensor of each sample, (n, 3) m, world frame."""
        return self.network.positions[self.sensor]

    def shifted(self, seconds: float) -> 'PassData':
        """Return the data with time zero shifted; a positive shift makes it later."""
        return replace(self, stamp_ns=self.stamp_ns + int(round(1e9 * seconds)), t=self.t - seconds)

    @cached_property
    def whitening(self) -> FloatArray:
        """Whitening matrices W (n, 3, 3) with W C Wᵀ = I for the covariance C of each sample or
        mean; rows and columns of missing axes are zero."""
        W = np.zeros((len(self.t), 3, 3))
        is_measured = ~np.isnan(self.field)
        for axes in np.unique(is_measured, axis=0):
            rows = (is_measured == axes).all(axis=1)
            if axes.any():
                block = np.ix_(rows, axes, axes)
                W[block] = np.linalg.inv(np.linalg.cholesky(self.covariance[block]))
        return W if self.count is None else W * np.sqrt(self.count)[:, None, None]

    def averaged(self, max_samples: int) -> 'PassData':
        """Average adjacent samples to at most `max_samples` means per sensor; means where the field
        is strong contain fewer samples."""
        field_weight = np.sqrt(np.linalg.norm(self.field_change, axis=1))
        columns = []
        for j in np.unique(self.sensor):
            rows = np.flatnonzero(self.sensor == j)
            weight = 1.0 / len(rows) + field_weight[rows] / max(field_weight[rows].sum(), 1e-300)
            group = np.floor(np.cumsum(weight) / weight.sum()
                             * max_samples * (1.0 - 1e-9)).astype(int)
            begins = np.flatnonzero(np.diff(group, prepend=-1))
            n = np.diff(begins, append=len(rows))
            # A missing value makes the mean NaN: the other values have a different mean time.
            columns.append((np.add.reduceat(self.t[rows], begins) / n, np.full(len(n), j),
                            np.add.reduceat(self.field[rows], begins) / n[:, None],
                            np.add.reduceat(self.covariance[rows], begins) / n[:, None, None], n))
        t, sensor, field, covariance, n = (np.concatenate(c) for c in zip(*columns, strict=True))
        return replace(self, t=t, sensor=sensor, field=field, covariance=covariance, count=n)

    @property
    def peak_s(self) -> float:
        """Time [s] of the strongest field."""
        return float(self.t[np.argmax(np.einsum('ni,ni->n', self.field_change, self.field_change))])

    @cached_property
    def field_change(self) -> FloatArray:
        """Field minus its median at each sensor, (n, 3) T: approximately the target's field."""
        out = np.zeros_like(self.field)
        for j in self.sensors:
            field = self.field[self.sensor == j]
            is_measured = ~np.isnan(field).all(axis=0)
            median = np.zeros(3)
            median[is_measured] = np.nanmedian(field[:, is_measured], axis=0)
            out[self.sensor == j] = np.nan_to_num(field - median)
        return out


def separable_problem(data: PassData, create_model: ModelFactory, relative_error: float = 0.0,
                      prior: tuple[FloatArray, FloatArray] | None = None) -> SeparableProblem:
    """Create the separable least-squares problem of a pass, with unknown backgrounds.

    `create_model` gets whitened world-to-sensor rotations. `relative_error` is the model error
    relative to the field of each sample, added to the noise.
    """
    W = data.whitening
    if relative_error > 0.0:
        signal = np.einsum('nij,nj->ni', W, data.field_change)
        squared_norm = np.einsum('ni,ni->n', signal, signal)
        W = W / np.sqrt(1.0 + relative_error**2 * squared_norm)[:, None, None]
    model = create_model(data.t, data.positions, W @ data.network.R_sw[data.sensor])
    y = np.einsum('nij,nj->ni', W, np.nan_to_num(data.field)).ravel()
    return SeparableProblem(model, y, background_columns(data, W), prior)


def background_columns(data: PassData, W: FloatArray) -> FloatArray:
    """Whitened design matrix (3 n, q) of the backgrounds of the q measured axes."""
    columns = np.zeros((len(data.t), 3, len(data.network), 3))
    columns[np.arange(len(data.t)), :, data.sensor] = W
    flat = columns.reshape(3 * len(data.t), -1)
    return flat[:, (flat != 0.0).any(axis=0)]
