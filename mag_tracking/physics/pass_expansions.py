"""Expansions of the field of a straight pass: multipoles about one point, or Anderson functions.

The classes implement `inference.least_squares.SeparableModel`: the field is linear in all
parameters except the path parameters.
"""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.physics.multipole import multipole_jacobians
from mag_tracking.physics.passes import anderson_functions

_N_MOMENTS = {1: 3, 2: 8, 3: 15}
"""Number of moments for each highest order of an expansion."""


@dataclass(frozen=True)
class MultipolePass:
    """Multipoles on a straight path at constant velocity, T10 eq. (4.17), (4.18).

    Path parameters (6): position at time zero [m], velocity [m/s]. Linear parameters (3, 8 or 15):
    the moments of `multipole.multipole_field`, world frame. Valid for bodies of any shape, but only
    outside the sphere that encloses the body.
    """

    t: FloatArray
    """Timestamps of the samples, (n,) s."""
    positions: FloatArray
    """Position of the sensor of each sample, (n, 3) m, world frame."""
    M: FloatArray
    """Whitening matrix times world-to-sensor rotation of each sample, (n, 3, 3)."""
    order: int = 2
    """Highest multipole order: 1, 2 or 3."""

    names = ('x', 'y', 'z', 'vx', 'vy', 'vz')
    """Names of the path parameters."""

    def _relative_positions(self, theta: FloatArray) -> FloatArray:
        """Position of the sensor relative to the target, (n_paths, n, 3) m."""
        return (self.positions - theta[:, None, :3]
                - self.t[:, None] * theta[:, None, 3:])

    def basis(self, theta: FloatArray) -> FloatArray:
        """Whitened design matrices (n_paths, 3 n, 3 | 8 | 15) of the moments; NaN for a target at a
        sensor."""
        _, A = multipole_jacobians(self._relative_positions(theta),
                                   np.zeros(_N_MOMENTS[self.order]))
        return (self.M @ A).reshape(len(theta), 3 * len(self.t), -1)

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """Derivative (n_paths, 3 n, 6) of basis(theta) p with respect to theta."""
        gradient, _ = multipole_jacobians(self._relative_positions(theta), p[:, None])
        D = -(self.M @ gradient)
        return np.concatenate([D, self.t[:, None, None] * D], axis=-1).reshape(
            len(theta), 3 * len(self.t), 6)


@dataclass(frozen=True)
class AndersonPass:
    """Field of a dipole on a straight path past one sensor, expanded in Anderson functions.

    Path parameters (2): time of the CPA [s], speed over range at the CPA [1/s]. Linear parameters
    (9): coefficients of the three functions on each axis of the sensor [T], axis by axis. A dipole
    has only six independent coefficients; nine free ones keep the model linear. TSP14 eq. (22),
    (23), corrected as in `passes`.
    """

    t: FloatArray
    """Timestamps of the samples, (n,) s."""
    W: FloatArray
    """Whitening matrix of each sample, (n, 3, 3)."""

    names = ('t_cpa', 'rate')
    """Names of the path parameters."""

    def _design_matrix(self, f: FloatArray) -> FloatArray:
        """Whitened design matrix (n_paths, 3 n, 9) of three functions `f`, (n_paths, n, 3)."""
        columns: FloatArray = np.einsum('nab,pnf->pnabf', self.W, f)
        return columns.reshape(len(f), 3 * len(self.t), 9)

    def basis(self, theta: FloatArray) -> FloatArray:
        """Whitened design matrices (n_paths, 3 n, 9) of the coefficients."""
        return self._design_matrix(anderson_functions(theta[:, 1:] * (self.t - theta[:, :1])))

    def derivative(self, theta: FloatArray, p: FloatArray) -> FloatArray:
        """Derivative (n_paths, 3 n, 2) of basis(theta) p with respect to theta."""
        tau = theta[:, 1:] * (self.t - theta[:, :1])
        f0, f1, f2 = np.moveaxis(anderson_functions(tau), -1, 0)
        # f_n = tau^n (tau^2 + 1)^(-5/2), so f_n' = n f_{n-1} - 5 tau/(tau^2 + 1) f_n.
        decay = 5.0 * tau / (tau * tau + 1.0)
        slope = np.stack([-decay * f0, f0 - decay * f1, 2.0 * f1 - decay * f2], axis=-1)
        derivative_by_tau = np.einsum('pyk,pk->py', self._design_matrix(slope), p)
        tau_by_rate = np.repeat(self.t - theta[:, :1], 3, axis=1)
        return np.stack([-theta[:, 1:] * derivative_by_tau, tau_by_rate * derivative_by_tau],
                        axis=-1)
