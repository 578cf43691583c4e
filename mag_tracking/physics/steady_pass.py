"""Field of a pass with constant acceleration, constant turn acceleration and clock offsets.

Unlike in `passes.RowPass`, the vehicle may accelerate and turn. The row of dipoles rotates with the
vehicle. The field is linear in the moments, but not in the path and the clock offsets.
`inference.separable_fit` fits such models.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.physics import core

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

    The path parameters `PATH` and the clock offsets are concatenated; the entries `free` are the
    non-linear parameters theta, all others are constants from `fixed`. The linear parameters
    (3 n_dipoles) are coefficients of orthogonal combinations of the moments. The tracker fits this
    model in compiled code (`stages/track/steady_fit.hpp`); `basis` and `derivative` are for
    searches with a prior and for simulations.
    """

    t: FloatArray
    """Timestamps of the samples, (n,) s."""
    positions: FloatArray
    """Position of the sensor of each sample, (n, 3) m, world frame."""
    M: FloatArray
    """Whitening matrix times world-to-sensor rotation of each sample, (n, 3, 3)."""
    clock: IntArray
    """Index of the clock of each sample, (n,); -1 for the reference clock, which has no offset."""
    free: IntArray
    """Indices of theta in the concatenated path parameters and clock offsets, ascending."""
    fixed: FloatArray
    """Path parameters and clock offsets [s], (N_PATH + n_clocks,). The entries with the indices
    `free` are ignored."""
    n_dipoles: int
    """Number of dipoles of the row."""
    offsets: FloatArray = field(init=False)
    """Offsets of the dipoles from the centre of the row, (d,), relative to its length."""
    combinations: FloatArray = field(init=False)
    """Orthogonal matrix, (d, d), that converts linear parameters to moments, for x, y or z."""

    def __post_init__(self) -> None:
        """Compute the offsets of the dipoles in the row and the combinations of their moments."""
        d = self.n_dipoles
        offsets = np.linspace(-0.5, 0.5, d) if d > 1 else np.zeros(1)
        object.__setattr__(self, 'offsets', offsets)
        object.__setattr__(self, 'combinations',
                           np.linalg.qr(np.vander(offsets, increasing=True))[0])

    @cached_property
    def _moment_transform(self) -> FloatArray:
        """Matrix, (3 d, 3 d), that converts linear parameters to moments of the row."""
        return np.kron(self.combinations, np.eye(3)).astype(np.float64)

    def all_parameters(self, theta: FloatArray) -> FloatArray:
        """Path parameters and clock offsets (n_paths, N_PATH + n_clocks) with free parameters
        `theta`."""
        out = np.tile(self.fixed, (len(theta), 1))
        out[:, self.free] = theta
        return out

    def basis(self, theta: FloatArray) -> FloatArray:
        """Whitened design matrices (n_paths, 3 n, 3 n_dipoles); NaN where a dipole is at a
        sensor."""
        A = core.steady_bases(self.all_parameters(theta), self.offsets, self.t, self.positions,
                              self.M, self.clock)
        return A @ self._moment_transform

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """Derivative (n_paths, 3 n, n_free) of basis(theta) p with respect to theta."""
        D = core.steady_derivatives(
            self.all_parameters(theta), p @ self._moment_transform.T, self.offsets, self.t,
            self.positions, self.M, self.clock)
        free: FloatArray = D[:, :, self.free]
        return free
