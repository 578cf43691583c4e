"""Passes along a path that bends steadily, seen by sensors whose clocks may be apart.

Unlike `passes.RowPass` the vehicle may accelerate and turn, and the row of dipoles turns with it.
The moments enter linearly, the path and the clocks do not (`inference.least_squares` fits such
models).
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.physics import core

PATH = core.PATH
"""Names of position x, y, z [m], speed [m/s], heading [rad], climb [m/s], length [m], acceleration
[m/s^2], turn_rate [rad/s] and turn_acceleration [rad/s^2]: of the row's middle at time zero."""

N_PATH = len(PATH)
N_STRAIGHT = PATH.index('acceleration')
"""Those before it are of a straight path at constant speed."""


@dataclass(frozen=True)
class SteadyPass:
    """A row of `n_dipoles` dipoles along a path of steady acceleration and turning.

    theta: those of `PATH` and of the clocks that are in `free`, in that order; the others stay as
    in `fixed`. Linear (3 d): combinations of the moments. The tracker fits it in compiled code
    (`stages/track/steady_fit.hpp`); `basis` and `derivative` are for searches that have a prior,
    and for simulations.
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
    places: FloatArray = field(init=False)
    """(d,) of the dipoles from the row's middle, in lengths of the row."""
    combinations: FloatArray = field(init=False)
    """(d, d) by which each component of the moments follows from that of the linear parameters:
    columns that are orthogonal along the row."""

    def __post_init__(self) -> None:
        """Places of the dipoles, and combinations of their moments."""
        d = self.n_dipoles
        places = np.linspace(-0.5, 0.5, d) if d > 1 else np.zeros(1)
        object.__setattr__(self, 'places', places)
        object.__setattr__(self, 'combinations',
                           np.linalg.qr(np.vander(places, increasing=True))[0])

    @cached_property
    def _moment_transform(self) -> FloatArray:
        """(3 d, 3 d): moments of the row = mixing @ linear parameters."""
        return np.kron(self.combinations, np.eye(3)).astype(np.float64)

    def whole(self, theta: FloatArray) -> FloatArray:
        """(n_paths, N_PATH + n_clocks) path and clocks for theta (n_paths, n_free)."""
        out = np.tile(self.fixed, (len(theta), 1))
        out[:, self.free] = theta
        return out

    def basis(self, theta: FloatArray) -> FloatArray:
        """Fields of unit combinations, (n_paths, 3 n, 3 d), for theta (n_paths, n_free)."""
        A = core.steady_bases(self.whole(theta), self.places, self.t, self.positions, self.M,
                              self.clock)
        return A @ self._moment_transform

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """d(basis(theta) p)/d(theta), (n_paths, 3 n, n_free); `p` (n_paths, 3 d)."""
        D = core.steady_derivatives(
            self.whole(theta), p @ self._moment_transform.T, self.places, self.t,
            self.positions, self.M, self.clock)
        free: FloatArray = D[:, :, self.free]
        return free
