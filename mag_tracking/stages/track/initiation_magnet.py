"""Initiation of a magnet's track: settings, model and first hypotheses."""

from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.least_squares import project_out_linear, refine
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import dipole_jacobians, sensor_fields
from mag_tracking.records import FieldFrame
from mag_tracking.settings import param

START_MARGIN = 0.15
"""[m] Margin around the bounding box of the sensors within which the magnet may first appear."""
GRID_POINTS, MAX_STARTS = 4000, 24
"""Number of points of the coarse grid over that region, and of the best ones that are refined."""
NEAR_FIELD_LENGTH = 5e-4
"""[m] Near-field length of a magnet (lambda in [ICASSP11]_ eq. (9))."""


@dataclass(frozen=True)
class MagnetSettings:
    """Motion of the magnet, and the region in which it may appear."""

    speed_std: float = param(0.05, 'Standard deviation of the initial velocity, per axis.', 'm/s',
                             (1e-9, 100.0))
    spin_std: float = param(0.5, 'Standard deviation of the initial angular velocity, per axis.',
                            'rad/s', (1e-9, 1000.0))
    acceleration: float = param(
        0.02, 'Root spectral density of the acceleration.', 'm/s^1.5', (0.0, 1000.0))
    angular_acceleration: float = param(
        0.2, 'Root spectral density of the angular acceleration.', 'rad/s^1.5', (0.0, 1000.0))
    axis: tuple[float, ...] = param(
        (0.0, 0.0, 1.0), 'Direction of the moment in the frame of the magnet.',
        '', (-1.0, 1.0), length=3)


def is_lost_after(settings: MagnetSettings, network: SensorNetwork, dt: float) -> bool:
    """Whether a magnet may have moved anywhere near the sensors in a gap of `dt` seconds."""
    std = settings.acceleration * np.sqrt(dt**3 / 3.0)
    extent = np.ptp(network.positions, axis=0).max()
    return bool(std > 2.0 * START_MARGIN + extent)


def start_magnet(settings: MagnetSettings, network: SensorNetwork, frame: FieldFrame,
                 background_std: float, own_covariance: FloatArray, relative_std: float
                 ) -> FilterBank | None:
    """Hypotheses of a magnet at its first frame, at any position near the sensors ([PHD15]_ Paper A
    eq. (3)); None if the frame has fewer than six axes or no fit has a finite cost.

    The moment is projected out at each point of a coarse grid, and each distinct optimum becomes a
    hypothesis. The covariances are as for `start_vehicle`; `relative_std` is the relative model
    error.
    """
    is_present = ~np.isnan(frame.field)
    if np.count_nonzero(is_present) < 6:
        return None
    magnitude = np.sqrt(np.nansum(frame.field**2, axis=1))
    std = np.sqrt(np.einsum('jii->ji', frame.covariance) + background_std**2
                  + (relative_std * magnitude[:, None]) ** 2)
    y = (frame.field / std)[is_present]
    grid = _start_grid(network)
    # The Jacobian with respect to the moment does not depend on the moment.
    dB_dm = dipole_jacobians(network.positions[None] - grid[:, None], np.zeros(3))[1]
    A = np.einsum('jik,gjkl->gjil', network.R_sw, dB_dm) / std[:, :, None]
    A = A[:, is_present]
    is_usable = np.isfinite(A).all(axis=(1, 2))
    moments, residual, _ = project_out_linear(A[is_usable], y)
    cost = np.einsum('gy,gy->g', residual, residual)
    best = np.argsort(cost, kind='stable')[:MAX_STARTS]
    start = np.hstack([grid[is_usable][best], moments[best]])
    state, P, cost = _distinct_optima(settings, network, start, y, std, is_present)
    if not len(cost):
        return None
    bank = FilterBank.from_targets(state, P, np.zeros(len(cost), dtype=int), len(network),
                                   background_std, own_covariance)
    bank.reweight(-0.5 * cost)
    return bank


def _start_grid(network: SensorNetwork) -> FloatArray:
    """Grid (n, 3) [m] over the box of the sensors with its margin; one point on a short side."""
    low, high = network.positions.min(axis=0), network.positions.max(axis=0)
    extent, step, is_long = high - low + 2.0 * START_MARGIN, 0.0, np.full(3, True)
    while (extent[is_long] <= step / 2).any() or not step:
        is_long &= extent > step / 2
        step = float((np.prod(extent[is_long]) / GRID_POINTS) ** (1.0 / is_long.sum()))
    axes = [np.arange(a - START_MARGIN + step / 2, b + START_MARGIN, step)
            if long else np.array([(a + b) / 2])
            for a, b, long in zip(low, high, is_long, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)


def _distinct_optima(settings: MagnetSettings, network: SensorNetwork, start: FloatArray,
                     y: FloatArray, std: FloatArray, is_present: BoolArray
                     ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Refine `start`; return states (n, 12), covariances and costs of distinct optima."""
    zero = np.zeros((len(start), 1, 3, 6))
    dr_dx, dm_dx = zero.copy(), zero.copy()
    dr_dx[:, 0, :, :3] = np.eye(3)
    dm_dx[:, 0, :, 3:] = np.eye(3)

    def residual_and_jacobian(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        h, H, _ = sensor_fields(network.positions, network.R_sw,
                                np.ascontiguousarray(x[:, None, :3]),
                                np.ascontiguousarray(x[:, None, 3:]), dr_dx[:len(x)],
                                dm_dx[:len(x)])
        return y - (h / std)[:, is_present], (H / std[:, :, None])[:, is_present]

    x, cost, covariance, _ = refine(residual_and_jacobian, start)
    selected: list[int] = []
    for i in np.argsort(cost, kind='stable'):
        if not np.isfinite(cost[i]) or cost[i] - cost.min() > 60.0:
            break
        is_distinct = [np.linalg.norm(x[i, :3] - x[k, :3])
                       > 3.0 * np.sqrt(np.trace(covariance[k][:3, :3])) for k in selected]
        if all(is_distinct):
            selected.append(i)
    n = len(selected)
    state = np.zeros((n, 12))
    state[:, :3], state[:, 6:9] = x[selected, :3], x[selected, 3:]
    P = np.zeros((n, 12, 12))
    rm = np.r_[0:3, 6:9]
    # Residuals larger than the noise widen the covariance.
    excess = np.maximum(1.0, cost[selected] / max(1, len(y) - 6))
    P[np.ix_(range(n), rm, rm)] = covariance[selected] * excess[:, None, None]
    P[:, [3, 4, 5], [3, 4, 5]] = settings.speed_std**2
    P[:, [9, 10, 11], [9, 10, 11]] = settings.spin_std**2
    return state, P, cost[selected]
