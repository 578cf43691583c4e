"""Frames of a pass as whitened arrays, and the fit of steady paths to the whole pass of a vehicle.

A filter bends its path to fit clock offsets, a clipped field, or a second vehicle. A path with
steady acceleration and turn rate cannot: if none explains a pass, a sensor is faulty or there are
several vehicles; if a straight one does only with free clock offsets, the clocks differ.

The fit of a row of dipoles at constant velocity follows TSP14 sections III.A and V.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import LINEAR_RANK_TOLERANCE, MAX_DAMPING
from mag_tracking.inference.matrices import MIN_PIVOT_ROOT, PSEUDO_INVERSE_TOLERANCE
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.passes import N_PATH, N_STRAIGHT, PATH, SteadyPass
from mag_tracking.records import FieldFrame, plain
from mag_tracking.stages.track import core
from mag_tracking.stages.track.bank_filter import known_covariance
from mag_tracking.units import NS

MODEL_ERROR = 0.04
"""Error of the field of a row of dipoles, relative to the field; treated as noise."""
NEAR_ERROR_LENGTH = 0.2
"""[m] Minimum product of relative field error and distance, near the sensors."""
MAX_SENSORS = 4
"""Maximum number of sensors in a fit: those with the strongest fields."""
N_STEPS, TOLERANCE = 30, 1e-3
"""Maximum number of steps of a fit, and relative improvement of the cost below which it ends."""
N_SHORT, N_LONG = 3, 5
"""Numbers of dipoles of the two rows; the long one explains any vehicle, or clock offsets."""
LENGTH, LONG_LENGTH = 3.0, 8.0
"""[m] Start values of the distance from the first to the last dipole, of either row."""
SMALL_OFFSET, LARGE_OFFSET = 0.1, 0.3
"""[s] Start values of the clock offsets, used with both signs."""
OFFSET_STD, MAX_OFFSET = 0.15, 0.5
"""[s] Prior std of clock offsets, and their maximum: beyond it, a turn has the same effect."""
START_TURN_RATE = 0.4
"""[rad/s] Start value of the turn rate of a bent path, used with both signs."""
GOOD_MISFIT, MAX_MISFIT = 1.3, 1.5
"""Maximum reduced chi-square of a path that explains a pass well, and of one that may."""
P_CLOCKS, P_BEND = 1e-5, 1e-3
"""Probabilities that noise alone makes clock offsets, or a bend, significant."""
MIN_DISTANCE, MIDDLE_STD = 1.0, 0.5
"""[m] Motion of the target during a clock offset below which the offset is harmless, and standard
deviation of the apparent magnetic centre of a vehicle from sensor to sensor."""
MAX_DISTANCE, MAX_SPEED = 30.0, 100.0
"""[m], [m/s] Maximum distance of a vehicle from the nearest sensor, and its maximum speed."""
_STRAIGHT, _BENT = np.arange(N_STRAIGHT), np.arange(N_PATH)


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


@dataclass(frozen=True)
class RigidPass:
    """Fits of a vehicle to its whole pass; costs are sums of squared whitened residuals."""

    stamp_ns: int
    """Time of the strongest field; time zero of the paths."""
    straight_cost: float
    """Cost of a straight path at constant speed, without clock offsets."""
    bent_cost: float
    """Cost of a path with acceleration and turn rate, without clock offsets."""
    cost_with_offsets: float
    """Cost of a straight path at constant speed with free clock offsets."""
    degrees_of_freedom: int
    """Degrees of freedom of the fit with free clock offsets."""
    misfit: float
    """Reduced chi-square of a bent path with a short or, if needed, a long row."""
    reference: int
    """Index of the sensor with the strongest field; its clock is the reference."""
    offset: FloatArray
    """(n_sensors,) [s] Time by which each clock is ahead of the reference; NaN if unknown."""
    offset_std: FloatArray
    """(n_sensors,) [s] Standard deviation due to noise and model error alone; reference: 0."""
    position: FloatArray
    """(3,) [m] Position at the time of the strongest field, with free clock offsets."""
    velocity: FloatArray
    """(3,) [m/s] Velocity on the straight path with free clock offsets."""
    straight_paths: FloatArray
    """(k, 6) [m], [m/s] Positions and velocities at the time of the strongest field, for straight
    paths of a short and of a long row that explain the pass about as well as bent paths."""

    @property
    def is_explained(self) -> bool:
        """Whether a straight path explains the pass, if necessary with free clock offsets."""
        return self.cost_with_offsets <= GOOD_MISFIT * self.degrees_of_freedom

    def closest(self, positions: FloatArray) -> FloatArray:
        """Point (3,) of the path with free clock offsets that is closest to any sensor, m."""
        offsets = positions - self.position
        squared_speed = max(float(self.velocity @ self.velocity), 1e-12)
        points = self.position + (offsets @ self.velocity / squared_speed)[:, None] * self.velocity
        nearest: FloatArray = points[np.argmin(np.linalg.norm(points - positions, axis=1))]
        return nearest

    def difference(self, stamp_ns: int, state: FloatArray) -> FloatArray:
        """Horizontal difference (6,) from the nearest of the `straight_paths`, or zero."""
        if not len(self.straight_paths):
            return np.zeros(6)
        differences = state - self.straight_paths
        differences[:, :3] -= (stamp_ns - self.stamp_ns) / NS * self.straight_paths[:, 3:]
        differences[:, [2, 5]] = 0.0
        nearest: FloatArray = differences[np.argmin(np.hypot(*differences[:, :2].T))]
        return nearest

    @cached_property
    def speed(self) -> float:
        """Horizontal speed on the straight path with free clock offsets [m/s]."""
        return float(np.hypot(self.velocity[0], self.velocity[1]))

    @property
    def widening(self) -> float:
        """Factor for variances: reduced chi-square of the fit with clock offsets, at least 1."""
        return max(self.cost_with_offsets / self.degrees_of_freedom, 1.0)

    def clock_variance(self, sensor: int) -> float:
        """Variance of the clock offset of a sensor, with that of the magnetic centre, s²."""
        return float(self.widening * self.offset_std[sensor]**2 + (MIDDLE_STD / self.speed)**2)

    @property
    def needs_clock_offsets(self) -> bool:
        """Whether clock offsets, up to `MAX_OFFSET`, displace the target and explain the pass
        significantly better than any path without them."""
        offset = float(np.nanmax(np.abs(self.offset)))
        if not self.is_explained or offset > MAX_OFFSET or offset * self.speed < MIN_DISTANCE:
            return False
        gains = (np.array([self.straight_cost, self.bent_cost])
                 - self.cost_with_offsets) / self.widening
        prior_cost = float(np.nansum(np.square(self.offset / OFFSET_STD)))
        n_clocks = np.count_nonzero(~np.isnan(self.offset)) - 1
        return bool((gains - prior_cost > chdtri(n_clocks, [P_CLOCKS, P_BEND])).all())

    @property
    def is_straight(self) -> bool:
        """Whether turn rate and acceleration do not improve the fit significantly."""
        gain = (min(self.straight_cost, self.cost_with_offsets) - self.bent_cost) / self.widening
        return bool(gain <= chdtri(N_PATH - N_STRAIGHT, P_BEND))


def fit_rigid_pass(network: SensorNetwork, frames: Sequence[FieldFrame], stamp_ns: int,
                   starts: FloatArray) -> RigidPass | None:
    """Fit straight and bent paths to the frames of a pass from the states `starts` (n, 6) [m, m/s]
    at the strongest field; None if the frames do not determine a path."""
    data = PassSamples.of(network, frames, stamp_ns)
    n_clocks = data.n_clocks
    if n_clocks < 1 or data.n_free(N_LONG) <= N_PATH:
        return None
    first = np.stack([starts[:, 0], starts[:, 1], starts[:, 2],
                      np.hypot(starts[:, 3], starts[:, 4]),
                      np.arctan2(starts[:, 4], starts[:, 3]), starts[:, 5],
                      np.full(len(starts), LENGTH)], axis=1)
    straight, cost, _ = data.fit(N_SHORT, _STRAIGHT, first)
    bent_starts, offset_starts = straight[None, _BENT], [(straight[_STRAIGHT], SMALL_OFFSET)]
    if cost > GOOD_MISFIT * (data.n_free(N_SHORT) - N_STRAIGHT):
        # If the vehicle turned, or if the clock offsets are large, the straight path is misleading.
        bent_starts = np.vstack([bent_starts, [np.append(first[0], [0.0, turn, 0.0])
                                               for turn in (-START_TURN_RATE, START_TURN_RATE)]])
        offset_starts.append((first[0], LARGE_OFFSET))
    clock_starts = np.array([np.append(p, np.full(n_clocks, sign * offset))
                             for p, offset in offset_starts for sign in (-1.0, 1.0)])
    path, bent_cost, _ = data.fit(N_SHORT, _BENT, bent_starts)
    short = _RowFits(_state_at_zero(straight), cost, bent_cost, data.n_free(N_SHORT) - N_PATH)
    long = _fit_long_row(data, straight, path, short.misfit > GOOD_MISFIT)
    misfit = short.misfit if short.misfit <= GOOD_MISFIT else min(short.misfit, long.misfit)
    straight_paths = [f.straight_state for f in (short, long) if f.needs_no_bend
                      and _is_of_vehicle(f.straight_state, data.positions)]
    free = np.concatenate([_STRAIGHT, N_PATH + np.arange(n_clocks)])
    path, cost_with_offsets, P = data.fit(N_SHORT, free, clock_starts)
    if not np.isfinite([cost, bent_cost, cost_with_offsets, misfit]).all():
        return None
    offset, std = np.full(len(network), np.nan), np.full(len(network), np.nan)
    # An unobservable offset has zero variance in a pseudo-inverse.
    variance = np.diagonal(P)[N_STRAIGHT:]
    is_known = np.append(True, variance > 0.0)
    offset[data.compared[is_known]] = np.append(0.0, path[N_PATH:])[is_known]
    std[data.compared[is_known]] = np.sqrt(np.append(0.0, variance))[is_known]
    x = _state_at_zero(path)
    return RigidPass(stamp_ns, cost, bent_cost, cost_with_offsets,
                     data.n_free(N_SHORT) - len(free), misfit, int(data.compared[0]), offset,
                     std, x[:3], x[3:], np.reshape(straight_paths, (-1, 6)))


class _RowFits(NamedTuple):
    """Fits of one row of dipoles, on a straight path and on a bent path."""

    straight_state: FloatArray
    """(6,) Position and velocity of the straight path at time zero."""
    straight_cost: float
    bent_cost: float
    degrees_of_freedom: int
    """Degrees of freedom of the bent path."""

    @property
    def misfit(self) -> float:
        """Reduced chi-square of the bent path."""
        return self.bent_cost / self.degrees_of_freedom

    @property
    def needs_no_bend(self) -> bool:
        """Whether the straight path explains the pass, without a significant gain from a bend."""
        n_bend = N_PATH - N_STRAIGHT
        gain = (self.straight_cost - self.bent_cost) / max(self.misfit, 1.0)
        return bool(self.straight_cost <= MAX_MISFIT * (self.degrees_of_freedom + n_bend)
                    and gain <= chdtri(n_bend, P_BEND))


def _fit_long_row(data: PassSamples, straight: FloatArray, bent: FloatArray, adds_starts: bool
              ) -> _RowFits:
    """Fit a long row of dipoles from the paths of a short row; `adds_starts` for the bent fit."""
    near = data.with_near_field_error(bent)
    starts = np.array([straight, bent, straight, bent])
    starts[2:, PATH.index('length')] = LONG_LENGTH
    path, cost, _ = near.fit(N_LONG, _STRAIGHT, starts[::2, _STRAIGHT])
    extra = starts[[0, 1, 3]] if adds_starts else starts[:0]
    _, bent_cost, _ = near.fit(N_LONG, _BENT, np.vstack([path[None, _BENT], extra[:, _BENT]]))
    return _RowFits(_state_at_zero(path), cost, bent_cost, data.n_free(N_LONG) - N_PATH)


def _state_at_zero(path: FloatArray) -> FloatArray:
    """Position and velocity (6,) of a path at time zero."""
    c, s = np.cos(path[4]), np.sin(path[4])
    return np.array([*path[:3], c * path[3], s * path[3], path[5]])


def _is_of_vehicle(state: FloatArray, positions: FloatArray) -> bool:
    """Whether a state (6,) is within `MAX_DISTANCE` of a sensor (n, 3) and below `MAX_SPEED`."""
    min_distance = np.linalg.norm(state[:3] - positions, axis=1).min()
    return bool(min_distance < MAX_DISTANCE and np.linalg.norm(state[3:]) < MAX_SPEED)
