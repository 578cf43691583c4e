"""Frames of a pass as whitened arrays, and the fit of a row of dipoles on a steady path."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import LINEAR_RANK_TOLERANCE, MAX_DAMPING
from mag_tracking.inference.matrices import MIN_PIVOT_ROOT, PSEUDO_INVERSE_TOLERANCE
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.steady_pass import N_PATH, N_STRAIGHT, SteadyPass
from mag_tracking.records import FieldFrame, plain
from mag_tracking.stages.track import core
from mag_tracking.stages.track.bank_filter import known_covariance
from mag_tracking.units import NS

MODEL_ERROR = 0.04
"""Error of the field of a row of dipoles, relative to the field; treated as noise."""

NEAR_ERROR_LENGTH = 0.2
"""[m] Minimum product of the relative field error and the distance to the sensor, for samples with
the model error near the sensors."""

MAX_SENSORS = 4
"""Maximum number of sensors in a fit: those with the strongest fields."""

N_STEPS, TOLERANCE = 30, 1e-3
"""Maximum number of steps of a fit, and relative improvement of the cost below which it ends."""


@dataclass(frozen=True)
class PassSamples:
    """The frames of a pass as whitened arrays, sorted by frame and sensor."""

    compared: IntArray
    """(k,) Indices of the sensors in the network, beginning with the strongest field."""
    t: FloatArray
    """(n,) [s] Time of each sample."""
    positions: FloatArray
    """(n, 3) [m] Sensor positions, world frame."""
    M: FloatArray
    """(n, 3, 3) Whitening matrix times rotation from world to sensor."""
    clock: IntArray
    """(n,) Clock of each sample; see `SteadyPass`."""
    y: FloatArray
    """(3 n,) Whitened fields; 0 for missing axes."""
    backgrounds: FloatArray
    """(3 n, q) Whitened fields of unit backgrounds, one column for each axis of a sensor."""
    n_values: int
    """Number of measured axes in all samples."""

    @property
    def n_clocks(self) -> int:
        """Number of clocks that are compared with the reference clock."""
        return len(self.compared) - 1

    def n_free(self, n_dipoles: int) -> int:
        """Degrees of freedom that remain after the backgrounds and moments have been estimated."""
        return self.n_values - self.backgrounds.shape[1] - 3 * n_dipoles

    def with_near_field_error(self, path: FloatArray) -> 'PassSamples':
        """Samples with the model error near the sensors as noise, on a `SteadyPass` path (10,)."""
        c, s = np.cos(path[4]), np.sin(path[4])
        displacement = self.t[:, None] * np.array([c * path[3], s * path[3], path[5]])
        relative_error = np.maximum(MODEL_ERROR, NEAR_ERROR_LENGTH / np.linalg.norm(
            self.positions - path[:3] - displacement, axis=1))
        # The noise that whitens the signal already includes the smaller model error.
        signal = np.square(np.linalg.norm(self.y.reshape(-1, 3), axis=1))
        weight = 1.0 / np.sqrt(1.0 + (relative_error**2 - MODEL_ERROR**2) * signal)
        row_weight = np.repeat(weight, 3)
        return replace(self, M=self.M * weight[:, None, None], y=self.y * row_weight,
                       backgrounds=self.backgrounds * row_weight[:, None])

    @classmethod
    def of(cls, network: SensorNetwork, frames: Sequence[FieldFrame], stamp_ns: int,
           max_sensors: int = MAX_SENSORS) -> 'PassSamples':
        """Samples of the sensors with the strongest fields; `stamp_ns` is time zero."""
        field = np.array([f.field for f in frames])
        energy = np.nansum(np.square(field), axis=2)
        measured = np.count_nonzero(~np.isnan(field).all(axis=2), axis=0)
        order = np.argsort(-energy.max(axis=0), kind='stable')
        # Slow sensors with clock offsets may each have samples in only a few of the frames.
        compared = order[measured[order] > measured.max(initial=0) // 2][:max_sensors]
        n = len(compared)
        C = np.array([known_covariance(f.covariance)[compared] for f in frames]).reshape(-1, 3, 3)
        t = np.array([(f.stamp_ns - stamp_ns) / NS + f.time_offset[compared] for f in frames])
        y = field[:, compared].reshape(-1, 3)
        is_present = ~np.isnan(y)
        sensor_index = np.tile(np.arange(n), len(frames))
        error = MODEL_ERROR**2 * energy[:, compared].ravel()
        W = np.linalg.inv(np.linalg.cholesky(C + error[:, None, None] * np.eye(3)))
        W = W * is_present[:, :, None] * is_present[:, None, :]
        background_columns = np.zeros((len(y), 3, n, 3))
        background_columns[np.arange(len(y)), :, sensor_index] = W
        columns = background_columns.reshape(3 * len(y), 3 * n)
        return cls(compared, np.nan_to_num(t).ravel(), network.positions[compared][sensor_index],
                   W @ network.R_sw[compared][sensor_index], sensor_index - 1,
                   np.einsum('nij,nj->ni', W, np.nan_to_num(y)).ravel(),
                   columns[:, columns.any(axis=0)], int(np.count_nonzero(is_present)))

    def fit(self, n_dipoles: int, free: IntArray, starts: FloatArray
            ) -> tuple[FloatArray, float, FloatArray]:
        """Fit a row of dipoles on a steady path with the parameters `free` of `SteadyPass` from
        each of `starts` (n, n_free).

        Returns the best path with its clock offsets (10 + n_clocks,), its cost (infinite if no
        start is valid), and the covariance (n_free, n_free), zero for unobservable parameters.
        """
        model = SteadyPass(self.t, self.positions, self.M, self.clock, free,
                           np.zeros(N_PATH + self.n_clocks), n_dipoles)
        nuisance, y = self._projected
        theta = np.array(starts, dtype=float, order='C')
        n, n_free = theta.shape
        cost, P = np.empty(n), np.empty((n, n_free, n_free))
        core.fit_steady_pass(
            theta=theta, cost=cost, covariance=P, free=plain(free, np.int64), fixed=model.fixed,
            offsets=model.offsets, combinations=model.combinations, t=self.t,
            positions=self.positions, M=self.M, clock=self.clock, y=y, nuisance=nuisance,
            n_steps=N_STEPS, tolerance=TOLERANCE, max_damping=MAX_DAMPING,
            full_rank=MIN_PIVOT_ROOT, linear_rank=LINEAR_RANK_TOLERANCE,
            rank=PSEUDO_INVERSE_TOLERANCE)
        k = int(np.argmin(cost))
        return model.all_parameters(theta[k:k + 1])[0], float(cost[k]), P[k]

    def straight_model(self, n_dipoles: int) -> SteadyPass:
        """Row of dipoles on a straight path at constant speed, without clock offsets."""
        return SteadyPass(self.t, self.positions, self.M, np.full(len(self.t), -1),
                          np.arange(N_STRAIGHT), np.zeros(N_PATH), n_dipoles)

    @cached_property
    def _projected(self) -> tuple[FloatArray, FloatArray]:
        """Orthonormal basis of the backgrounds, and the whitened fields without backgrounds."""
        Q = np.linalg.qr(self.backgrounds)[0]
        return plain(Q), self.y - Q @ (Q.T @ self.y)
