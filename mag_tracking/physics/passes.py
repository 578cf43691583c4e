"""Straight passes at constant velocity: the field of a whole pass as a function of few numbers.

The moments enter linearly, the path does not: a model gives the matrix of the former and the
derivatives by the latter (`inference.least_squares` fits such models).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core


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
        A = core.row_bases(np.ascontiguousarray(theta), self._places, self.t, self.positions,
                           self.M)
        return A @ self.combinations if self.n_dipoles > 1 else A

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """d(basis(theta) p)/d(theta), (n_paths, 3 n, 6 or 7); `p` (n_paths, 3 d)."""
        return core.row_derivatives(
            np.ascontiguousarray(theta), np.ascontiguousarray(p @ self.combinations.T),
            self._places, self.t, self.positions, self.M)
