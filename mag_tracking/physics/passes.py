"""Fields of passes: rows of dipoles on straight, accelerating and turning paths.

The field is linear in the moments, but not in the path and the clock offsets. A model returns the
design matrix of the moments, and the derivatives of the field with respect to the path parameters;
`inference.least_squares` fits such models.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.physics import core

anderson_residual = core.anderson_residual
"""Residual sum of squares of a fit of Anderson functions and a constant to each column of `y`.

`t` (n,) is in s, `y` (n, k) whitened; `time` is that of the CPA and `scale` [s] its range over the
speed. TSP14 eq. (22), (23), with the exponent 5/2.
"""


def closest_approach(r0: ArrayLike, v0: ArrayLike) -> tuple[float, float, FloatArray]:
    """Time, range and relative position of the closest point of approach (CPA) of a pass.

    `r0` [m] is the position relative to the sensor at time zero, `v0` [m/s] the velocity. The range
    is zero if they are parallel. TSP14 eq. (24).
    """
    r0, v0 = np.asarray(r0, dtype=float), np.asarray(v0, dtype=float)
    speed = np.linalg.norm(v0)
    if not 0.0 < speed < np.inf:
        raise ValueError(f'v0 must be finite and non-zero, got {v0.tolist()}')
    direction = v0 / speed
    travelled = -(r0 @ direction)
    r_cpa = r0 + travelled * direction
    # Project twice: rounding of r0 leaves a component along v0 in the first difference.
    r_cpa -= (r_cpa @ direction) * direction
    distance = float(np.linalg.norm(r_cpa))
    if distance <= 1e-15 * np.linalg.norm(r0):
        distance, r_cpa = 0.0, np.zeros(3)
    return float(travelled / speed), distance, r_cpa


def _offsets_of(n_dipoles: int) -> FloatArray:
    """Offsets of the dipoles from the centre of the row, (d,), relative to its length."""
    return np.linspace(-0.5, 0.5, n_dipoles, dtype=np.float64) if n_dipoles > 1 else np.zeros(1)


def _combinations_of(offsets: FloatArray) -> FloatArray:
    """Orthogonal matrix, (d, d), of combinations of the moments on one axis."""
    return np.linalg.qr(np.vander(offsets, increasing=True))[0]


@dataclass(frozen=True)
class RowPass:
    """A row of `n_dipoles` equidistant dipoles on a straight path at constant velocity.

    Path parameters (6, or 7 for two or more dipoles): centre r0 of the row at time zero [m],
    velocity v0 [m/s], length L from the first to the last dipole [m]. Linear parameters
    (3 n_dipoles): coefficients of orthogonal combinations of the moments [A m², world frame], from
    tail to head. The row is parallel to v0, as in TSP14 eq. (18)-(21), whereas the row of
    `vehicles.RowVehicle` is horizontal.
    """

    t: FloatArray
    """Timestamps of the samples, (n,) s."""
    positions: FloatArray
    """Position of the sensor of each sample, (n, 3) m, world frame."""
    M: FloatArray
    """Whitening matrix times world-to-sensor rotation of each sample, (n, 3, 3)."""
    n_dipoles: int = 1

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the path parameters."""
        return ('x', 'y', 'z', 'vx', 'vy', 'vz', *(('L',) if self.n_dipoles > 1 else ()))

    @cached_property
    def moment_names(self) -> tuple[str, ...]:
        """Names of the moment components, from tail to head."""
        return tuple(f'm{i + 1}{axis}' for i in range(self.n_dipoles) for axis in 'xyz')

    @cached_property
    def combinations(self) -> FloatArray:
        """Orthogonal matrix, (3 d, 3 d), that converts linear parameters to moments of the row."""
        return np.kron(_combinations_of(self._offsets), np.eye(3)).astype(np.float64)

    @cached_property
    def _offsets(self) -> FloatArray:
        return _offsets_of(self.n_dipoles)

    def with_nonnegative_length(self, theta: FloatArray,
                                p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Equivalent parameters without a negative length, which means reversed dipoles."""
        if self.n_dipoles == 1 or theta[6] >= 0.0:
            return theta, p
        moments = (self.combinations @ p).reshape(-1, 3)[::-1]
        return np.append(theta[:6], -theta[6]), self.combinations.T @ moments.ravel()

    def basis(self, theta: FloatArray) -> FloatArray:
        """Whitened design matrices (n_paths, 3 n, 3 n_dipoles); NaN for a dipole at a sensor."""
        A = core.row_bases(np.ascontiguousarray(theta), self._offsets, self.t, self.positions,
                           self.M)
        return A @ self.combinations if self.n_dipoles > 1 else A

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """Derivative (n_paths, 3 n, 6 or 7) of basis(theta) p with respect to theta."""
        return core.row_derivatives(
            np.ascontiguousarray(theta), np.ascontiguousarray(p @ self.combinations.T),
            self._offsets, self.t, self.positions, self.M)


@dataclass(frozen=True)
class SuperposedPasses:
    """Simultaneous passes of several rows: their parameters are concatenated."""

    rows: tuple[RowPass, ...]

    @classmethod
    def from_orders(cls, orders: Sequence[int], t: FloatArray, positions: FloatArray,
                    M: FloatArray) -> 'SuperposedPasses':
        """Create the passes of rows with `orders` dipoles and the same samples."""
        return cls(tuple(RowPass(t, positions, M, n_dipoles) for n_dipoles in orders))

    @cached_property
    def path_slices(self) -> tuple[slice, ...]:
        """Slice of each row in the concatenated path parameters."""
        return _consecutive_slices([len(row.names) for row in self.rows])

    @cached_property
    def moment_slices(self) -> tuple[slice, ...]:
        """Slice of each row in the concatenated linear parameters."""
        return _consecutive_slices([3 * row.n_dipoles for row in self.rows])

    def split(self, theta: FloatArray) -> list[FloatArray]:
        """Split path parameters (n_theta,) into those of each row."""
        return [theta[path_slice] for path_slice in self.path_slices]

    def with_nonnegative_length(self, theta: FloatArray,
                                p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `RowPass.with_nonnegative_length`, for each row."""
        converted = [row.with_nonnegative_length(path, p[moment_slice])
                     for row, path, moment_slice in zip(self.rows, self.split(theta),
                                                        self.moment_slices, strict=True)]
        return (np.concatenate([path for path, _ in converted]),
                np.concatenate([moments for _, moments in converted]))

    def basis(self, theta: FloatArray) -> FloatArray:
        """Whitened design matrices (n_paths, 3 n, k); NaN where a dipole is at a sensor."""
        return np.concatenate([
            row.basis(theta[:, path_slice])
            for row, path_slice in zip(self.rows, self.path_slices, strict=True)], axis=2)

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """Derivative (n_paths, 3 n, n_theta) of basis(theta) p with respect to theta."""
        return np.concatenate([
            row.derivative(theta[:, path_slice], p[:, moment_slice])
            for row, path_slice, moment_slice in zip(self.rows, self.path_slices,
                                                     self.moment_slices, strict=True)], axis=2)


def _consecutive_slices(lengths: Sequence[int]) -> tuple[slice, ...]:
    """Slices of the given lengths, one after the other from index zero."""
    ends = np.cumsum(lengths).tolist()
    return tuple(slice(end - length, end) for end, length in zip(ends, lengths, strict=True))


PATH = core.PATH
"""Names of the path parameters: position x, y, z [m] of the centre of the row, speed [m/s], heading
[rad], climb [m/s] and turn_rate [rad/s] at time zero; length of the row [m]; acceleration [m/s^2];
turn_acceleration [rad/s^2]. `core` defines the order."""
N_PATH = len(PATH)
"""Number of path parameters."""
N_STRAIGHT = PATH.index('acceleration')
"""Number of leading path parameters that describe a straight path at constant speed."""


@dataclass(frozen=True)
class SteadyPass:
    """A row of `n_dipoles` dipoles on a path with constant acceleration and turn acceleration.

    The row rotates with the vehicle. The path parameters `PATH` and the clock offsets are
    concatenated; the entries `free` are the non-linear parameters theta, all others are constants
    from `fixed`. The linear parameters are as in `RowPass`. The tracker fits this model in compiled
    code (`stages/track/steady_fit.hpp`); `basis` and `derivative` are for searches with a prior and
    for simulations.
    """

    t: FloatArray
    positions: FloatArray
    M: FloatArray
    """These three are as in `RowPass`."""
    clock: IntArray
    """Index of the clock of each sample, (n,); -1 for the reference clock, which has no offset."""
    free: IntArray
    """Indices of theta in the concatenated path parameters and clock offsets, ascending."""
    fixed: FloatArray
    """Path parameters and clock offsets [s], (N_PATH + n_clocks,); entries `free` are ignored."""
    n_dipoles: int

    @cached_property
    def offsets(self) -> FloatArray:
        """Offsets of the dipoles from the centre of the row, (d,), relative to its length."""
        return _offsets_of(self.n_dipoles)

    @cached_property
    def combinations(self) -> FloatArray:
        """Orthogonal matrix, (d, d), that converts linear parameters to moments, for x, y or z."""
        return _combinations_of(self.offsets)

    @cached_property
    def _moment_transform(self) -> FloatArray:
        return np.kron(self.combinations, np.eye(3)).astype(np.float64)

    def all_parameters(self, theta: FloatArray) -> FloatArray:
        """Path parameters and clock offsets (n_paths, N_PATH + n_clocks) for free ones `theta`."""
        out = np.tile(self.fixed, (len(theta), 1))
        out[:, self.free] = theta
        return out

    def basis(self, theta: FloatArray) -> FloatArray:
        """Whitened design matrices (n_paths, 3 n, 3 n_dipoles); NaN for a dipole at a sensor."""
        A = core.steady_bases(self.all_parameters(theta), self.offsets, self.t, self.positions,
                              self.M, self.clock)
        return A @ self._moment_transform

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """Derivative (n_paths, 3 n, n_free) of basis(theta) p with respect to theta."""
        D = core.steady_derivatives(
            self.all_parameters(theta), p @ self._moment_transform.T, self.offsets, self.t,
            self.positions, self.M, self.clock)
        return D[:, :, self.free]
