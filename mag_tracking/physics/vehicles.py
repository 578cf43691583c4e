"""Vehicles: a point, or a row of dipoles along the heading."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from mag_tracking.arrays import FloatArray
from mag_tracking.physics.dipole import MU0
from mag_tracking.physics.motion import constant_velocity, coordinated_turn, integrator_noise
from mag_tracking.physics.sources import Dipoles

FASTEST_TURN = 1.0
"""[rad/s] Deviation of the turn rate of a vehicle that is slow; no car turns much faster."""


@njit('void(float64[:,:], float64[:], float64[:], float64[:,:,::1], float64[:,:,::1], '
      'float64[:,:,:,::1], float64[:,:,:,::1])', cache=True, error_model='numpy')
def _row_dipoles(x: FloatArray, places: FloatArray, induction: FloatArray, r: FloatArray,
                 m: FloatArray, dr_dx: FloatArray, dm_dx: FloatArray) -> None:
    """TSP14 eq. (10b) and ICASSP11 eq. (8), a row a hypothesis; the derivatives come as zeros.

    `places` (d,) of the dipoles along the row, in lengths of it from its centre. With one
    dipole the state has no length.
    """
    d = places.shape[0]
    soft = 6 + 3 * d
    for p in range(x.shape[0]):
        vx, vy = x[p, 3], x[p, 4]
        speed = math.sqrt(vx * vx + vy * vy)
        c, s, slowness = 1.0, 0.0, 0.0
        if speed > 0.0:
            slowness = 1.0 / speed
            c, s = vx * slowness, vy * slowness
        # d(heading)/dv = [-sin, cos]/|v|
        turn_x, turn_y = -s * slowness, c * slowness
        share = x[p, soft] / d
        for i in range(d):
            k = 6 + 3 * i
            hard_x, hard_y = c * x[p, k] - s * x[p, k + 1], s * x[p, k] + c * x[p, k + 1]
            m[p, i, 0] = hard_x + share * induction[0]
            m[p, i, 1] = hard_y + share * induction[1]
            m[p, i, 2] = x[p, k + 2] + share * induction[2]
            dm_dx[p, i, 0, k], dm_dx[p, i, 0, k + 1] = c, -s
            dm_dx[p, i, 1, k], dm_dx[p, i, 1, k + 1] = s, c
            dm_dx[p, i, 2, k + 2] = 1.0
            # d(hard)/d(heading) = z x hard
            dm_dx[p, i, 0, 3], dm_dx[p, i, 0, 4] = -hard_y * turn_x, -hard_y * turn_y
            dm_dx[p, i, 1, 3], dm_dx[p, i, 1, 4] = hard_x * turn_x, hard_x * turn_y
            for a in range(3):
                r[p, i, a] = x[p, a]
                dr_dx[p, i, a, a] = 1.0
                dm_dx[p, i, a, soft] = induction[a] / d
            if d > 1:
                ahead = places[i] * x[p, soft + 1]
                r[p, i, 0] += ahead * c
                r[p, i, 1] += ahead * s
                dr_dx[p, i, 0, soft + 1], dr_dx[p, i, 1, soft + 1] = places[i] * c, places[i] * s
                dr_dx[p, i, 0, 3], dr_dx[p, i, 0, 4] = -ahead * s * turn_x, -ahead * s * turn_y
                dr_dx[p, i, 1, 3], dr_dx[p, i, 1, 4] = ahead * c * turn_x, ahead * c * turn_y


@dataclass(frozen=True)
class RowVehicle:
    """A row of equidistant dipoles along the heading, of unknown length; one dipole is a point.

    State (6 + 3 d + 2, with one dipole 10, without a length; one more if any vehicle may turn):
    position r of the row's middle, velocity v, hard iron moment of each dipole in the vehicle's
    frame (x forward, z up; from the tail to the head), soft iron scalar D [m^3] of the whole,
    length L [m], turn rate w [rad/s].

        m_i = Rz(heading) m0_i + D/(d mu0) B0,    r_i = r + (i - (d+1)/2) L/(d-1) heading

    The heading is that of the horizontal velocity; no roll, pitch or slip. Where the speed is
    zero the heading is atan2(0, 0) = 0 and its derivative is taken as zero. With one dipole, or
    L = 0, it is the point target of ICASSP11 eq. (4)-(8). A negative length is the same row from
    its other end.

    Source: TSP14 eq. (10), (16); ICASSP11 eq. (8) for the moments, (D/mu0) B0 and not T10's
    (3D/mu0) B0.
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
                *(f'm{i + 1}{axis}' for i in range(self.n_dipoles) for axis in 'xyz'), 'D',
                *(('L',) if self.n_dipoles > 1 else ()),
                *(('w',) if self.turn_acceleration else ()))

    @cached_property
    def _induction(self) -> FloatArray:
        """(3,) [A/m] B0/mu0."""
        return np.asarray(self.earth_field, dtype=float) / MU0

    @cached_property
    def _places(self) -> FloatArray:
        """(d,) of the dipoles, in lengths of the row."""
        d = self.n_dipoles
        return np.linspace(-0.5, 0.5, d, dtype=np.float64) if d > 1 else np.zeros(1)

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
        shape = len(x), self.n_dipoles, 3
        r, m = np.empty(shape), np.empty(shape)
        dr_dx, dm_dx = np.zeros((2, *shape, x.shape[1]))
        _row_dipoles(np.asarray(x, dtype=float), self._places, self._induction, r, m, dr_dx, dm_dx)
        return Dipoles(r, m, dr_dx, dm_dx)

    def propagate(self, x: FloatArray, dt: float, P: FloatArray | None = None
                  ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Constant velocity, or a turn; the drifts grow with the size of the iron.

        A turn rate whose variance in `P` is zero gets no noise: such a vehicle goes straight on.
        Over `dt` the rate is taken as its mean; what its noise does to place and velocity within
        that time is left out. See `SourceModel`.
        """
        n, d = x.shape[1], self.n_dipoles
        Q = np.zeros((len(x), n, n))
        Q[:, :6, :6] = integrator_noise(dt, self.acceleration_density)
        hard = slice(6, 6 + 3 * d)
        size2 = (np.square(x[:, hard].reshape(-1, d, 3).sum(axis=1)).sum(axis=1)
                 + np.square(x[:, hard.stop]) * (self._induction @ self._induction))
        Q[:, hard, hard] = size2[:, None, None] * (abs(dt) * self._walk)
        if not self.turn_acceleration:
            F = np.eye(n)
            F[:6, :6] = constant_velocity(dt)
            return x @ F.T, F, Q
        # Backwards, without noise, nothing may become surer than it is.
        fading = math.exp(-max(dt, 0.0) / self.turn_time)
        mean = (1.0 - fading) * self.turn_time / dt if dt > 0.0 else 1.0
        turning = x.copy()
        turning[:, -1] *= mean
        moved, turned = coordinated_turn(turning, dt)
        moved[:, -1] = fading * x[:, -1]
        turned[:, :-1, -1] *= mean
        turned[:, -1, -1] = fading
        turns = np.ones(len(x)) if P is None else P[:, -1, -1] > 0.0
        Q[:, -1, -1] = turns * (1.0 - fading**2) * self.turn_variance(np.hypot(x[:, 3], x[:, 4]))
        return moved, turned, Q

    def turn_variance(self, speed: FloatArray) -> FloatArray:
        """(...) [rad^2/s^2] of the turn rate at a horizontal `speed` (...) [m/s]."""
        slowest = self.turn_acceleration / FASTEST_TURN
        variance: FloatArray = np.square(self.turn_acceleration / np.maximum(speed, slowest))
        return variance
