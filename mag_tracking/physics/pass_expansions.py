"""Straight passes as expansions: multipoles about one point, Anderson functions of one sensor.

The same kind of model as `passes.RowPass`: linear in most of its parameters.
"""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.physics.anderson import anderson_functions
from mag_tracking.physics.multipole import multipole_jacobians

_N_MOMENTS = {1: 3, 2: 8, 3: 15}


@dataclass(frozen=True)
class MultipolePass:
    """Multipoles up to `order` 1, 2 or 3 about one point, on a straight line at constant velocity.

    Path (6): position r0 at time zero [m], velocity v0 [m/s]. Linear (3, 8 or 15): the moments of
    `multipole.multipole_field`, world. Where a row needs a length, this needs more moments; it
    describes any shape, but only from outside the sphere around it.

    Source: T10 eq. (4.17), (4.18).
    """

    t: FloatArray
    """(n,) [s] of the samples."""
    positions: FloatArray
    """(n, 3) [m], world, of the sensor that each is of."""
    M: FloatArray
    """(n, 3, 3) what the field of each is multiplied by: world to sensor, and whitening."""
    order: int = 2

    names = ('x', 'y', 'z', 'vx', 'vy', 'vz')

    def _relative_positions(self, theta: FloatArray) -> FloatArray:
        """(n_paths, n, 3) [m] sensor minus target."""
        return (self.positions - theta[:, None, :3]
                - self.t[:, None] * theta[:, None, 3:])

    def basis(self, theta: FloatArray) -> FloatArray:
        """Fields of unit moments, (n_paths, 3 n, 3 | 8 | 15), for paths theta (n_paths, 6)."""
        _, A = multipole_jacobians(self._relative_positions(theta),
                                   np.zeros(_N_MOMENTS[self.order]))
        return (self.M @ A).reshape(len(theta), 3 * len(self.t), -1)

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """d(basis(theta) p)/d(theta), (n_paths, 3 n, 6); `p` (n_paths, 3 | 8 | 15)."""
        gradient, _ = multipole_jacobians(self._relative_positions(theta), p[:, None])
        D = -(self.M @ gradient)
        return np.concatenate([D, self.t[:, None, None] * D], axis=-1).reshape(
            len(theta), 3 * len(self.t), 6)


@dataclass(frozen=True)
class AndersonPass:
    """A dipole that passes one sensor on a straight line, in Anderson functions.

    Path (2): time of the closest approach [s] and speed over its range [1/s]. Linear (9): the
    coefficients of the three functions on each axis of the sensor [T], axis by axis. Of these nine
    a dipole has six independent ones; they are fitted as if they were free, which makes the search
    easier.

    Source: TSP14 eq. (22), (23), corrected as in `anderson`.
    """

    t: FloatArray
    """(n,) [s] of the samples."""
    W: FloatArray
    """(n, 3, 3) whitening."""

    names = ('t_cpa', 'rate')

    def _spread(self, f: FloatArray) -> FloatArray:
        """(n_paths, 3 n, 9) of functions of time (n_paths, n, 3)."""
        columns: FloatArray = np.einsum('nab,pnf->pnabf', self.W, f)
        return columns.reshape(len(f), 3 * len(self.t), 9)

    def basis(self, theta: FloatArray) -> FloatArray:
        """Fields of unit coefficients, (n_paths, 3 n, 9), for paths theta (n_paths, 2)."""
        return self._spread(anderson_functions(theta[:, 1:] * (self.t - theta[:, :1])))

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """d(basis(theta) p)/d(theta), (n_paths, 3 n, 2); `p` (n_paths, 9)."""
        tau = theta[:, 1:] * (self.t - theta[:, :1])
        f0, f1, f2 = np.moveaxis(anderson_functions(tau), -1, 0)
        # f_n = tau^n (tau^2 + 1)^(-5/2), so f_n' = n f_{n-1} - 5 tau/(tau^2 + 1) f_n.
        decay = 5.0 * tau / (tau * tau + 1.0)
        slope = np.stack([-decay * f0, f0 - decay * f1, 2.0 * f1 - decay * f2], axis=-1)
        by_tau = np.einsum('pyk,pk->py', self._spread(slope), p)
        by_time = np.repeat(self.t - theta[:, :1], 3, axis=1)
        return np.stack([-theta[:, 1:] * by_tau, by_time * by_tau], axis=-1)
