"""Position and direction of a magnet of known moment from one reading of a calibrated network."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.least_squares import ResidualAndJacobian, project_out_linear, refine
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import dipole_jacobians, sensor_fields

N_UNKNOWNS = 5
"""Number of unknowns of a pose; the roll of a dipole is not observable."""
N_GRID, N_STARTS, MAX_STEPS = 7, 8, 60
"""Grid points per axis of the search box, number of the best ones to refine, maximum steps."""
EXACT_COST = 1e-9
"""Maximum sum of squared residuals of exact readings, which rounding keeps above zero."""
MAX_COST = 100.0
"""Maximum normalised cost; a larger cost means that the readings do not fit the dipole."""


@dataclass(frozen=True)
class MagnetPose:
    """Position and direction of a magnet; valid only if `reason` is empty."""

    position: FloatArray
    """(3,) [m], world."""
    axis: FloatArray
    """(3,) unit vector, world: direction of the moment."""
    covariance: FloatArray
    """(6, 6) of position and axis, singular along the axis; scaled by a cost above one."""
    normalised_cost: float
    """Cost per degree of freedom; about one if moment, noise and field error are correct."""
    reason: str
    """Reason why the pose is not valid; empty if it is valid."""

    @property
    def converged(self) -> bool:
        """Whether the pose is valid."""
        return not self.reason


def locate_magnet(network: SensorNetwork, field: FloatArray, moment: float, low: ArrayLike,
                  high: ArrayLike, field_error: float, ambient_std: float) -> MagnetPose:
    """Estimate the pose of a dipole of known moment from one reading of all sensors.

    The best points of a grid in the box between the corners `low` and `high` (3,) [m, world frame]
    are refined. `field` (n, 3) [T, sensor frame] is corrected for bias and gain; NaN if not
    measured. `field_error` is that of sensors and dipole model relative to the field, `ambient_std`
    [T] per axis that of the ambient field, which is the same at all sensors. Raises ValueError for
    an invalid reading, moment or box, or a sensor without `noise_std`. PHD15 Paper A eq. (3).
    """
    field, low, high = (np.asarray(a, dtype=float) for a in (field, low, high))
    if not (np.isfinite(high - low).all() and (high > low).all()):
        raise ValueError(f'the box from {low.tolist()} to {high.tolist()} m has no volume')
    check_moment_and_noise(network, field, moment)
    is_measured = ~np.isnan(field)
    n_values = int(np.count_nonzero(is_measured))
    if n_values <= N_UNKNOWNS:
        nan_vector = np.full(3, np.nan)
        return MagnetPose(nan_vector, nan_vector, np.full((6, 6), np.nan), np.nan,
                          f'number of measured axes is {n_values}; more than {N_UNKNOWNS} are '
                          'required')
    squared_norm = np.nansum(np.square(field), axis=1)[:, None]
    std = np.sqrt(np.square(np.array(network.noise_std)) + field_error**2 * squared_norm)
    problem = _residual_function(network, field, std, is_measured, moment, ambient_std)
    starts = _starting_states(network, field, std, is_measured, low, high)
    x, cost, covariance, converged = refine(problem, starts, MAX_STEPS, 1e-9)
    best = int(np.argmin(cost))
    return _pose_of_minimum(x[best], covariance[best], cost[best] / (n_values - N_UNKNOWNS),
                            converged[best] or cost[best] < EXACT_COST, low, high)


def _residual_function(network: SensorNetwork, field: FloatArray, std: FloatArray,
                       is_measured: BoolArray, moment: float,
                       ambient_std: float) -> ResidualAndJacobian:
    """Create the residual function of x = [position, axis (not normalised), ambient field in units
    of `ambient_std` (T)]."""
    y = (field / std)[is_measured]
    ambient_jacobian = (network.R_sw * ambient_std / std[:, :, None])[is_measured]
    prior = np.hstack([np.zeros((3, 6)), np.eye(3)])

    def residual_and_jacobian(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        length = np.linalg.norm(x[:, 3:6], axis=1)[:, None]
        u = x[:, 3:6] / length
        dr_dx, dm_dx = np.zeros((2, len(x), 1, 3, 6))
        dr_dx[:, 0, :, :3] = np.eye(3)
        dm_dx[:, 0, :, 3:] = moment * (np.eye(3) - u[:, :, None] * u[:, None]) / length[:, None]
        h, H, _ = sensor_fields(network.positions, network.R_sw,
                                np.ascontiguousarray(x[:, None, :3]), moment * u[:, None], dr_dx,
                                dm_dx)
        e = y - (h / std)[:, is_measured] - x[:, 6:] @ ambient_jacobian.T
        J = np.concatenate([(H / std[:, :, None])[:, is_measured],
                            np.broadcast_to(ambient_jacobian, (len(x), *ambient_jacobian.shape))],
                           axis=2)
        return (np.hstack([e, -x[:, 6:]]),
                np.concatenate([J, np.broadcast_to(prior, (len(x), 3, 9))], axis=1))

    return residual_and_jacobian


def _starting_states(network: SensorNetwork, field: FloatArray, std: FloatArray,
                     is_measured: BoolArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Best states (k, 9) on a grid of positions, each with its best-fitting moment direction."""
    axes = [np.linspace(a, b, N_GRID + 2)[1:-1] for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    # The Jacobian with respect to the moment does not depend on the moment.
    dB_dm = dipole_jacobians(network.positions - grid[:, None], np.zeros(3))[1]
    A = (network.R_sw @ dB_dm / std[:, :, None])[:, is_measured]
    is_finite = np.isfinite(A).all(axis=(1, 2))
    m, residual, _ = project_out_linear(A[is_finite], (field / std)[is_measured])
    best = np.argsort(np.einsum('gy,gy->g', residual, residual), kind='stable')[:N_STARTS]
    m = m[best] / np.linalg.norm(m[best], axis=1)[:, None]
    return np.hstack([grid[is_finite][best], m, np.zeros((len(m), 3))])


def _pose_of_minimum(x: FloatArray, covariance: FloatArray, cost: float, converged: bool,
                     low: FloatArray, high: FloatArray) -> MagnetPose:
    """Convert a minimum `x` (9,) to a `MagnetPose`, with a reason if it is not valid."""
    length = np.linalg.norm(x[3:6])
    u = x[3:6] / length
    T = np.zeros((6, 9))
    T[:3, :3] = np.eye(3)
    T[3:, 3:6] = (np.eye(3) - np.outer(u, u)) / length
    if not (np.isfinite(cost) and converged):
        reason = f'no minimum found (maximum number of steps: {MAX_STEPS})'
    elif not cost <= MAX_COST:
        reason = ('the readings do not fit one dipole of this moment: the normalised cost is '
                  f'{cost:.0f}')
    elif not ((low <= x[:3]) & (x[:3] <= high)).all():
        reason = f'the magnet is outside the box: {x[:3].tolist()} m'
    else:
        reason = ''
    return MagnetPose(x[:3], u, max(1.0, cost) * T @ covariance @ T.T, float(cost), reason)


def check_moment_and_noise(network: SensorNetwork, field: FloatArray, moment: float) -> None:
    """Raise ValueError for an invalid moment, an infinite reading or a sensor without noise."""
    if not (np.isfinite(moment) and moment > 0.0):
        raise ValueError(f'moment is {moment} A m^2; it must be finite and above 0')
    if np.isinf(field).any():
        raise ValueError('field contains an infinite reading')
    for name, std in zip(network.names, network.noise_std, strict=True):
        if std is None or not (np.asarray(std) > 0.0).all():
            raise ValueError(f'sensor {name}: noise_std is {std}; it must be above 0 T')
