"""A vehicle's whole pass at once, along a path that bends only steadily.

A filter bends the path of its target until it fits whatever the sensors say: clocks that are apart,
a clipped field, a second vehicle. A path of steady acceleration and turning cannot. If it does not
explain the frames of a pass, something else than a vehicle past good sensors made them; if a
straight one does as soon as the clocks are free, these are apart.

Source: TSP14 sections III.A and V for the fit of a row of dipoles at constant velocity.
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

SHORT, LONG = 3, 5
"""Dipoles of the rows: a long one explains any vehicle, a short one cannot make up for clocks."""

LENGTH, LONG_LENGTH = 3.0, 8.0
"""[m] Between the first and the last of them, where the search starts."""

NEAR, FAR = 0.1, 0.3
"""[s] The search for the clocks starts with these, either way."""

OFFSET_STD, MAX_OFFSET = 0.15, 0.5
"""[s] Of clocks that nobody compared. A longer offset is no answer: a turn looks like it."""

TURN = 0.4
"""[rad/s] The search for a path that bends starts with this, either way, too."""

WELL, MISFIT = 1.3, 1.5
"""Reduced chi-square: a path explains a pass well up to the first, and cannot beyond the second."""

CHANCE, BENDS = 1e-5, 1e-3
"""Probability that clocks which agree make the fit of a straight path better by as much, and that
of a path that bends."""

MIN_DISTANCE = 1.0
"""[m] Clocks that move the target by less do no harm."""

MIDDLE_STD = 0.5
"""[m] The iron of a vehicle has another middle for each sensor."""

FARTHEST, FASTEST = 30.0, 100.0
"""[m], [m/s] No vehicle that was tracked is farther from all sensors, or faster."""

_STRAIGHT = np.arange(N_STRAIGHT)
_BENT = np.arange(N_PATH)


@dataclass(frozen=True)
class RigidPass:
    """Fits of a vehicle on a steady path to the frames of its whole pass.

    The costs are sums of squared whitened residuals.
    """

    stamp_ns: int
    """When the field was strongest: time zero of the paths."""
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
    of a short row and of a long one, if these explain the pass about as well as paths that bend."""

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

    def difference(self, stamp_ns: int, state: FloatArray) -> FloatArray:
        """(6,) [m], [m/s] from the nearest of the `straight_paths` to a position and velocity,
        `state` (6,), at the time `stamp_ns`. Horizontal; zero where there are no such paths.
        """
        if not len(self.straight_paths):
            return np.zeros(6)
        differences = state - self.straight_paths
        differences[:, :3] -= (stamp_ns - self.stamp_ns) / NS * self.straight_paths[:, 3:]
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
        if not self.is_explained or offset > MAX_OFFSET or offset * self.speed < MIN_DISTANCE:
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
    data = PassSamples.of(network, frames, stamp_ns)
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
    short = _RowFits(_state_at_zero(straight), cost, bent, data.n_free(SHORT) - N_PATH)
    long = _long_row(data, straight, path, short.misfit > WELL)
    misfit = short.misfit if short.misfit <= WELL else min(short.misfit, long.misfit)
    straight_paths = [f.straight for f in (short, long) if f.needs_no_bend
                      and _is_of_vehicle(f.straight, data.positions)]
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
    x = _state_at_zero(path)
    return RigidPass(stamp_ns, cost, bent, apart, data.n_free(SHORT) - len(free), misfit,
                     int(data.compared[0]), offset, std, x[:3], x[3:],
                     np.reshape(straight_paths, (-1, 6)))


class _RowFits(NamedTuple):
    """Fits of a row of dipoles, on a straight path and on one that bends."""

    straight: FloatArray
    """(6,) position and velocity of the straight path at time zero."""
    cost: float
    cost_bent: float
    freedom: int
    """Degrees of freedom of the path that bends."""

    @property
    def misfit(self) -> float:
        """Reduced chi-square of the path that bends."""
        return self.cost_bent / self.freedom

    @property
    def needs_no_bend(self) -> bool:
        """Whether the straight path may explain the pass, and one that bends hardly does better."""
        n_more = N_PATH - N_STRAIGHT
        gain = (self.cost - self.cost_bent) / max(self.misfit, 1.0)
        return bool(self.cost <= MISFIT * (self.freedom + n_more)
                    and gain <= chdtri(n_more, BENDS))


def _long_row(data: PassSamples, straight: FloatArray, bent: FloatArray, thorough: bool
              ) -> _RowFits:
    """Fits of a long row, from the paths of a short one; a `thorough` search has more starts."""
    near = data.near(bent)
    starts = np.array([straight, bent, straight, bent])
    starts[2:, PATH.index('length')] = LONG_LENGTH
    path, cost, _ = near.fit(LONG, _STRAIGHT, starts[::2, _STRAIGHT])
    also = starts[[0, 1, 3]] if thorough else starts[:0]
    _, cost_bent, _ = near.fit(LONG, _BENT, np.vstack([path[None, _BENT], also[:, _BENT]]))
    return _RowFits(_state_at_zero(path), cost, cost_bent, data.n_free(LONG) - N_PATH)


def _state_at_zero(path: FloatArray) -> FloatArray:
    """(6,) position and velocity of a path at time zero."""
    c, s = np.cos(path[4]), np.sin(path[4])
    return np.array([*path[:3], c * path[3], s * path[3], path[5]])


def _is_of_vehicle(state: FloatArray, positions: FloatArray) -> bool:
    """Whether a vehicle past sensors at `positions` (n, 3) can have this `state` (6,)."""
    nearest = np.linalg.norm(state[:3] - positions, axis=1).min()
    return bool(nearest < FARTHEST and np.linalg.norm(state[3:]) < FASTEST)
