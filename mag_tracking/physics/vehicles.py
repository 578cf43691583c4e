"""Vehicles: a point, or a row of dipoles along the heading."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core
from mag_tracking.physics.dipole import MU0
from mag_tracking.physics.motion import constant_velocity, fading_turn, integrator_noise
from mag_tracking.physics.sources import Dipoles

MAX_TURN_RATE = 1.0
"""[rad/s] Deviation of the turn rate of a vehicle that is slow; no car turns much faster."""


@dataclass(frozen=True)
class RowVehicle:
    """A row of equidistant dipoles along the heading, of unknown length; one dipole is a point.

    State (6 + 3 d + 4, with one dipole 12, without a length; one more if any vehicle may turn):
    position r of the row's middle, velocity v, hard iron moment of each dipole in the vehicle's
    frame (x forward, z up; from the tail to the head), soft iron of the whole, the diagonal
    [m^3] of a tensor D in that frame, length L [m], turn rate w [rad/s].

        m_i = R (m0_i + D R^T B0/(d mu0)) with R = Rz(heading),
        r_i = r + (i - (d+1)/2) L/(d-1) heading

    Sheets and axles are magnetised along themselves, so that a body is easier to magnetise along
    some of its axes; where all three are equal D is the scalar of the source.

    The heading is that of the horizontal velocity; no roll, pitch or slip. Where the speed is
    zero the heading is atan2(0, 0) = 0 and its derivative is taken as zero. With one dipole, or
    L = 0, it is the point target of ICASSP11 eq. (4)-(8). A negative length is the same row from
    its other end.

    Source: TSP14 eq. (10), (16); ICASSP11 eq. (8) for the moments, (D/mu0) B0 and not T10's
    (3D/mu0) B0; MITRE12 eq. (A.5) for a D that depends on the axis.
    """

    earth_field: FloatArray
    """(3,) [T], world. Zeros: no soft iron can be modelled."""
    acceleration_density: FloatArray
    """(3,) [m^2/s^3], spectral density of the acceleration, per axis."""
    moment_drift: float = 0.0
    """[1/s^0.5] random walk of the whole hard iron moment per axis, relative to the iron's size."""
    difference_drift: float = 0.0
    """[1/s^0.5] the same of what each dipole differs from the mean of the row."""
    n_dipoles: int = 3
    turn_acceleration: float = 0.0
    """[m/s^2] standard deviation of the lateral acceleration of those that turn; 0: none does, and
    the state has no turn rate."""
    turn_time: float = 1.5
    """[s] for which a turn goes on (first-order Gauss-Markov)."""

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return ('x', 'y', 'z', 'vx', 'vy', 'vz',
                *(f'm{i + 1}{axis}' for i in range(self.n_dipoles) for axis in 'xyz'),
                'Dx', 'Dy', 'Dz',
                *(('L',) if self.n_dipoles > 1 else ()),
                *(('w',) if self.turn_acceleration else ()))

    @cached_property
    def induction(self) -> FloatArray:
        """(3,) [A/m] B0/mu0."""
        return np.asarray(self.earth_field, dtype=float) / MU0

    @cached_property
    def _walk(self) -> FloatArray:
        """(3 d, 3 d) [1/s] random walk of the hard iron moments, relative to the iron's size."""
        d = self.n_dipoles
        mean = np.full((d, d), 1.0 / d)
        return np.kron(self.moment_drift**2 / d * mean
                       + self.difference_drift**2 * (np.eye(d) - mean), np.eye(3))

    def dipoles(self, x: FloatArray) -> Dipoles:
        """`n_dipoles` dipoles a hypothesis; see `SourceModel.dipoles`.

        Raises ValueError where the states are not as many as `state_names`.
        """
        if x.shape[1:] != (len(self.state_names),):
            raise ValueError(f'{self.n_dipoles} dipoles need {len(self.state_names)} states, '
                             f'got an array {x.shape}')
        return Dipoles(*core.row_dipoles(np.ascontiguousarray(x, dtype=float), self.n_dipoles,
                                         self.induction))

    def propagate(self, x: FloatArray, dt: float, P: FloatArray | None = None
                  ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Constant velocity, or a turn; the drifts grow with the size of the iron.

        A turn rate whose variance in `P` is zero gets no noise: such a vehicle goes straight on.
        Over `dt` the rate is taken as its mean; what its noise does to place and velocity within
        that time is left out. See `SourceModel`.
        """
        n = x.shape[1]
        Q = np.zeros((len(x), n, n))
        Q[:, :6, :6] = integrator_noise(dt, self.acceleration_density)
        core.set_moment_noise(np.ascontiguousarray(x, dtype=float), abs(dt) * self._walk,
                              float(self.induction @ self.induction), Q)
        if not self.turn_acceleration:
            F = np.eye(n)
            F[:6, :6] = constant_velocity(dt)
            return x @ F.T, F, Q
        # Backwards, without noise, nothing may become surer than it is.
        fading = math.exp(-max(dt, 0.0) / self.turn_time)
        mean = (1.0 - fading) * self.turn_time / dt if dt > 0.0 else 1.0
        moved, turned = fading_turn(x, dt, mean, fading)
        turns = np.ones(len(x)) if P is None else P[:, -1, -1] > 0.0
        Q[:, -1, -1] = turns * (1.0 - fading**2) * self.turn_variance(np.hypot(x[:, 3], x[:, 4]))
        return moved, turned, Q

    def turn_variance(self, speed: FloatArray) -> FloatArray:
        """(...) [rad^2/s^2] of the turn rate at a horizontal `speed` (...) [m/s]."""
        slowest = self.turn_acceleration / MAX_TURN_RATE
        variance: FloatArray = np.square(self.turn_acceleration / np.maximum(speed, slowest))
        return variance
