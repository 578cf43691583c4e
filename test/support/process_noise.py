"""Process noise of the source models in NumPy, as an oracle for `physics/targets.hpp`."""

import math

import numpy as np

from mag_tracking.geometry import cross_matrix
from mag_tracking.physics.sources import Magnet, integrator_noise


def predicted(model, x, dt, P=None):
    """`SourceModel.propagate`, and the covariance Q (n_hyp, n_t, n_t) of the process noise.

    With the covariances `P` (n_hyp, n_t, n_t) of `x`, Q includes the second-order terms that the
    Jacobian neglects, and a turn rate of zero variance remains constant.
    """
    moved, F = model.propagate(x, dt)
    noise = magnet_noise if isinstance(model, Magnet) else vehicle_noise
    return moved, F, noise(model, x, dt, P, moved, F)


def magnet_noise(model, x, dt, P, moved, F):
    """Noise of a double integrator, mapped to the moment by w -> w x m."""
    n, C = len(x), -cross_matrix(moved[:, 6:9])
    G = np.zeros((n, 6, 6))
    G[:, :3, :3] = C
    G[:, 3:, 3:] = np.eye(3)
    Q = np.zeros((n, 12, 12))
    Q[:, :6, :6] = integrator_noise(dt, model.acceleration_density)
    Q[:, 6:, 6:] = (G @ integrator_noise(dt, np.full(3, model.angular_density))
                    @ np.swapaxes(G, 1, 2))
    if P is not None:
        # The uncertainty of the moment is rotated exactly. Only the increase due to the uncertain
        # rotation is added.
        R = F[:, 6:9, 6:9]
        P_before = R @ P[:, 6:9, 6:9] @ np.swapaxes(R, 1, 2)
        P_after = F[:, 6:9] @ P @ np.swapaxes(F[:, 6:9], 1, 2) + Q[:, 6:9, 6:9]
        Q[:, 6:9, 6:9] += second_order_noise(moved[:, 6:9], P_before, P_after)
    return Q


def second_order_noise(m, P_before, P_after):
    """Process noise (n, 3, 3) due to the shortening of the moment m by an uncertain rotation.

    A rotation by small angles (a, b) about axes perpendicular to `m` (n, 3) shortens the component
    along m by (a^2 + b^2)/2 |m|, which the Jacobian neglects. With variances p, q of a, b, its
    second moment is (3 p^2 + 3 q^2 + 2 p q)/4 |m|^2. The noise is along m; its variance is the
    increase of this moment from `P_before` to `P_after` (n, 3, 3), at most |m|^2.
    """
    squared_norm = np.einsum('ni,ni->n', m, m)
    outer_product = np.einsum('ni,nj->nij', m, m)
    # The result for a zero moment is zero because `outer_product` is zero.
    squared_norm = np.where(squared_norm > 0.0, squared_norm, 1.0)
    normal_projection = np.eye(3) - outer_product / squared_norm[:, None, None]

    def second_moment(P):
        S = normal_projection @ P @ normal_projection / squared_norm[:, None, None]
        # The sum of the two variances and the sum of their squares are sufficient.
        return 0.25 * (2.0 * np.einsum('nij,nji->n', S, S) + np.trace(S, axis1=1, axis2=2) ** 2)

    increase = np.clip(second_moment(P_after) - second_moment(P_before), 0.0, 1.0)
    return increase[:, None, None] * outer_product


def vehicle_noise(model, x, dt, P, moved, F):
    """Noise of position and velocity, random walks of the hard iron moments, and turn rate.

    The effect of the turn rate noise on position and velocity is neglected.
    """
    d, soft = model.n_dipoles, 6 + 3 * model.n_dipoles
    averaging = np.full((d, d), 1.0 / d)
    walk = np.kron(model.moment_drift**2 / d * averaging
                   + model.difference_drift**2 * (np.eye(d) - averaging), np.eye(3))
    Q = np.zeros((len(x), x.shape[1], x.shape[1]))
    Q[:, :6, :6] = integrator_noise(dt, model.acceleration_density)
    hard = x[:, 6:soft].reshape(len(x), d, 3).sum(axis=1)
    induced2 = x[:, soft:soft + 3]**2 * (model.field_strength @ model.field_strength) / 3.0
    # The random walk is relative to the magnitude of the hard and soft iron moments.
    Q[:, 6:soft, 6:soft] = abs(dt) * walk * (hard**2 + induced2).sum(axis=1)[:, None, None]
    if model.turn_acceleration:
        final_factor = math.exp(-max(dt, 0.0) / model.turn_time)
        is_turning = np.ones(len(x)) if P is None else P[:, -1, -1] > 0.0
        Q[:, -1, -1] = is_turning * (1.0 - final_factor**2) * model.turn_variance(
            np.hypot(x[:, 3], x[:, 4]))
    return Q
