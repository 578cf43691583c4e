"""A vehicle's whole pass at once, along a path that cannot bend: does it need other clocks?

A filter bends the path of its target until it fits, with what sensors say whose clocks are apart,
too. A path at constant speed cannot: the frames of a pass tell within milliseconds by how much the
clocks differ, as long as the vehicle went straight on.

Source: TSP14 sections III.A and V for the fit of a row of dipoles at constant velocity.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.least_squares import SeparableProblem, refine
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.arc_pass import N_PATH, ArcPass
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import known_covariance
from mag_tracking.units import NS

N_DIPOLES = 3
LENGTH = 3.0
"""[m] Between the first and the last of them, where the search starts."""

MODEL_ERROR = 0.04
"""Share of the field that such a row leaves out of a car's."""

MOST_SENSORS = 4
"""Those with the strongest fields are compared."""

FIRST_OFFSETS = (-0.1, 0.0, 0.1)
"""[s] The search for the clocks starts with these."""

LONGEST_OFFSET = 0.5
"""[s] A longer one is no answer: a turn looks like it."""

N_STEPS, TOLERANCE = 15, 1e-3
"""Of the search: steps, and the share of the cost by which the last one improves it."""

WELL = 1.3
"""Reduced chi-square up to which a path explains a pass: those of cars are 0.5 to 1.1 where the
model error above is counted as noise, those of sensors with a wrong sign 2 to 10."""

CHANCE = 1e-5
"""Probability that clocks which agree make the fit better by as much."""

LEAST_WAY = 1.0
"""[m] Clocks that move the target by less do no harm; two of `MIDDLE_STD`."""

MIDDLE_STD = 0.5
"""[m] The iron of a vehicle has another middle for each sensor."""

_STRAIGHT = np.arange(N_PATH - 1)
_ARC = np.arange(N_PATH)


@dataclass(frozen=True)
class RigidPass:
    """What the frames of a pass say of a vehicle that keeps its speed.

    The costs are sums of squared whitened residuals.
    """

    straight: float
    """Cost of a straight path."""
    arc: float
    """Of an arc."""
    apart: float
    """Of a straight path, the clocks being apart."""
    freedom: int
    """Degrees of freedom of the last."""
    offset: FloatArray
    """(n_sensors,) [s] how far each clock is ahead of the one of the sensor with the strongest
    field, which is 0; NaN = not compared."""
    offset_std: FloatArray
    """(n_sensors,) [s] by noise and model error alone."""
    position: FloatArray
    """(3,) [m] where the field was strongest; of the straight path, the clocks being apart."""
    velocity: FloatArray
    """(3,) [m/s]"""

    @property
    def is_explained(self) -> bool:
        """Whether a straight path explains the pass, if need be with clocks that are apart."""
        return self.apart <= WELL * self.freedom

    @cached_property
    def speed(self) -> float:
        """[m/s]"""
        return float(np.hypot(self.velocity[0], self.velocity[1]))

    @property
    def widening(self) -> float:
        """What the variances are to be multiplied by for what the path leaves unexplained."""
        return max(self.apart / self.freedom, 1.0)

    @property
    def reference(self) -> int:
        """Row of the sensor that the clocks are compared to."""
        return int(np.flatnonzero(self.offset_std == 0.0)[0])

    @property
    def needs_clocks_apart(self) -> bool:
        """Whether a straight path explains the pass with clocks that are apart, and no path does
        without."""
        offset = float(np.nanmax(np.abs(self.offset)))
        if not self.is_explained or offset > LONGEST_OFFSET or offset * self.speed < LEAST_WAY:
            return False
        gain = (min(self.straight, self.arc) - self.apart) / self.widening
        n_clocks = int(np.count_nonzero(~np.isnan(self.offset))) - 1
        return bool(gain > chdtri(n_clocks, CHANCE))


def fit_rigid_pass(network: SensorNetwork, frames: Sequence[FieldFrame], stamp_ns: int,
                   starts: FloatArray) -> RigidPass | None:
    """Fit straight paths and an arc to the frames of a pass.

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
    if n_clocks < 1 or data.n_values <= N_PATH + n_clocks + 3 * (N_DIPOLES + MOST_SENSORS):
        return None
    first = np.stack([starts[:, 0], starts[:, 1], starts[:, 2],
                      np.hypot(starts[:, 3], starts[:, 4]),
                      np.arctan2(starts[:, 4], starts[:, 3]), starts[:, 5],
                      np.full(len(starts), LENGTH)], axis=1)
    straight, cost, _ = data.fit(_STRAIGHT, first)
    _, cost_of_arc, _ = data.fit(_ARC, straight[None, _ARC])
    free = np.concatenate([_STRAIGHT, N_PATH + np.arange(n_clocks)])
    with_clocks = np.repeat(straight[None, free], len(FIRST_OFFSETS), axis=0)
    with_clocks[:, len(_STRAIGHT):] = np.array(FIRST_OFFSETS)[:, None]
    path, apart, P = data.fit(free, with_clocks)
    if not np.isfinite([cost, cost_of_arc, apart]).all():
        return None
    offset, std = np.full(len(network), np.nan), np.full(len(network), np.nan)
    offset[data.compared] = np.append(0.0, path[N_PATH:])
    std[data.compared] = np.append(0.0, np.sqrt(np.diagonal(P)[len(_STRAIGHT):]))
    c, s = np.cos(path[4]), np.sin(path[4])
    return RigidPass(cost, cost_of_arc, apart, data.n_free - len(free), offset, std, path[:3],
                     np.array([c * path[3], s * path[3], path[5]]))


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
    """(n,) see `ArcPass`."""
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

    @property
    def n_free(self) -> int:
        """Numbers less backgrounds and moments."""
        return self.n_values - self.backgrounds.shape[1] - 3 * N_DIPOLES

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
        error = MODEL_ERROR**2 * energy[:, compared].ravel()
        W = np.linalg.inv(np.linalg.cholesky(C + error[:, None, None] * np.eye(3)))
        W = W * there[:, :, None] * there[:, None, :]
        of_sensor = np.tile(np.arange(n), len(frames))
        level = np.zeros((len(y), 3, n, 3))
        level[np.arange(len(y)), :, of_sensor] = W
        columns = level.reshape(3 * len(y), -1)
        return cls(compared, np.nan_to_num(t).ravel(), network.positions[compared][of_sensor],
                   W @ network.R_sw[compared][of_sensor], of_sensor - 1,
                   np.einsum('nij,nj->ni', W, np.nan_to_num(y)).ravel(),
                   columns[:, columns.any(axis=0)], int(np.count_nonzero(there)))

    def fit(self, free: IntArray, starts: FloatArray) -> tuple[FloatArray, float, FloatArray]:
        """(path and clocks, cost, covariance of those that are free) of the best minimum.

        `free` as for `ArcPass`; `starts` (n, n_free).
        """
        model = ArcPass(self.t, self.positions, self.M, self.clock, free,
                        np.zeros(N_PATH + self.n_clocks), N_DIPOLES)
        problem = SeparableProblem(model, self.y, self.backgrounds)
        theta, cost, P, _ = refine(problem.residual_and_jacobian, starts, N_STEPS, TOLERANCE)
        k = int(np.argmin(cost))
        return model.whole(theta[k:k + 1])[0], float(cost[k]), P[k]
