"""Straight passes at constant velocity: the field of a whole pass as a function of few numbers.

The moments enter linearly, the path does not: a model gives the matrix of the former and the
derivatives by the latter (`inference.least_squares` fits such models).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mag_tracking.arrays import CompileOptions, FloatArray
from mag_tracking.compiled import compiled_when_used
from mag_tracking.physics.dipole import field_and_jacobians

_COMPILE: CompileOptions = {'error_model': 'numpy', 'fastmath': {'contract'}}


@compiled_when_used(
    'void(float64[:,:], float64[:], float64[:,::1], float64[::1], float64[:,:,::1], '
    'float64[:,:,::1])', **_COMPILE)
def _row_basis(theta: FloatArray, places: FloatArray, positions: FloatArray, t: FloatArray,
               M: FloatArray, A: FloatArray) -> None:
    """Fields of unit moments: A (n, 3 n_samples, 3 d), each sample's turned by its M."""
    d = places.shape[0]
    for p in range(theta.shape[0]):
        vx, vy, vz = theta[p, 3], theta[p, 4], theta[p, 5]
        stretch = 0.0
        if d > 1:
            stretch = theta[p, 6] / np.sqrt(vx * vx + vy * vy + vz * vz)
        for s in range(t.shape[0]):
            for i in range(d):
                ahead = t[s] + places[i] * stretch
                _, _, (j00, j01, j02, j11, j12, j22) = field_and_jacobians(
                    positions[s, 0] - theta[p, 0] - ahead * vx,
                    positions[s, 1] - theta[p, 1] - ahead * vy,
                    positions[s, 2] - theta[p, 2] - ahead * vz, 0.0, 0.0, 0.0)
                for a in range(3):
                    m0, m1, m2 = M[s, a, 0], M[s, a, 1], M[s, a, 2]
                    A[p, 3 * s + a, 3 * i] = m0 * j00 + m1 * j01 + m2 * j02
                    A[p, 3 * s + a, 3 * i + 1] = m0 * j01 + m1 * j11 + m2 * j12
                    A[p, 3 * s + a, 3 * i + 2] = m0 * j02 + m1 * j12 + m2 * j22


@compiled_when_used(
    'void(float64[:,:], float64[:,:], float64[:], float64[:,::1], float64[::1], '
    'float64[:,:,::1], float64[:,:,::1])', **_COMPILE)
def _row_derivative(theta: FloatArray, moments: FloatArray, places: FloatArray,
                    positions: FloatArray, t: FloatArray, M: FloatArray, D: FloatArray) -> None:
    """Derivatives by theta of the field of the moments: adds to D (n, 3 n_samples, 6 or 7)."""
    d = places.shape[0]
    for p in range(theta.shape[0]):
        vx, vy, vz = theta[p, 3], theta[p, 4], theta[p, 5]
        slowness = 1.0 / np.sqrt(vx * vx + vy * vy + vz * vz)
        ux, uy, uz = vx * slowness, vy * slowness, vz * slowness
        length = theta[p, 6] if d > 1 else 0.0
        for s in range(t.shape[0]):
            for i in range(d):
                ahead = places[i] * length
                _, (g00, g01, g02, g11, g12, g22), _ = field_and_jacobians(
                    positions[s, 0] - theta[p, 0] - t[s] * vx - ahead * ux,
                    positions[s, 1] - theta[p, 1] - t[s] * vy - ahead * uy,
                    positions[s, 2] - theta[p, 2] - t[s] * vz - ahead * uz,
                    moments[p, 3 * i], moments[p, 3 * i + 1], moments[p, 3 * i + 2])
                # The direction of the row turns with v: d(u)/dv = (I - uu')/|v|.
                turn = ahead * slowness
                for a in range(3):
                    m0, m1, m2 = M[s, a, 0], M[s, a, 1], M[s, a, 2]
                    b0 = -(m0 * g00 + m1 * g01 + m2 * g02)
                    b1 = -(m0 * g01 + m1 * g11 + m2 * g12)
                    b2 = -(m0 * g02 + m1 * g12 + m2 * g22)
                    along = b0 * ux + b1 * uy + b2 * uz
                    row = 3 * s + a
                    D[p, row, 0] += b0
                    D[p, row, 1] += b1
                    D[p, row, 2] += b2
                    D[p, row, 3] += (t[s] + turn) * b0 - turn * along * ux
                    D[p, row, 4] += (t[s] + turn) * b1 - turn * along * uy
                    D[p, row, 5] += (t[s] + turn) * b2 - turn * along * uz
                    if d > 1:
                        D[p, row, 6] += places[i] * along


@dataclass(frozen=True)
class RowPass:
    """A row of `n_dipoles` dipoles on a straight line at constant velocity.

    Path (6, with two dipoles or more 7): position r0 of the row's middle at time zero [m],
    velocity v0 [m/s], length L from the first to the last dipole [m]. Linear (3 d): moments
    [A m^2, world], from the tail to the head.

    The row lies along v0, as in the source; that of `vehicles.RowVehicle` stays horizontal. Where
    v0 is zero a row of several has no direction, and the field is NaN.

    Source: TSP14 eq. (18)-(21).
    """

    t: FloatArray
    """(n,) [s] of the samples."""
    positions: FloatArray
    """(n, 3) [m], world, of the sensor that each is of."""
    M: FloatArray
    """(n, 3, 3) what the field of each is multiplied by: world to sensor, and whitening."""
    n_dipoles: int = 1

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the path's numbers."""
        return ('x', 'y', 'z', 'vx', 'vy', 'vz', *(('L',) if self.n_dipoles > 1 else ()))

    @cached_property
    def moment_names(self) -> tuple[str, ...]:
        """Names of the moments, from the tail to the head."""
        return tuple(f'm{i + 1}{axis}' for i in range(self.n_dipoles) for axis in 'xyz')

    @cached_property
    def combinations(self) -> FloatArray:
        """(3 d, 3 d) orthogonal: moments of the row = combinations @ linear parameters."""
        powers = np.vander(self._places, increasing=True)
        return np.kron(np.linalg.qr(powers)[0], np.eye(3))

    @cached_property
    def _places(self) -> FloatArray:
        """(d,) of the dipoles, in lengths of the row."""
        d = self.n_dipoles
        return np.linspace(-0.5, 0.5, d, dtype=np.float64) if d > 1 else np.zeros(1)

    def basis(self, theta: FloatArray) -> FloatArray:
        """Fields of unit combinations, (n_paths, 3 n, 3 d), for paths theta (n_paths, 6 or 7)."""
        A = np.empty((len(theta), 3 * len(self.t), 3 * self.n_dipoles))
        _row_basis(theta, self._places, self.positions, self.t, self.M, A)
        return A @ self.combinations if self.n_dipoles > 1 else A

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """d(basis(theta) p)/d(theta), (n_paths, 3 n, 6 or 7); `p` (n_paths, 3 d)."""
        D = np.zeros((len(theta), 3 * len(self.t), len(self.names)))
        _row_derivative(theta, p @ self.combinations.T, self._places, self.positions, self.t,
                        self.M, D)
        return D
