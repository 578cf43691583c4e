"""Where a magnet of known moment is, from one reading of a calibrated network."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.least_squares import project_out_linear, refine
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import dipole_jacobians, sensor_fields
from mag_tracking.settings import param

UNKNOWNS = 5
"""Of a pose: a dipole has no roll."""

NOTHING = 1e-9
"""A sum of squares below is that of exact readings: no step makes it smaller by a share."""

MAX_COST = 100.0
"""A normalised cost beyond is none of one dipole of that moment."""

_Problem: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Of points (n, 9) the residuals (n, n_y) and their Jacobians (n, n_y, 9)."""


@dataclass(frozen=True)
class PoseSettings:
    """How a magnet is looked for, and what its readings err by."""

    field_error: float = param(
        0.01, 'What sensors and dipole err by, relative to the field.', '', (0.0, 1.0))
    ambient_std: float = param(
        1e-7, 'Of the change of the ambient field since the biases were found, per axis, alike '
        'everywhere.', 'T', (1e-15, 1e-3))
    grid_points: int = param(343, 'Points of the coarse grid over the box.', '', (8, 1_000_000))
    starts: int = param(8, 'Best points of the grid that are refined.', '', (1, 1000))
    iterations: int = param(60, 'No more steps than these.', '', (1, 10000))


@dataclass(frozen=True)
class MagnetPose:
    """A magnet's place and direction; where `reason` is not empty they are not to be used."""

    position: FloatArray
    """(3,) [m], world."""
    axis: FloatArray
    """(3,) unit vector, world: the moment's direction."""
    covariance: FloatArray
    """(6, 6) of both, singular along the axis; made larger where the fit is worse than stated."""
    ambient: FloatArray
    """(3,) [T], world: change of the ambient field."""
    normalised_cost: float
    """About one where moment, noise and field error are right."""
    converged: bool
    reason: str


def locate_magnet(network: SensorNetwork, field: FloatArray, moment: float, low: ArrayLike,
                  high: ArrayLike, settings: PoseSettings) -> MagnetPose:
    """Pose of a dipole of known moment from one reading of all sensors.

    Parameters
    ----------
    network : SensorNetwork
        With the `noise_std` of every sensor.
    field : (n, 3) [T], sensor frame
        Without biases, gains put right (`NetworkGeometry.signal`); NaN = not measured.
    moment : float [A m^2]
    low, high : (3,) [m], world
        Corners of the box in which it is looked for.
    settings : PoseSettings

    Returns
    -------
    MagnetPose
        All NaN where too few axes were measured.

    Raises
    ------
    ValueError
        Shapes that do not fit, a moment or a box of no size, a sensor without noise.

    Source: PHD15 Paper A eq. (3); the best of several starts, by Levenberg and Marquardt.
    """
    field, low, high = (np.asarray(a, dtype=float) for a in (field, low, high))
    _check(network, field, moment, low, high)
    present = ~np.isnan(field)
    n_values = int(np.count_nonzero(present))
    if n_values <= UNKNOWNS:
        nothing = np.full(3, np.nan)
        return MagnetPose(nothing, nothing, np.full((6, 6), np.nan), nothing, np.nan, False,
                          f'{n_values} axes measured, more than {UNKNOWNS} are needed')
    size2 = np.nansum(np.square(field), axis=1)[:, None]
    std = np.sqrt(np.square(np.array(network.noise_std)) + settings.field_error**2 * size2)
    problem = _problem(network, field, std, present, moment, settings.ambient_std)
    starts = _starts(network, field, std, present, low, high, settings)
    x, cost, covariance, converged = refine(problem, starts, settings.iterations, 1e-9)
    best = int(np.argmin(cost))
    return _pose(x[best], covariance[best], cost[best] / (n_values - UNKNOWNS),
                 converged[best] or cost[best] < NOTHING, low, high, settings)


def _problem(network: SensorNetwork, field: FloatArray, std: FloatArray, present: BoolArray,
             moment: float, ambient_std: float) -> _Problem:
    """Residuals and Jacobians of x = place, direction of any length, ambient field in its std."""
    y = (field / std)[present]
    uniform = (network.R_sw * ambient_std / std[:, :, None])[present]
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
        e = y - (h / std)[:, present] - x[:, 6:] @ uniform.T
        J = np.concatenate([(H / std[:, :, None])[:, present],
                            np.broadcast_to(uniform, (len(x), *uniform.shape))], axis=2)
        return (np.hstack([e, -x[:, 6:]]),
                np.concatenate([J, np.broadcast_to(prior, (len(x), 3, 9))], axis=1))

    return residual_and_jacobian


def _starts(network: SensorNetwork, field: FloatArray, std: FloatArray, present: BoolArray,
            low: FloatArray, high: FloatArray, settings: PoseSettings) -> FloatArray:
    """Best points (k, 9) of a grid, each with the direction of the moment that fits it best."""
    per_axis = max(2, int(round(settings.grid_points ** (1.0 / 3.0))))
    axes = [np.linspace(a, b, per_axis + 2)[1:-1] for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    # Only the moment's Jacobian is wanted: it does not depend on the moment.
    dB_dm = dipole_jacobians(network.positions - grid[:, None], np.zeros(3))[1]
    A = (network.R_sw @ dB_dm / std[:, :, None])[:, present]
    usable = np.isfinite(A).all(axis=(1, 2))
    m, residual, _ = project_out_linear(A[usable], (field / std)[present])
    best = np.argsort(np.einsum('gy,gy->g', residual, residual), kind='stable')[:settings.starts]
    m = m[best] / np.linalg.norm(m[best], axis=1)[:, None]
    return np.hstack([grid[usable][best], m, np.zeros((len(m), 3))])


def _pose(x: FloatArray, covariance: FloatArray, cost: float, converged: bool, low: FloatArray,
          high: FloatArray, settings: PoseSettings) -> MagnetPose:
    """The `MagnetPose` of a minimum."""
    length = np.linalg.norm(x[3:6])
    u = x[3:6] / length
    T = np.zeros((6, 9))
    T[:3, :3] = np.eye(3)
    T[3:, 3:6] = (np.eye(3) - np.outer(u, u)) / length
    if not (np.isfinite(cost) and converged):
        reason = f'no minimum within {settings.iterations} steps'
    elif not cost <= MAX_COST:
        reason = f'not one dipole of that moment: the normalised cost is {cost:.0f}'
    elif not ((low <= x[:3]) & (x[:3] <= high)).all():
        reason = f'outside the box: {x[:3].tolist()} m'
    else:
        reason = ''
    return MagnetPose(x[:3], u, max(1.0, cost) * T @ covariance @ T.T,
                      settings.ambient_std * x[6:], float(cost), not reason, reason)


def _check(network: SensorNetwork, field: FloatArray, moment: float, low: FloatArray,
           high: FloatArray) -> None:
    """Raise ValueError for what cannot be used."""
    if field.shape != (len(network), 3) or low.shape != (3,) or high.shape != (3,):
        raise ValueError(f'expected field ({len(network)}, 3) and corners (3,), got '
                         f'{field.shape}, {low.shape}, {high.shape}')
    if not (np.isfinite(moment) and moment > 0.0):
        raise ValueError(f'moment is {moment}, expected it above 0 A m^2')
    if not (np.isfinite(high - low).all() and (high > low).all()):
        raise ValueError(f'the box from {low.tolist()} to {high.tolist()} m has no size')
    if np.isinf(field).any():
        raise ValueError('a reading is infinite')
    for name, std in zip(network.names, network.noise_std, strict=True):
        if std is None or not (np.asarray(std) > 0.0).all():
            raise ValueError(f'sensor {name}: noise_std is {std}, expected it above 0 T')
