"""Fit of a steady path to the whole pass of a vehicle.

A filter bends the path of its target to fit clock offsets, a clipped field, or a second vehicle. A
path with steady acceleration and turn rate cannot. If no such path explains a pass, a sensor is
faulty or there are several vehicles. If a straight path explains the pass only with free clock
offsets, the clocks differ.

The fit of a row of dipoles at constant velocity follows TSP14 sections III.A and V.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.steady_pass import N_PATH, N_STRAIGHT, PATH
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.pass_samples import PassSamples
from mag_tracking.units import NS

N_SHORT, N_LONG = 3, 5
"""Number of dipoles of the two rows: the long one explains any vehicle, and might compensate for
clock offsets."""

LENGTH, LONG_LENGTH = 3.0, 8.0
"""[m] Start values of the distance from the first to the last dipole, for the short and the long
row."""

SMALL_OFFSET, LARGE_OFFSET = 0.1, 0.3
"""[s] Start values of the clock offsets, used with both signs."""

OFFSET_STD, MAX_OFFSET = 0.15, 0.5
"""[s] Prior standard deviation of clock offsets, and their maximum, beyond which a turn has the
same effect."""

START_TURN_RATE = 0.4
"""[rad/s] Start value of the turn rate of a bent path, used with both signs."""

GOOD_MISFIT, MAX_MISFIT = 1.3, 1.5
"""Maximum reduced chi-square of a path that explains a pass well, and of a path that may explain
it."""

P_CLOCKS, P_BEND = 1e-5, 1e-3
"""Probabilities that noise alone improves the fit significantly although the clocks are correct, or
although the motion is straight."""

MIN_DISTANCE, MIDDLE_STD = 1.0, 0.5
"""[m] Motion of the target during a clock offset below which the offset is harmless, and standard
deviation of the apparent magnetic centre of a vehicle from sensor to sensor."""

MAX_DISTANCE, MAX_SPEED = 30.0, 100.0
"""[m], [m/s] Maximum distance of a vehicle from the nearest sensor, and its maximum speed."""

_STRAIGHT = np.arange(N_STRAIGHT)
_BENT = np.arange(N_PATH)


@dataclass(frozen=True)
class RigidPass:
    """Fits of a vehicle on a steady path to its whole pass; costs are sums of squared whitened
    residuals."""

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
    """Reduced chi-square of a bent path with a short or, if needed, a long row; about 1 if it
    explains the pass."""
    reference: int
    """Index of the sensor with the strongest field; its clock is the reference."""
    offset: FloatArray
    """(n_sensors,) [s] Time by which each clock is ahead of the reference; NaN if not compared or
    not observable."""
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
    def n_clocks(self) -> int:
        """Number of clocks that were compared with the reference."""
        return int(np.count_nonzero(~np.isnan(self.offset))) - 1

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
        """Horizontal difference (6,) of a state (6,) from the nearest of the `straight_paths` at
        its time, m and m/s; zero if there are none."""
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
        """Whether clock offsets explain the pass significantly better than a path without them,
        straight or bent; they displace the target by `MIN_DISTANCE`, and are at most `MAX_OFFSET`.
        """
        offset = float(np.nanmax(np.abs(self.offset)))
        if not self.is_explained or offset > MAX_OFFSET or offset * self.speed < MIN_DISTANCE:
            return False
        gains = (np.array([self.straight_cost, self.bent_cost])
                 - self.cost_with_offsets) / self.widening
        prior_cost = float(np.nansum(np.square(self.offset / OFFSET_STD)))
        return bool((gains - prior_cost > chdtri(self.n_clocks, [P_CLOCKS, P_BEND])).all())

    @property
    def is_straight(self) -> bool:
        """Whether turn rate and acceleration do not improve the fit significantly."""
        gain = (min(self.straight_cost, self.cost_with_offsets) - self.bent_cost) / self.widening
        return bool(gain <= chdtri(N_PATH - N_STRAIGHT, P_BEND))


def fit_rigid_pass(network: SensorNetwork, frames: Sequence[FieldFrame], stamp_ns: int,
                   starts: FloatArray) -> RigidPass | None:
    """Fit straight and bent paths to the frames of a pass, from positions and velocities `starts`
    (n, 6) [m, m/s] at the time `stamp_ns` of the strongest field; None if the frames do not
    determine a path."""
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
    """Fit a long row of dipoles, starting at the `straight` and `bent` paths of a short row; the
    bent fit starts at the fitted straight path and, if `adds_starts`, also at these two."""
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
