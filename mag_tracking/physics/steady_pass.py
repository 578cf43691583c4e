"""Passes along a path that bends steadily, seen by sensors whose clocks may be apart.

Unlike `passes.RowPass` the vehicle may accelerate and turn, and the row of dipoles turns with it.
The moments enter linearly, the path and the clocks do not (`inference.least_squares` fits such
models).
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from mag_tracking.arrays import CompileOptions, FloatArray, IntArray
from mag_tracking.compiled import compiled_when_used
from mag_tracking.physics.dipole import field_and_jacobians

PATH = ('x', 'y', 'z', 'speed', 'heading', 'climb', 'length', 'acceleration', 'turn_rate',
        'turn_acceleration')
"""[m], [m/s], [rad], [m/s], [m], [m/s^2], [rad/s], [rad/s^2]: of the row's middle at time zero."""

N_PATH = len(PATH)
N_STRAIGHT = PATH.index('acceleration')
"""Those before it are of a straight path at constant speed."""

_NODES, _WEIGHTS = (np.ascontiguousarray(a) for a in np.polynomial.legendre.leggauss(6))
"""A path that bends is integrated with these: right to a micrometre for turns of 90 degrees."""


_INLINE: CompileOptions = {'error_model': 'numpy', 'forceinline': True}

_X, _Y, _Z, _SPEED, _HEADING, _CLIMB, _LENGTH, _GAIN, _RATE, _MORE = range(N_PATH)
_FIRST_CLOCK = N_PATH


@njit(**_INLINE)
def _own_time(theta: FloatArray, p: int, t: float, clock: int) -> float:
    """When a sample was measured: the stamps of a clock that is ahead are too late."""
    return t - theta[p, _FIRST_CLOCK + clock] if clock >= 0 else t


@njit(**_INLINE)
def _place(theta: FloatArray, p: int, time: float, nodes: FloatArray, weights: FloatArray
           ) -> tuple[float, float, float, float]:
    """Position of the row's middle, and its heading."""
    v, heading, gain = theta[p, _SPEED], theta[p, _HEADING], theta[p, _GAIN]
    rate, more = theta[p, _RATE], theta[p, _MORE]
    x, y = theta[p, _X], theta[p, _Y]
    if rate == 0.0 and more == 0.0:
        way = (v + 0.5 * gain * time) * time
        x += way * np.cos(heading)
        y += way * np.sin(heading)
    else:
        for g in range(nodes.shape[0]):
            at = 0.5 * time * (nodes[g] + 1.0)
            way = 0.5 * time * weights[g] * (v + gain * at)
            angle = heading + (rate + 0.5 * more * at) * at
            x += way * np.cos(angle)
            y += way * np.sin(angle)
    return (x, y, theta[p, _Z] + theta[p, _CLIMB] * time,
            heading + (rate + 0.5 * more * time) * time)


@njit(**_INLINE)
def _moves(theta: FloatArray, p: int, time: float, clock: int, nodes: FloatArray,
           weights: FloatArray, dc: FloatArray, da: FloatArray) -> None:
    """Derivatives by path and clocks: dc (n, 3) of the row's middle, da (n,) of its heading."""
    v, heading, gain = theta[p, _SPEED], theta[p, _HEADING], theta[p, _GAIN]
    rate, more = theta[p, _RATE], theta[p, _MORE]
    for k in range(len(da)):
        dc[k, 0] = dc[k, 1] = dc[k, 2] = da[k] = 0.0
    dc[_X, 0], dc[_Y, 1], dc[_Z, 2], dc[_CLIMB, 2] = 1.0, 1.0, 1.0, time
    for g in range(nodes.shape[0]):
        at = 0.5 * time * (nodes[g] + 1.0)
        step = 0.5 * time * weights[g]
        angle = heading + (rate + 0.5 * more * at) * at
        c, s, way = step * np.cos(angle), step * np.sin(angle), v + gain * at
        dc[_SPEED, 0] += c
        dc[_SPEED, 1] += s
        dc[_GAIN, 0] += at * c
        dc[_GAIN, 1] += at * s
        dc[_HEADING, 0] -= way * s
        dc[_HEADING, 1] += way * c
        dc[_RATE, 0] -= at * way * s
        dc[_RATE, 1] += at * way * c
        dc[_MORE, 0] -= 0.5 * at * at * way * s
        dc[_MORE, 1] += 0.5 * at * at * way * c
    da[_HEADING], da[_RATE], da[_MORE] = 1.0, time, 0.5 * time * time
    if clock >= 0:
        angle = heading + (rate + 0.5 * more * time) * time
        now, k = v + gain * time, _FIRST_CLOCK + clock
        dc[k, 0], dc[k, 1] = -now * np.cos(angle), -now * np.sin(angle)
        dc[k, 2], da[k] = -theta[p, _CLIMB], -rate - more * time


@compiled_when_used(
    'void(float64[:,::1], float64[::1], float64[:,::1], float64[::1], int64[::1], '
    'float64[:,:,::1], float64[::1], float64[::1], float64[:,:,::1])', error_model='numpy')
def _basis(theta: FloatArray, places: FloatArray, positions: FloatArray, t: FloatArray,
           clock: IntArray, M: FloatArray, nodes: FloatArray, weights: FloatArray,
           A: FloatArray) -> None:
    """Fields of unit moments: A (n, 3 n_samples, 3 d), each sample's turned by its M."""
    for p in range(theta.shape[0]):
        for k in range(t.shape[0]):
            time = _own_time(theta, p, t[k], clock[k])
            x, y, z, angle = _place(theta, p, time, nodes, weights)
            ux, uy = np.cos(angle), np.sin(angle)
            for i in range(places.shape[0]):
                q = places[i] * theta[p, _LENGTH]
                _, _, (j00, j01, j02, j11, j12, j22) = field_and_jacobians(
                    positions[k, 0] - x - q * ux, positions[k, 1] - y - q * uy,
                    positions[k, 2] - z, 0.0, 0.0, 0.0)
                for a in range(3):
                    m0, m1, m2 = M[k, a, 0], M[k, a, 1], M[k, a, 2]
                    A[p, 3 * k + a, 3 * i] = m0 * j00 + m1 * j01 + m2 * j02
                    A[p, 3 * k + a, 3 * i + 1] = m0 * j01 + m1 * j11 + m2 * j12
                    A[p, 3 * k + a, 3 * i + 2] = m0 * j02 + m1 * j12 + m2 * j22


@compiled_when_used(
    'void(float64[:,::1], float64[:,::1], float64[::1], float64[:,::1], float64[::1], '
    'int64[::1], float64[:,:,::1], float64[::1], float64[::1], float64[:,:,::1])',
    error_model='numpy')
def _derivative(theta: FloatArray, moments: FloatArray, places: FloatArray,
                positions: FloatArray, t: FloatArray, clock: IntArray, M: FloatArray,
                nodes: FloatArray, weights: FloatArray, D: FloatArray) -> None:
    """Derivatives by path and clocks of the field of the moments: adds to D."""
    n = theta.shape[1]
    dc, da = np.empty((n, 3)), np.empty(n)
    for p in range(theta.shape[0]):
        for k in range(t.shape[0]):
            time = _own_time(theta, p, t[k], clock[k])
            x, y, z, angle = _place(theta, p, time, nodes, weights)
            _moves(theta, p, time, clock[k], nodes, weights, dc, da)
            ux, uy = np.cos(angle), np.sin(angle)
            for i in range(places.shape[0]):
                q = places[i] * theta[p, _LENGTH]
                _, (g00, g01, g02, g11, g12, g22), _ = field_and_jacobians(
                    positions[k, 0] - x - q * ux, positions[k, 1] - y - q * uy,
                    positions[k, 2] - z, moments[p, 3 * i], moments[p, 3 * i + 1],
                    moments[p, 3 * i + 2])
                for a in range(3):
                    m0, m1, m2 = M[k, a, 0], M[k, a, 1], M[k, a, 2]
                    b0 = -(m0 * g00 + m1 * g01 + m2 * g02)
                    b1 = -(m0 * g01 + m1 * g11 + m2 * g12)
                    b2 = -(m0 * g02 + m1 * g12 + m2 * g22)
                    aside = q * (b1 * ux - b0 * uy)
                    for c in range(n):
                        D[p, 3 * k + a, c] += (b0 * dc[c, 0] + b1 * dc[c, 1] + b2 * dc[c, 2]
                                               + aside * da[c])
                    D[p, 3 * k + a, _LENGTH] += places[i] * (b0 * ux + b1 * uy)


@dataclass(frozen=True)
class SteadyPass:
    """A row of `n_dipoles` dipoles along a path of steady acceleration and turning.

    theta: those of `PATH` and of the clocks that are in `free`, in that order; the others stay as
    in `fixed`. Linear (3 d): combinations of the moments.
    """

    t: FloatArray
    """(n,) [s] of the samples."""
    positions: FloatArray
    """(n, 3) [m], world, of the sensor that each is of."""
    M: FloatArray
    """(n, 3, 3) what the field of each is multiplied by: world to sensor, and whitening."""
    clock: IntArray
    """(n,) which of the clocks each sample is of; -1 = the one that the others are compared to."""
    free: IntArray
    """Columns of (path, clocks) that theta holds, ascending."""
    fixed: FloatArray
    """(N_PATH + n_clocks,) path and clocks [s]; only those that are not free count."""
    n_dipoles: int
    _places: FloatArray = field(init=False)
    _combinations: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Places in lengths of the row; combinations of moments that are orthogonal along it."""
        d = self.n_dipoles
        places = np.linspace(-0.5, 0.5, d) if d > 1 else np.zeros(1)
        object.__setattr__(self, '_places', places)
        object.__setattr__(self, '_combinations', np.kron(
            np.linalg.qr(np.vander(places, increasing=True))[0], np.eye(3)))

    def whole(self, theta: FloatArray) -> FloatArray:
        """(n_paths, N_PATH + n_clocks) path and clocks for theta (n_paths, n_free)."""
        out = np.tile(self.fixed, (len(theta), 1))
        out[:, self.free] = theta
        return out

    def basis(self, theta: FloatArray) -> FloatArray:
        """Fields of unit combinations, (n_paths, 3 n, 3 d), for theta (n_paths, n_free)."""
        A = np.empty((len(theta), 3 * len(self.t), 3 * self.n_dipoles))
        _basis(self.whole(theta), self._places, self.positions, self.t, self.clock, self.M,
               _NODES, _WEIGHTS, A)
        return A @ self._combinations

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """d(basis(theta) p)/d(theta), (n_paths, 3 n, n_free); `p` (n_paths, 3 d)."""
        D = np.zeros((len(theta), 3 * len(self.t), len(self.fixed)))
        _derivative(self.whole(theta), np.ascontiguousarray(p @ self._combinations.T),
                    self._places, self.positions, self.t, self.clock, self.M, _NODES, _WEIGHTS, D)
        free: FloatArray = D[:, :, self.free]
        return free
