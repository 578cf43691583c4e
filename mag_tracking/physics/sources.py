"""Source models of targets: states, exactly discretised motion, and dipoles.

A source model maps a batch of target states to dipoles and their derivatives, from which
`dipole.sensor_fields` computes the field at the sensors.

The process noise is the exact discretisation of continuous white noise in the highest derivative.
T10 eq. (4.2) and ICASSP11 eq. (2) instead assume noise that is constant over a sample. PHD15 Paper
A eq. (18) is misprinted.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking import geometry
from mag_tracking.arrays import FloatArray
from mag_tracking.physics import core

_INTEGRAL, _RATE = np.arange(3), np.arange(3, 6)


def integrator_noise(dt: float, density: ArrayLike) -> FloatArray:
    """Process noise covariance (6, 6) of positions, then rates, driven by white noise over `dt`.

    For each axis it is density * [[dt^3/3, dt^2/2], [dt^2/2, dt]]; `density` (3,) is the spectral
    density of the second derivative. PHD15 Paper A eq. (24), the correct form of eq. (18).
    """
    Q, density = np.zeros((6, 6)), np.asarray(density, dtype=float)
    Q[_INTEGRAL, _INTEGRAL] = density * (dt**3 / 3.0)
    Q[_INTEGRAL, _RATE] = Q[_RATE, _INTEGRAL] = density * (dt**2 / 2.0)
    Q[_RATE, _RATE] = density * dt
    return Q


def constant_velocity(dt: float) -> FloatArray:
    """Transition matrix (6, 6) of x, y, z, vx, vy, vz at constant velocity."""
    F = np.eye(6)
    F[_INTEGRAL, _RATE] = dt
    return F


def decaying_turn(x: FloatArray, dt: float, mean_factor: float, final_factor: float
                  ) -> tuple[FloatArray, FloatArray]:
    """Propagate states (n, n_x) along an arc; return also the Jacobians. [BarShalom01]_ 11.7.

    The first six states are position and velocity, the last is the turn rate [rad/s], anticlockwise
    from above, whose mean over `dt` and final value are the given factors of the initial rate. A
    negative `dt` propagates backwards.
    """
    return core.propagate_turn(np.ascontiguousarray(x, dtype=float), dt, mean_factor, final_factor)


class Dipoles(NamedTuple):
    """Dipoles of each hypothesis, and their derivatives with respect to the target state."""

    r: FloatArray
    """Positions, (n_hyp, n_dipoles, 3) m, world frame."""
    m: FloatArray
    """Moments, (n_hyp, n_dipoles, 3) A m², world frame."""
    dr_dx: FloatArray
    """Derivative of the positions with respect to the state, (n_hyp, n_dipoles, 3, n_t)."""
    dm_dx: FloatArray
    """Derivative of the moments with respect to the state, (n_hyp, n_dipoles, 3, n_t)."""


class SourceModel(Protocol):
    """Interface of a source model. The first six states are position and velocity."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states in their order."""

    def dipoles(self, x: FloatArray) -> Dipoles:
        """Compute the dipoles of target states.

        Parameters
        ----------
        x : (n_hyp, n_t) array
            Target states.

        Returns
        -------
        Dipoles
        """

    def propagate(self, x: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """Predict target states; the compiled filter adds process noise.

        Parameters
        ----------
        x : (n_hyp, n_t) array
            Target states.
        dt : float, s
            Prediction interval; negative to propagate backwards.

        Returns
        -------
        x : (n_hyp, n_t) array
            States after `dt`.
        F : (..., n_t, n_t) array
            Jacobian of the prediction.
        """


@dataclass(frozen=True)
class Magnet:
    """Source model of a small magnet: one dipole that moves and rotates.

    State (12): position r [m], velocity v [m/s], moment m [A m²], angular velocity w [rad/s], all
    in the world frame. The moment rotates with w. The roll about m is not observable. PHD15 Paper A
    section 3.1 and eq. (19)-(24).
    """

    acceleration_density: FloatArray
    """Power spectral density of the acceleration, (3,) m²/s³."""
    angular_density: float
    """Power spectral density of the angular acceleration, rad²/s³."""

    state_names = ('x', 'y', 'z', 'vx', 'vy', 'vz', 'mx', 'my', 'mz', 'wx', 'wy', 'wz')

    def dipoles(self, x: FloatArray) -> Dipoles:
        """Compute the dipole of each target state (n_hyp, 12)."""
        dr_dx = np.zeros((len(x), 1, 3, 12))
        dr_dx[:, 0, [0, 1, 2], [0, 1, 2]] = 1.0
        dm_dx = np.zeros((len(x), 1, 3, 12))
        dm_dx[:, 0, [0, 1, 2], [6, 7, 8]] = 1.0
        return Dipoles(x[:, None, :3].copy(), x[:, None, 6:9].copy(), dr_dx, dm_dx)

    def propagate(self, x: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """Predict target states at constant velocity and constant angular velocity.

        The moment is rotated by the full angle w dt: the first-order m + dt (w x m) of PHD15 Paper
        A eq. (24) lengthens it by half the squared angle in each step, and a filter with a known
        moment magnitude would overestimate the distance.
        """
        n, rotation_vector = len(x), dt * x[:, 9:12]
        R = geometry.rotation_from_quaternion(
            geometry.quaternion_from_rotation_vector(rotation_vector))
        predicted = x.copy()
        predicted[:, :3] += dt * x[:, 3:6]
        predicted[:, 6:9] = np.einsum('nij,nj->ni', R, x[:, 6:9])
        F = np.tile(np.eye(12), (n, 1, 1))
        F[:, :6, :6] = constant_velocity(dt)
        F[:, 6:9, 6:9] = R
        F[:, 6:9, 9:12] = -dt * geometry.cross_matrix(predicted[:, 6:9]) \
            @ geometry.left_jacobian(rotation_vector)
        return predicted, F
