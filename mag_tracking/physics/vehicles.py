"""Vehicles: a point, or a row of dipoles along the heading."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from mag_tracking.arrays import FloatArray
from mag_tracking.compiled import compiled_when_used
from mag_tracking.physics.dipole import MU0
from mag_tracking.physics.motion import constant_velocity, coordinated_turn, integrator_noise
from mag_tracking.physics.sources import Dipoles

FASTEST_TURN = 1.0
"""[rad/s] Deviation of the turn rate of a vehicle that is slow; no car turns much faster."""


@njit(error_model='numpy', forceinline=True)
def _position(x: FloatArray, p: int, i: int, place: float, c: float, s: float, turn_x: float,
              turn_y: float, r: FloatArray, dr_dx: FloatArray) -> None:
    """Position of dipole i of hypothesis p, and its derivatives."""
    for a in range(3):
        r[p, i, a] = x[p, a]
        dr_dx[p, i, a, a] = 1.0
    d = r.shape[1]
    if d > 1:
        length = 9 + 3 * d
        ahead = place * x[p, length]
        r[p, i, 0] += ahead * c
        r[p, i, 1] += ahead * s
        dr_dx[p, i, 0, length], dr_dx[p, i, 1, length] = place * c, place * s
        dr_dx[p, i, 0, 3], dr_dx[p, i, 0, 4] = -ahead * s * turn_x, -ahead * s * turn_y
        dr_dx[p, i, 1, 3], dr_dx[p, i, 1, 4] = ahead * c * turn_x, ahead * c * turn_y


@njit(error_model='numpy', forceinline=True)
def _induced(soft_x: float, soft_y: float, ahead: float, left: float, c: float, s: float
             ) -> tuple[float, float, float, float]:
    """Horizontal moment [A m^2], in the world, that B/mu0 [A/m] `ahead` and to the `left` induces
    in soft iron [m^3], and its derivative by the heading, whose cosine and sine are c and s.
    """
    m_ahead, m_left = soft_x * ahead, soft_y * left
    # A body that turns anticlockwise sees the field turn clockwise.
    dm_ahead, dm_left = soft_x * left - m_left, m_ahead - soft_y * ahead
    return (c * m_ahead - s * m_left, s * m_ahead + c * m_left,
            c * dm_ahead - s * dm_left, s * dm_ahead + c * dm_left)


@compiled_when_used(
    'void(float64[:,:], float64[:], float64[:], float64[:,:,::1], float64[:,:,::1], '
    'float64[:,:,:,::1], float64[:,:,:,::1])', error_model='numpy')
def _row_dipoles(x: FloatArray, places: FloatArray, induction: FloatArray, r: FloatArray,
                 m: FloatArray, dr_dx: FloatArray, dm_dx: FloatArray) -> None:
    """TSP14 eq. (10b) and ICASSP11 eq. (8), a row a hypothesis; the derivatives come as zeros.

    `places` (d,) of the dipoles along the row, in lengths of it from its centre. With one
    dipole the state has no length.
    """
    d = places.shape[0]
    soft = 6 + 3 * d
    h_x, h_y, h_z = induction[0] / d, induction[1] / d, induction[2] / d
    for p in range(x.shape[0]):
        vx, vy = x[p, 3], x[p, 4]
        speed = math.sqrt(vx * vx + vy * vy)
        c, s, slowness = 1.0, 0.0, 0.0
        if speed > 0.0:
            slowness = 1.0 / speed
            c, s = vx * slowness, vy * slowness
        # d(heading)/dv = [-sin, cos]/|v|
        turn_x, turn_y = -s * slowness, c * slowness
        ahead, left = c * h_x + s * h_y, c * h_y - s * h_x
        soft_x, soft_y, by_x, by_y = _induced(x[p, soft], x[p, soft + 1], ahead, left, c, s)
        for i in range(d):
            k = 6 + 3 * i
            hard_x, hard_y = c * x[p, k] - s * x[p, k + 1], s * x[p, k] + c * x[p, k + 1]
            m[p, i, 0], m[p, i, 1] = hard_x + soft_x, hard_y + soft_y
            m[p, i, 2] = x[p, k + 2] + h_z * x[p, soft + 2]
            dm_dx[p, i, 0, k], dm_dx[p, i, 0, k + 1] = c, -s
            dm_dx[p, i, 1, k], dm_dx[p, i, 1, k + 1] = s, c
            dm_dx[p, i, 2, k + 2] = 1.0
            # d(hard)/d(heading) = z x hard
            turned_x, turned_y = by_x - hard_y, by_y + hard_x
            dm_dx[p, i, 0, 3], dm_dx[p, i, 0, 4] = turned_x * turn_x, turned_x * turn_y
            dm_dx[p, i, 1, 3], dm_dx[p, i, 1, 4] = turned_y * turn_x, turned_y * turn_y
            dm_dx[p, i, 0, soft], dm_dx[p, i, 0, soft + 1] = c * ahead, -s * left
            dm_dx[p, i, 1, soft], dm_dx[p, i, 1, soft + 1] = s * ahead, c * left
            dm_dx[p, i, 2, soft + 2] = h_z
            _position(x, p, i, places[i], c, s, turn_x, turn_y, r, dr_dx)


@compiled_when_used(
    'void(float64[:,:], float64[:,::1], float64, float64[:,:,::1])', error_model='numpy')
def _moment_noise(x: FloatArray, walk: FloatArray, induction2: float, Q: FloatArray) -> None:
    """Write the process noise of the hard iron moments into `Q`.

    It is `walk` (3 d, 3 d) times the squared size of the iron; `induction2` [A^2/m^2] is
    |B0/mu0|^2.
    """
    k = len(walk)
    soft = 6 + k
    for p in range(len(x)):
        size2 = 0.0
        for axis in range(3):
            moment = 0.0
            for i in range(6 + axis, soft, 3):
                moment += x[p, i]
            size2 += moment * moment + x[p, soft + axis] ** 2 * induction2 / 3.0
        for i in range(k):
            for j in range(k):
                Q[p, 6 + i, 6 + j] = size2 * walk[i, j]


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
        _row_dipoles(np.asarray(x, dtype=float), self._places, self.induction, r, m, dr_dx, dm_dx)
        return Dipoles(r, m, dr_dx, dm_dx)

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
        _moment_noise(x, abs(dt) * self._walk, float(self.induction @ self.induction), Q)
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
