"""Passes at constant speed along an arc, seen by sensors whose clocks may be apart.

Unlike `passes.RowPass` the path may turn, and the row of dipoles turns with it. The moments enter
linearly, the path and the clocks do not (`inference.least_squares` fits such models).
"""

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.physics.dipole import field_and_jacobians

PATH = ('x', 'y', 'z', 'speed', 'heading', 'climb', 'length', 'turn_rate')
"""[m], [m/s], [rad], [m/s], [m], [rad/s]: of the row's middle at time zero."""

N_PATH = len(PATH)

_STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-4, 1e-3, 1e-3, 1e-4])
_CLOCK_STEP = 1e-4
"""[s] Steps of the numerical derivatives: much shorter than what a field changes on, and long
enough for rounding."""

_STRAIGHT = 1e-6
"""[rad] An arc that turns by less than this is a straight line."""


@njit('void(float64[:,::1], float64[::1], float64[:,::1], float64[::1], int64[::1], '
      'float64[:,:,::1], float64[:,:,::1])', cache=True, error_model='numpy')
def _arc_basis(theta: FloatArray, places: FloatArray, positions: FloatArray, t: FloatArray,
               clock: IntArray, M: FloatArray, A: FloatArray) -> None:
    """Fields of unit moments: A (n, 3 n_samples, 3 d), each sample's turned by its M."""
    for p in range(theta.shape[0]):
        v, climb, length, rate = theta[p, 3], theta[p, 5], theta[p, 6], theta[p, 7]
        c, s = np.cos(theta[p, 4]), np.sin(theta[p, 4])
        for k in range(t.shape[0]):
            time = t[k]
            if clock[k] >= 0:
                # A clock that is ahead says too late a time.
                time -= theta[p, 8 + clock[k]]
            angle = rate * time
            if abs(angle) < _STRAIGHT:
                ahead, aside = v * time, 0.5 * v * time * angle
            else:
                ahead, aside = v / rate * np.sin(angle), v / rate * (1.0 - np.cos(angle))
            x = positions[k, 0] - theta[p, 0] - c * ahead + s * aside
            y = positions[k, 1] - theta[p, 1] - s * ahead - c * aside
            z = positions[k, 2] - theta[p, 2] - climb * time
            ux, uy = np.cos(theta[p, 4] + angle), np.sin(theta[p, 4] + angle)
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
class ArcPass:
    """A row of `n_dipoles` dipoles along a horizontal arc, at constant speed and climb.

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
    """(8 + n_clocks,) path and clocks [s]; only those that are not free count."""
    n_dipoles: int = 3
    _places: FloatArray = field(init=False)
    _combinations: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        """Places in lengths of the row; combinations of moments that are orthogonal along it."""
        places = np.linspace(-0.5, 0.5, self.n_dipoles)
        object.__setattr__(self, '_places', places)
        object.__setattr__(self, '_combinations', np.kron(
            np.linalg.qr(np.vander(places, increasing=True))[0], np.eye(3)))

    def whole(self, theta: FloatArray) -> FloatArray:
        """(n_paths, 8 + n_clocks) path and clocks for theta (n_paths, n_free)."""
        out = np.tile(self.fixed, (len(theta), 1))
        out[:, self.free] = theta
        return out

    def basis(self, theta: FloatArray) -> FloatArray:
        """Fields of unit combinations, (n_paths, 3 n, 3 d), for theta (n_paths, n_free)."""
        return self._basis(self.whole(theta))

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

    def _basis(self, whole: FloatArray) -> FloatArray:
        A = np.empty((len(whole), 3 * len(self.t), 3 * self.n_dipoles))
        _arc_basis(whole, self._places, self.positions, self.t, self.clock, self.M, A)
        return A @ self._combinations
