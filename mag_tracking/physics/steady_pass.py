"""Passes along a path that bends steadily, seen by sensors whose clocks may be apart.

Unlike `passes.RowPass` the vehicle may accelerate and turn, and the row of dipoles turns with it.
The moments enter linearly, the path and the clocks do not (`inference.least_squares` fits such
models).
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.physics.dipole import field_and_jacobians

PATH = ('x', 'y', 'z', 'speed', 'heading', 'climb', 'length', 'acceleration', 'turn_rate',
        'turn_acceleration')
"""[m], [m/s], [rad], [m/s], [m], [m/s^2], [rad/s], [rad/s^2]: of the row's middle at time zero."""

N_PATH = len(PATH)
N_STRAIGHT = PATH.index('acceleration')
"""Those before it are of a straight path at constant speed."""

_STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-4, 1e-3, 1e-3, 1e-3, 1e-4, 1e-4])
_CLOCK_STEP = 1e-4
"""[s] Steps of the numerical derivatives: much shorter than what a field changes on, and long
enough for rounding."""

_NODES, _WEIGHTS = (np.ascontiguousarray(a) for a in np.polynomial.legendre.leggauss(6))
"""A path that bends is integrated with these: right to a micrometre for turns of 90 degrees."""


@njit('void(float64[:,::1], float64[::1], float64[:,::1], float64[::1], int64[::1], '
      'float64[:,:,::1], float64[::1], float64[::1], float64[:,:,::1])', cache=True,
      error_model='numpy')
def _basis(theta: FloatArray, places: FloatArray, positions: FloatArray, t: FloatArray,
           clock: IntArray, M: FloatArray, nodes: FloatArray, weights: FloatArray,
           A: FloatArray) -> None:
    """Fields of unit moments: A (n, 3 n_samples, 3 d), each sample's turned by its M."""
    n_path = 10
    for p in range(theta.shape[0]):
        x0, y0, z0, v, heading = (theta[p, 0], theta[p, 1], theta[p, 2], theta[p, 3],
                                  theta[p, 4])
        climb, length, gain, rate, more = (theta[p, 5], theta[p, 6], theta[p, 7], theta[p, 8],
                                           theta[p, 9])
        for k in range(t.shape[0]):
            time = t[k]
            if clock[k] >= 0:
                # A clock that is ahead says too late a time.
                time -= theta[p, n_path + clock[k]]
            x, y = positions[k, 0] - x0, positions[k, 1] - y0
            if rate == 0.0 and more == 0.0:
                way = (v + 0.5 * gain * time) * time
                x -= way * np.cos(heading)
                y -= way * np.sin(heading)
            else:
                for g in range(nodes.shape[0]):
                    at = 0.5 * time * (nodes[g] + 1.0)
                    way = 0.5 * time * weights[g] * (v + gain * at)
                    angle = heading + (rate + 0.5 * more * at) * at
                    x -= way * np.cos(angle)
                    y -= way * np.sin(angle)
            z = positions[k, 2] - z0 - climb * time
            angle = heading + (rate + 0.5 * more * time) * time
            ux, uy = np.cos(angle), np.sin(angle)
            for i in range(places.shape[0]):
                q = places[i] * length
                _, _, (j00, j01, j02, j11, j12, j22) = field_and_jacobians(
                    x - q * ux, y - q * uy, z, 0.0, 0.0, 0.0)
                for a in range(3):
                    m0, m1, m2 = M[k, a, 0], M[k, a, 1], M[k, a, 2]
                    A[p, 3 * k + a, 3 * i] = m0 * j00 + m1 * j01 + m2 * j02
                    A[p, 3 * k + a, 3 * i + 1] = m0 * j01 + m1 * j11 + m2 * j12
                    A[p, 3 * k + a, 3 * i + 2] = m0 * j02 + m1 * j12 + m2 * j22


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
    """(10 + n_clocks,) path and clocks [s]; only those that are not free count."""
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
        """(n_paths, 10 + n_clocks) path and clocks for theta (n_paths, n_free)."""
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
        steps = np.append(_STEPS, np.full(len(self.fixed) - N_PATH, _CLOCK_STEP))[self.free]
        D = np.empty((len(theta), 3 * len(self.t), len(self.free)))
        for k, step in enumerate(steps):
            there, back = theta.copy(), theta.copy()
            there[:, k] += step
            back[:, k] -= step
            difference = self.basis(there) - self.basis(back)
            D[:, :, k] = np.einsum('nyk,nk->ny', difference, p) / (2.0 * step)
        return D
