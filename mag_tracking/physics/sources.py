"""The targets: what a state means, how it moves, and which dipoles it is.

A source model turns a batch of target states into dipoles with derivatives;
the field at the sensors follows from `dipole.sensor_fields` alone, so that a
new target is one new class (here; vehicles in `vehicles.py`) and nothing elsewhere.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import (
    cross_matrix,
    left_jacobian,
    quaternion_from_rotation_vector,
    rotation_from_quaternion,
)
from mag_tracking.physics.motion import constant_velocity, integrator_noise


class Dipoles(NamedTuple):
    """Dipoles of every hypothesis, in the world, with derivatives by the target state."""

    r: FloatArray
    """(n_hyp, n_dipoles, 3) [m] positions."""
    m: FloatArray
    """(n_hyp, n_dipoles, 3) [A m^2] moments."""
    dr_dx: FloatArray
    """(n_hyp, n_dipoles, 3, n_t)."""
    dm_dx: FloatArray
    """(n_hyp, n_dipoles, 3, n_t)."""


class SourceModel(Protocol):
    """What the tracker asks of a target. States begin with position and velocity."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""

    def dipoles(self, x: FloatArray) -> Dipoles:
        """Dipoles of the target states `x` (n_hyp, n_t)."""

    def propagate(self, x: FloatArray, dt: float, P: FloatArray | None = None
                  ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States after `dt` seconds, Jacobian (..., n_t, n_t), process noise (..., n_t, n_t).

        With the states' covariances `P` (n_hyp, n_t, n_t) the noise holds what the
        Jacobian leaves out, too, and a state of zero variance may be taken for fixed.
        """


@dataclass(frozen=True)
class Magnet:
    """A small magnet: one dipole that moves and turns, five degrees of freedom.

    State (12): position r, velocity v, moment m (world), angular velocity w
    (world). The moment turns with w; the roll about m cannot be observed.

    Source: PHD15 Paper A section 3.1 and eq. (19)-(24).
    """

    acceleration_density: FloatArray
    """(3,) [m^2/s^3], spectral density of the acceleration."""
    angular_density: float
    """[rad^2/s^3], spectral density of the angular acceleration."""

    state_names = ('x', 'y', 'z', 'vx', 'vy', 'vz', 'mx', 'my', 'mz', 'wx', 'wy', 'wz')

    def dipoles(self, x: FloatArray) -> Dipoles:
        """One dipole a hypothesis; see `SourceModel.dipoles`."""
        dr_dx = np.zeros((len(x), 1, 3, 12))
        dr_dx[:, 0, [0, 1, 2], [0, 1, 2]] = 1.0
        dm_dx = np.zeros((len(x), 1, 3, 12))
        dm_dx[:, 0, [0, 1, 2], [6, 7, 8]] = 1.0
        return Dipoles(x[:, None, :3].copy(), x[:, None, 6:9].copy(), dr_dx, dm_dx)

    def propagate(self, x: FloatArray, dt: float, P: FloatArray | None = None
                  ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Constant velocity and angular velocity; see `SourceModel.propagate`.

        The moment is turned by the whole angle w dt. Eq. (24) holds it constant
        over the interval, m + dt (w x m): each step makes it longer by half the
        square of the angle, and a filter that knows the size of its magnet
        then moves the magnet away to make up for it.
        Its noise is that of the double integrator, mapped by w -> w x m, and with
        `P` that of the second order (`_shortening`).
        """
        n, angle = len(x), dt * x[:, 9:12]
        R = rotation_from_quaternion(quaternion_from_rotation_vector(angle))
        moved = x.copy()
        moved[:, :3] += dt * x[:, 3:6]
        moved[:, 6:9] = np.einsum('nij,nj->ni', R, x[:, 6:9])
        C = -cross_matrix(moved[:, 6:9])
        F = np.tile(np.eye(12), (n, 1, 1))
        F[:, :6, :6] = constant_velocity(dt)
        F[:, 6:9, 6:9] = R
        F[:, 6:9, 9:12] = dt * C @ left_jacobian(angle)
        G = np.zeros((n, 6, 6))
        G[:, :3, :3] = C
        G[:, 3:, 3:] = np.eye(3)
        Q = np.zeros((n, 12, 12))
        Q[:, :6, :6] = integrator_noise(dt, self.acceleration_density)
        Q[:, 6:, 6:] = (G @ integrator_noise(dt, np.full(3, self.angular_density))
                        @ np.swapaxes(G, 1, 2))
        if P is not None:
            # What is not known of the moment itself is turned exactly: the turn's share counts.
            before = R @ P[:, 6:9, 6:9] @ np.swapaxes(R, 1, 2)
            after = F[:, 6:9] @ P @ np.swapaxes(F[:, 6:9], 1, 2) + Q[:, 6:9, 6:9]
            Q[:, 6:9, 6:9] += _second_order_noise(moved[:, 6:9], before, after)
        return moved, F, Q


def _second_order_noise(m: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Second moment (n, 3, 3), along m, of what a turn by an uncertain angle takes from m.

    A moment `m` (n, 3) that is turned by a small (a, b) across itself ends
    (a^2 + b^2)/2 |m| short of the plane in which the Jacobian moves it. With the
    variances p, q of a, b that has the second moment (3 p^2 + 3 q^2 + 2 p q)/4
    |m|^2. Counted is what the covariance `after` (n, 3, 3) of the turned moment has
    more of it than the one `before`, and never more than |m|^2.
    """
    size2 = np.einsum('ni,ni->n', m, m)
    along = np.einsum('ni,nj->nij', m, m)
    # A moment of zero cannot be turned: `along` is zero, and so is the result.
    size2 = np.where(size2 > 0.0, size2, 1.0)
    across = np.eye(3) - along / size2[:, None, None]

    def second_moment(P: FloatArray) -> FloatArray:
        S = across @ P @ across / size2[:, None, None]
        # Of the two variances only their sum and the sum of their squares are needed.
        moment: FloatArray = 0.25 * (2.0 * np.einsum('nij,nji->n', S, S)
                                     + np.trace(S, axis1=1, axis2=2) ** 2)
        return moment

    more = np.clip(second_moment(after) - second_moment(before), 0.0, 1.0)
    taken: FloatArray = more[:, None, None] * along
    return taken
