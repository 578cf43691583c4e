"""Straight passes at constant velocity: the field of a whole pass as a function of few numbers.

The moments enter linearly, the path does not: a model gives the matrix of the former and the
derivatives by the latter (`inference.least_squares` fits such models).
"""

from collections.abc import Sequence
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

    def forward(self, theta: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Path (6 or 7,) and parameters (3 d,) of the same row with a length above zero."""
        if self.n_dipoles == 1 or theta[6] >= 0.0:
            return theta, p
        moments = (self.combinations @ p).reshape(-1, 3)[::-1]
        return np.append(theta[:6], -theta[6]), self.combinations.T @ moments.ravel()

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


@dataclass(frozen=True)
class SuperposedPasses:
    """Several rows at once: their fields add up.

    Path and linear parameters are those of the rows, one row after the other.
    """

    rows: tuple[RowPass, ...]

    @classmethod
    def of(cls, orders: Sequence[int], t: FloatArray, positions: FloatArray,
           M: FloatArray) -> 'SuperposedPasses':
        """Rows of `orders` dipoles; the rest is as for `RowPass`."""
        return cls(tuple(RowPass(t, positions, M, n_dipoles) for n_dipoles in orders))

    @cached_property
    def paths(self) -> tuple[slice, ...]:
        """Where the path of each row is."""
        return _consecutive([len(row.names) for row in self.rows])

    @cached_property
    def moments(self) -> tuple[slice, ...]:
        """Where the linear parameters of each row are."""
        return _consecutive([3 * row.n_dipoles for row in self.rows])

    def split(self, theta: FloatArray) -> list[FloatArray]:
        """The path (6 or 7,) of each row."""
        return [theta[own] for own in self.paths]

    def forward(self, theta: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Paths (n_theta,) and parameters (k,) of the same rows with lengths above zero."""
        turned = [row.forward(path, p[linear])
                  for row, path, linear in zip(self.rows, self.split(theta), self.moments,
                                               strict=True)]
        return (np.concatenate([path for path, _ in turned]),
                np.concatenate([moments for _, moments in turned]))

    def basis(self, theta: FloatArray) -> FloatArray:
        """Fields of unit parameters, (n_paths, 3 n, k), for paths theta (n_paths, n_theta)."""
        return np.concatenate([row.basis(theta[:, own])
                               for row, own in zip(self.rows, self.paths, strict=True)], axis=2)

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """d(basis(theta) p)/d(theta), (n_paths, 3 n, n_theta); `p` (n_paths, k)."""
        return np.concatenate([
            row.derivative(theta[:, own], p[:, linear])
            for row, own, linear in zip(self.rows, self.paths, self.moments, strict=True)], axis=2)


def _consecutive(sizes: Sequence[int]) -> tuple[slice, ...]:
    """Slices of such sizes, one after the other."""
    ends = np.cumsum(sizes).tolist()
    return tuple(slice(end - size, end) for end, size in zip(ends, sizes, strict=True))
