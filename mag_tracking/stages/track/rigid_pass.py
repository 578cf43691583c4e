"""A vehicle's whole pass at once, along a path that bends only steadily.

A filter bends the path of its target until it fits whatever the sensors say: clocks that are apart,
a clipped field, a second vehicle. A path of steady acceleration and turning cannot. If it does not
explain the frames of a pass, something else than a vehicle past good sensors made them; if a
straight one does as soon as the clocks are free, these are apart.

Source: TSP14 sections III.A and V for the fit of a row of dipoles at constant velocity.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import SeparableProblem, refine
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.steady_pass import N_PATH, N_STRAIGHT, PATH, SteadyPass
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import known_covariance
from mag_tracking.units import NS

SHORT, LONG = 3, 5
"""Dipoles of the rows: a long one explains any vehicle, a short one cannot make up for clocks."""

LENGTH, LONG_LENGTH = 3.0, 8.0
"""[m] Between the first and the last of them, where the search starts."""

MODEL_ERROR = 0.04
"""Error of the field of a row, relative to it; it counts as noise."""

REACH = 0.2
"""[m] Near a sensor the error is this length over the distance, if that is more."""

MOST_SENSORS = 4
"""Those with the strongest fields are compared."""

NEAR, FAR = 0.1, 0.3
"""[s] The search for the clocks starts with these, either way."""

OFFSET_STD, LONGEST_OFFSET = 0.15, 0.5
"""[s] Of clocks that nobody compared. A longer offset is no answer: a turn looks like it."""

TURN = 0.4
"""[rad/s] The search for a path that bends starts with this, either way, too."""

N_STEPS, TOLERANCE = 30, 1e-3
"""The search ends after so many steps, or where one improves the cost by less than this share."""

WELL, MISFIT = 1.3, 1.5
"""Reduced chi-square up to which a path explains a pass, and up to which it may."""

CHANCE, BENDS = 1e-5, 1e-3
"""Probability that clocks which agree make the fit of a straight path better by as much, and that
of a path that bends."""

LEAST_WAY = 1.0
"""[m] Clocks that move the target by less do no harm."""

MIDDLE_STD = 0.5
"""[m] The iron of a vehicle has another middle for each sensor."""

FARTHEST, FASTEST = 30.0, 100.0
"""[m], [m/s] A path that is farther from all sensors, or faster, is that of no vehicle."""

_STRAIGHT = np.arange(N_STRAIGHT)
_BENT = np.arange(N_PATH)


@dataclass(frozen=True)
class RigidPass:
    """Fits of a vehicle on a steady path to the frames of its whole pass.

    The costs are sums of squared whitened residuals.
    """

    straight: float
    """Cost of a straight path."""
    bent: float
    """Cost of a path that bends."""
    apart: float
    """Cost of a straight path at constant speed, the clocks being apart."""
    freedom: int
    """Degrees of freedom of that fit."""
    misfit: float
    """Reduced chi-square of a row on a path that bends, a long one if need be; about one where that
    explains the pass."""
    reference: int
    """Row of the sensor with the strongest field: its clock is what the others are compared to."""
    offset: FloatArray
    """(n_sensors,) [s] how far each clock is ahead of that; NaN = not compared, or it cannot be."""
    offset_std: FloatArray
    """(n_sensors,) [s] by noise and model error alone; 0 of the reference."""
    position: FloatArray
    """(3,) [m] where the field was strongest; of the straight path, the clocks being apart."""
    velocity: FloatArray
    """(3,) [m/s]"""
    straight_paths: FloatArray
    """(k, 6) [m], [m/s] positions and velocities where the field was strongest, on straight paths
    of a short row and a long one; those that may explain the pass."""

    @property
    def n_clocks(self) -> int:
        """How many clocks were compared to that of the reference."""
        return int(np.count_nonzero(~np.isnan(self.offset))) - 1

    @property
    def is_explained(self) -> bool:
        """Whether a straight path explains the pass, if need be with clocks that are apart."""
        return self.apart <= WELL * self.freedom

    def closest(self, positions: FloatArray) -> FloatArray:
        """(3,) [m] where the path comes nearest to one of the sensors at `positions` (n, 3)."""
        away = positions - self.position
        square = max(float(self.velocity @ self.velocity), 1e-12)
        places = self.position + (away @ self.velocity / square)[:, None] * self.velocity
        nearest: FloatArray = places[np.argmin(np.linalg.norm(places - positions, axis=1))]
        return nearest

    def difference(self, t: float, state: FloatArray) -> FloatArray:
        """(6,) [m], [m/s] from the nearest straight path that may explain the pass to a position
        and velocity, `state` (6,), at time `t` [s]; horizontal. Zero where none explains it.
        """
        if not len(self.straight_paths):
            return np.zeros(6)
        differences = state - self.straight_paths
        differences[:, :3] -= t * self.straight_paths[:, 3:]
        differences[:, [2, 5]] = 0.0
        nearest: FloatArray = differences[np.argmin(np.hypot(*differences[:, :2].T))]
        return nearest

    @cached_property
    def speed(self) -> float:
        """[m/s]"""
        return float(np.hypot(self.velocity[0], self.velocity[1]))

    @property
    def widening(self) -> float:
        """Factor on the variances where the residuals are larger than their law allows."""
        return max(self.apart / self.freedom, 1.0)

    def clock_variance(self, sensor: int) -> float:
        """[s^2] of the offset of a sensor's clock (row), with all that the model leaves out."""
        return float(self.widening * self.offset_std[sensor]**2 + (MIDDLE_STD / self.speed)**2)

    @property
    def needs_clocks_apart(self) -> bool:
        """Whether a straight path explains the pass with clocks that are apart, and no path does
        without."""
        offset = float(np.nanmax(np.abs(self.offset)))
        if not self.is_explained or offset > LONGEST_OFFSET or offset * self.speed < LEAST_WAY:
            return False
        gains = np.array([self.straight - self.apart, self.bent - self.apart]) / self.widening
        improbable = float(np.nansum(np.square(self.offset / OFFSET_STD)))
        return bool((gains - improbable > chdtri(self.n_clocks, [CHANCE, BENDS])).all())

    @property
    def is_straight(self) -> bool:
        """Whether the path need not bend, nor the vehicle accelerate."""
        gain = (min(self.straight, self.apart) - self.bent) / self.widening
        return bool(gain <= chdtri(N_PATH - N_STRAIGHT, BENDS))


def fit_rigid_pass(network: SensorNetwork, frames: Sequence[FieldFrame], stamp_ns: int,
                   starts: FloatArray) -> RigidPass | None:
    """Fit straight paths and one that bends to the frames of a pass.

    Parameters
    ----------
    network : SensorNetwork
    frames : list of FieldFrame
    stamp_ns : int
        When the field was strongest.
    starts : (n, 6) [m], [m/s]
        Positions and velocities then, to search from.

    Returns the `RigidPass`, or None where the frames do not determine one.
    """
    data = _Samples.of(network, frames, stamp_ns)
    n_clocks = data.n_clocks
    if n_clocks < 1 or data.n_free(LONG) <= N_PATH:
        return None
    first = np.stack([starts[:, 0], starts[:, 1], starts[:, 2],
                      np.hypot(starts[:, 3], starts[:, 4]),
                      np.arctan2(starts[:, 4], starts[:, 3]), starts[:, 5],
                      np.full(len(starts), LENGTH)], axis=1)
    straight, cost, _ = data.fit(SHORT, _STRAIGHT, first)
    bends, apart_from = straight[None, _BENT], [(straight[_STRAIGHT], NEAR)]
    if cost > WELL * (data.n_free(SHORT) - N_STRAIGHT):
        # A path that was fitted to a turn, or with clocks that are far apart, leads elsewhere.
        bends = np.vstack([bends, [np.append(first[0], [0.0, turn, 0.0])
                                   for turn in (-TURN, TURN)]])
        apart_from.append((first[0], FAR))
    clocks = np.array([np.append(p, np.full(n_clocks, sign * offset))
                       for p, offset in apart_from for sign in (-1.0, 1.0)])
    path, bent, _ = data.fit(SHORT, _BENT, bends)
    misfit, straight_paths = _longer(data, straight, cost, path, bent)
    free = np.concatenate([_STRAIGHT, N_PATH + np.arange(n_clocks)])
    path, apart, P = data.fit(SHORT, free, clocks)
    if not np.isfinite([cost, bent, apart, misfit]).all():
        return None
    offset, std = np.full(len(network), np.nan), np.full(len(network), np.nan)
    # What nothing is known of has no variance in a pseudo-inverse.
    variance = np.diagonal(P)[N_STRAIGHT:]
    known = np.append(True, variance > 0.0)
    offset[data.compared[known]] = np.append(0.0, path[N_PATH:])[known]
    std[data.compared[known]] = np.sqrt(np.append(0.0, variance))[known]
    x = _where(path)
    return RigidPass(cost, bent, apart, data.n_free(SHORT) - len(free), misfit,
                     int(data.compared[0]), offset, std, x[:3], x[3:], straight_paths)


def _where(path: FloatArray) -> FloatArray:
    """(6,) position and velocity of a path at time zero."""
    c, s = np.cos(path[4]), np.sin(path[4])
    return np.array([*path[:3], c * path[3], s * path[3], path[5]])


def _longer(data: '_Samples', straight: FloatArray, cost: float, bent: FloatArray, of_bent: float
            ) -> tuple[float, FloatArray]:
    """`RigidPass.misfit` and `RigidPass.straight_paths`.

    A short row has this `cost` on the `straight` path, and the cost `of_bent` on one that bends.
    """
    near = data.near(bent)
    longer = straight.copy()
    longer[PATH.index('length')] = LONG_LENGTH
    long, of_long, _ = near.fit(LONG, _STRAIGHT, np.array([straight, longer])[:, _STRAIGHT])
    chi_square = np.array([cost / (data.n_free(SHORT) - N_STRAIGHT),
                           of_long / (data.n_free(LONG) - N_STRAIGHT)])
    x = np.array([_where(straight), _where(long)])
    nearest = np.linalg.norm(x[:, None, :3] - data.positions, axis=2).min(axis=1)
    is_of_vehicle = (nearest < FARTHEST) & (np.linalg.norm(x[:, 3:], axis=1) < FASTEST)
    paths = x[is_of_vehicle & (chi_square <= MISFIT)]
    misfit = of_bent / (data.n_free(SHORT) - N_PATH)
    if misfit > WELL:
        longer = bent.copy()
        longer[PATH.index('length')] = LONG_LENGTH
        _, of_long, _ = near.fit(LONG, _BENT, np.array([straight, bent, longer])[:, _BENT])
        misfit = min(misfit, of_long / (data.n_free(LONG) - N_PATH))
    return misfit, paths


@dataclass(frozen=True)
class _Samples:
    """The frames of a pass as whitened arrays, sensor by sensor."""

    compared: IntArray
    """(k,) rows of the network, that with the strongest field first."""
    t: FloatArray
    """(n,) [s]"""
    positions: FloatArray
    """(n, 3) [m]"""
    M: FloatArray
    """(n, 3, 3) world to sensor, and whitening."""
    clock: IntArray
    """(n,) see `SteadyPass`."""
    y: FloatArray
    """(3 n,) whitened fields; 0 on missing axes."""
    backgrounds: FloatArray
    """(3 n, q)"""
    n_values: int
    """How many numbers were measured."""

    @property
    def n_clocks(self) -> int:
        """Besides that of the sensor with the strongest field."""
        return len(self.compared) - 1

    def n_free(self, n_dipoles: int) -> int:
        """Numbers less backgrounds and moments."""
        return self.n_values - self.backgrounds.shape[1] - 3 * n_dipoles

    def near(self, path: FloatArray) -> '_Samples':
        """The same with the model error of a vehicle near the sensors, on a path (10,)."""
        c, s = np.cos(path[4]), np.sin(path[4])
        way = self.t[:, None] * np.array([c * path[3], s * path[3], path[5]])
        share = np.maximum(MODEL_ERROR, REACH / np.linalg.norm(
            self.positions - path[:3] - way, axis=1))
        # In units of the noise that the model error is counted in already.
        signal = np.square(np.linalg.norm(self.y.reshape(-1, 3), axis=1))
        weight = 1.0 / np.sqrt(1.0 + (share**2 - MODEL_ERROR**2) * signal)
        rows = np.repeat(weight, 3)
        return replace(self, M=self.M * weight[:, None, None], y=self.y * rows,
                       backgrounds=self.backgrounds * rows[:, None])

    @classmethod
    def of(cls, network: SensorNetwork, frames: Sequence[FieldFrame], stamp_ns: int
           ) -> '_Samples':
        """The samples of the sensors with the strongest fields."""
        field = np.array([f.field for f in frames])
        energy = np.nansum(np.square(field), axis=2)
        measured = np.count_nonzero(~np.isnan(field).all(axis=2), axis=0)
        order = np.argsort(-energy.max(axis=0), kind='stable')
        compared = order[measured[order] > len(frames) // 2][:MOST_SENSORS]
        n = len(compared)
        C = np.array([known_covariance(f)[compared] for f in frames]).reshape(-1, 3, 3)
        t = np.array([(f.stamp_ns - stamp_ns) / NS + f.time_offset[compared] for f in frames])
        y = field[:, compared].reshape(-1, 3)
        there = ~np.isnan(y)
        of_sensor = np.tile(np.arange(n), len(frames))
        error = MODEL_ERROR**2 * energy[:, compared].ravel()
        W = np.linalg.inv(np.linalg.cholesky(C + error[:, None, None] * np.eye(3)))
        W = W * there[:, :, None] * there[:, None, :]
        level = np.zeros((len(y), 3, n, 3))
        level[np.arange(len(y)), :, of_sensor] = W
        columns = level.reshape(3 * len(y), 3 * n)
        return cls(compared, np.nan_to_num(t).ravel(), network.positions[compared][of_sensor],
                   W @ network.R_sw[compared][of_sensor], of_sensor - 1,
                   np.einsum('nij,nj->ni', W, np.nan_to_num(y)).ravel(),
                   columns[:, columns.any(axis=0)], int(np.count_nonzero(there)))

    def fit(self, n_dipoles: int, free: IntArray, starts: FloatArray
            ) -> tuple[FloatArray, float, FloatArray]:
        """(path and clocks, cost, covariance of those that are free) of the best minimum.

        `free` as for `SteadyPass`; `starts` (n, n_free).
        """
        model = SteadyPass(self.t, self.positions, self.M, self.clock, free,
                           np.zeros(N_PATH + self.n_clocks), n_dipoles)
        problem = SeparableProblem(model, self.y, self.backgrounds)
        theta, cost, P, _ = refine(problem.residual_and_jacobian, starts, N_STEPS, TOLERANCE)
        k = int(np.argmin(cost))
        return model.whole(theta[k:k + 1])[0], float(cost[k]), P[k]
