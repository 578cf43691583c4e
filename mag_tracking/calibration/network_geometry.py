"""Calibration of the geometry of a network from readings of a magnet at many poses.

Positions, orientations, gains and biases of fixed sensors are estimated by maximum a posteriori.
Additional unknowns are the alignment between board, tracker and tool or, without a tracker, the
poses of the magnet. PHD15 Paper A suggests such a calibration as future work.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.calibration import magnet_pose
from mag_tracking.calibration.network_fit import (
    N_POSE,
    N_SENSOR,
    N_SHARED,
    GeometryProblem,
    GeometrySettings,
    NormalEquations,
    Prediction,
    TrackedMagnet,
    Unknowns,
    median_ratio,
    rotation,
    solve,
)
from mag_tracking.network import SensorNetwork

COARSE_ERROR = 0.1
"""Assumed error relative to the field in the first stage, while the poses are inaccurate."""
COARSE_AMBIENT_STD = 1e-6
"""[T] Assumed change of the ambient field in the search for the initial poses."""


@dataclass(frozen=True)
class NetworkGeometry:
    """Result of a geometry calibration, with posterior stds; valid only if `reason` is empty."""

    network: SensorNetwork
    """Network with corrected positions and orientations, and with the biases as background."""
    position_std: FloatArray
    """(n, 3) [m], world frame."""
    rotation_std: FloatArray
    """(n, 3) [rad], about the axes of the sensor."""
    gain: FloatArray
    """(n,) gain; one is nominal."""
    gain_std: FloatArray
    bias: FloatArray
    """(n, 3) [T] biases, sensor frame; NaN for an axis without readings."""
    bias_std: FloatArray
    """(n, 3) [T]; infinite for an axis without readings."""
    magnet: TrackedMagnet
    """Tracked poses of the magnet, and its nominal moment."""
    rows: IntArray
    """(K,) indices of the fitted poses in the input."""
    shared: FloatArray
    """(12,) shared unknowns; see `TrackedMagnet.poses`."""
    shared_std: FloatArray
    pose: FloatArray
    """(K, 8) unknowns of each pose; see `TrackedMagnet.poses`."""
    pose_covariance: FloatArray
    """(K, 8, 8)."""
    covariance: FloatArray
    """(10 n + 12, 10 n + 12) of sensor unknowns (bias, gain, rotation, position) and `shared`."""
    normalised_cost: float
    """Cost per degree of freedom; about one if model, noise and field error are correct."""
    sensor_residual: FloatArray
    """(n,) RMS of the normalised residuals over the poses that fit; NaN without readings."""
    pose_residual: FloatArray
    """(K,) median of the sensor residuals of each pose, relative to the median for pure noise."""
    suspect_sensors: tuple[str, ...]
    """Names of the sensors with large residuals or corrections."""
    suspect_poses: tuple[int, ...]
    """Indices of the poses with large residuals or corrections."""
    reason: str
    """Reason why the calibration is not valid; empty if it is valid."""

    @property
    def converged(self) -> bool:
        """Whether the calibration is valid."""
        return not self.reason

    @property
    def moment(self) -> tuple[float, float]:
        """Moment of the magnet and its standard deviation [A m²]."""
        moment = self.magnet.moment * np.exp(self.shared[11])
        return moment, moment * self.shared_std[11]

    @property
    def tool_offset(self) -> tuple[FloatArray, FloatArray]:
        """Offset of the magnet from the tracked point and its stds, (3,) m each, tool frame."""
        return self.shared[6:9], self.shared_std[6:9]

    @property
    def tool_tilt(self) -> tuple[FloatArray, FloatArray]:
        """Slopes x/z and y/z of the moment and their stds, (2,) each, tool frame."""
        return self.shared[9:11], self.shared_std[9:11]

    @property
    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Estimated poses of the magnet: positions (K, 3) m and unit axes (K, 3), world frame."""
        return self.magnet.positions_and_axes(self.shared, self.pose)


MIN_POSES = 3
"""Minimum number of poses that separates the bias of a sensor from the field of the magnet."""
MIN_POSE_VARIATION = 0.1
"""Minimum variation of the axis [rad], or of the position relative to the distance of the nearest
sensor, of poses that determine the geometry."""
MAX_CORRECTION, MAX_RESIDUAL_RATIO = 4.0, 3.0
"""Maximum correction in prior standard deviations, and residual relative to the median, of a sensor
or pose that is not suspect."""
MAX_COST = 100.0
"""Maximum normalised cost; a larger cost means that the readings do not fit the model."""


def calibrate_geometry(network: SensorNetwork, field: FloatArray, positions: FloatArray,
                       axes: FloatArray, moment: float,
                       settings: GeometrySettings) -> NetworkGeometry:
    """Estimate the geometry of a network from readings of a tracked magnet.

    The posterior is maximised by the Levenberg-Marquardt method with robust weights. A rotation of
    the board has the same effect as a rotation of all sensors; the priors resolve this ambiguity.
    PHD15 Paper A section 8 proposes such a calibration. Raises ValueError if a pose is invalid or
    at a sensor, a reading is infinite, a sensor has no `noise_std`, or the moment is not positive.

    `field` (K, n, 3) [T, sensor frame] contains the constant background; NaN if not measured.
    `positions` (K, 3) [m] are tracked points in a frame that differs from the world frame only by a
    shift and a rotation within the priors, `axes` (K, 3) the directions of the moment if the magnet
    is not tilted in the tool; `moment` [A m²] is nominal.
    """
    s, deg = settings, np.pi / 180.0
    shared_unit = np.concatenate([
        np.full(3, s.board_shift_std), np.full(3, s.board_rotation_std_deg * deg),
        np.full(3, s.tool_offset_std), np.full(2, s.tool_tilt_std_deg * deg), [s.moment_std]])
    pose_unit = np.repeat([s.tracker_position_std, s.tracker_tilt_std_deg * deg, s.ambient_std],
                          [3, 2, 3])
    return fitted_geometry(network, field, positions, axes, moment, settings, shared_unit,
                           pose_unit)


def fitted_geometry(network: SensorNetwork, field: FloatArray, positions: FloatArray,
                    axes: FloatArray, moment: float, settings: GeometrySettings,
                    shared_unit: FloatArray, pose_unit: FloatArray) -> NetworkGeometry:
    """`calibrate_geometry` with the prior stds `shared_unit` (12,) and `pose_unit` (8,), in the
    order of `TrackedMagnet.poses`; zero fixes an unknown."""
    field, positions, axes = (np.asarray(a, dtype=float) for a in (field, positions, axes))
    _check_input(network, field, positions, axes, moment)
    problem = GeometryProblem(network, field, positions, axes, moment, settings, shared_unit,
                              pose_unit)
    x, (W, prior_weights, scale, robust_weights), predicted, converged = solve(
        problem, settings.iterations)
    cost = _normalised_cost(problem, x, predicted, W, robust_weights, prior_weights)
    # Scale up only the noise of the readings, not the priors.
    noise_scale = max(1.0, cost / scale)
    P, P_pose = NormalEquations(problem, x, predicted, W / noise_scale, prior_weights).covariance()
    n = len(network)
    unit = np.append(problem.sensor_unit.ravel(), problem.shared_unit)
    covariance = P * unit[:, None] * unit
    std = np.sqrt(np.diagonal(covariance))
    sensor_std, shared_std = std[:-N_SHARED].reshape(n, N_SENSOR), std[-N_SHARED:]
    sensor, shared, pose = problem.in_si(x)
    corrections = rotation(sensor[:, 4:7])
    sensor_residual, pose_residual = _sensor_and_pose_residuals(problem, predicted)
    suspect_sensors, suspect_poses = _suspects(problem, x, sensor_residual, pose_residual)
    return NetworkGeometry(
        network=replace(network, positions=network.positions + sensor[:, 7:],
                        R_ws=network.R_ws @ corrections, background=tuple(
                            b if h.all() else None
                            for b, h in zip(sensor[:, :3], problem.has_readings, strict=True))),
        position_std=sensor_std[:, 7:], rotation_std=sensor_std[:, 4:7],
        gain=1.0 + sensor[:, 3], gain_std=sensor_std[:, 3],
        bias=np.where(problem.has_readings, sensor[:, :3], np.nan),
        bias_std=np.where(problem.has_readings, sensor_std[:, :3], np.inf),
        magnet=problem.magnet, rows=np.arange(len(pose)), shared=shared,
        shared_std=shared_std, pose=pose,
        pose_covariance=P_pose * np.outer(problem.pose_unit, problem.pose_unit),
        covariance=covariance, normalised_cost=cost, sensor_residual=sensor_residual,
        pose_residual=pose_residual, suspect_sensors=suspect_sensors, suspect_poses=suspect_poses,
        reason=_failure_reason(problem, x, converged, cost))


def _normalised_cost(problem: GeometryProblem, x: Unknowns, predicted: Prediction, W: FloatArray,
                     robust_weights: FloatArray, prior_weights: Unknowns) -> float:
    """Weighted sum of squared residuals per degree of freedom; NaN below one degree of freedom."""
    P, P_pose = NormalEquations(problem, x, predicted, W, prior_weights).covariance()
    e2, count, _ = problem.squared_residuals(predicted[0], predicted[1])
    n_from_priors = np.append(prior_weights[0].ravel(), prior_weights[1]) @ np.diagonal(P)
    n_from_priors += np.einsum('ki,kii->', prior_weights[2], P_pose)
    n_unknowns = len(P) + N_POSE * len(P_pose) - n_from_priors
    dof = (robust_weights * count).sum() - n_unknowns
    return float((robust_weights[:, :, None] * e2).sum() / dof) if dof >= 1.0 else np.nan


def _sensor_and_pose_residuals(problem: GeometryProblem,
                               predicted: Prediction) -> tuple[FloatArray, FloatArray]:
    """Normalised residuals: RMS (n,) of each sensor over consistent poses, and median (K,) of each
    pose relative to the median for pure noise."""
    e2, count, _ = problem.squared_residuals(predicted[0], predicted[1])
    e2 = e2.sum(axis=2)
    pose_residual = np.sqrt([np.median(median_ratio(d2, c)[c > 0])
                             for d2, c in zip(e2.T, count.T, strict=True)])
    is_consistent = pose_residual <= MAX_RESIDUAL_RATIO * np.median(pose_residual)
    n_values = count[:, is_consistent].sum(axis=1)
    sensor_residual = np.sqrt(e2[:, is_consistent].sum(axis=1)
                              / np.where(n_values > 0, n_values, np.nan))
    return sensor_residual, pose_residual


def _suspects(problem: GeometryProblem, x: Unknowns, sensor_residual: FloatArray,
              pose_residual: FloatArray) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names of the suspect sensors and indices of the suspect poses."""
    is_suspect_sensor = sensor_residual > MAX_RESIDUAL_RATIO * np.nanmedian(sensor_residual)
    is_suspect_sensor |= (np.abs(x[0][:, 3:]) > MAX_CORRECTION).any(axis=1)
    is_suspect_pose = pose_residual > MAX_RESIDUAL_RATIO * np.median(pose_residual)
    is_suspect_pose |= (np.abs(x[2]) > MAX_CORRECTION).any(axis=1)
    return (tuple(problem.network.names[j] for j in np.flatnonzero(is_suspect_sensor)),
            tuple(int(k) for k in np.flatnonzero(is_suspect_pose)))


def _failure_reason(problem: GeometryProblem, x: Unknowns, converged: bool, cost: float) -> str:
    """Reason why the fit is not valid; empty if it is valid."""
    K = len(problem.magnet.tool)
    if K < MIN_POSES:
        return (f'number of poses is {K}; at least {MIN_POSES} are required to separate the '
                'biases from the field of the magnet')
    r, u = problem.magnet.positions_and_axes(*problem.in_si(x)[1:])
    nearest_distance = np.linalg.norm(problem.network.positions - r.mean(axis=0), axis=1).min()
    if (np.ptp(r, axis=0) < MIN_POSE_VARIATION * nearest_distance).all() \
            and (np.ptp(u, axis=0) < MIN_POSE_VARIATION).all():
        return 'the poses are almost equal: the geometry is not observable; move the magnet'
    if not converged:
        return f'no minimum found (maximum number of steps: {problem.settings.iterations})'
    if np.isnan(cost):
        return 'too few readings for the number of unknowns'
    return '' if not cost > MAX_COST else (
        f'the readings do not fit the model: the normalised cost is {cost:.0f}; check the poses, '
        'the moment, the network and noise_std')


def _check_input(network: SensorNetwork, field: FloatArray, positions: FloatArray,
                 axes: FloatArray, moment: float) -> None:
    """Raise ValueError if an input is invalid."""
    if not len(positions):
        raise ValueError('there are no poses; at least one pose is required')
    magnet_pose.check_moment_and_noise(network, field, moment)
    for k in range(len(positions)):
        if not (np.isfinite(positions[k]).all() and abs(np.linalg.norm(axes[k]) - 1.0) <= 1e-3):
            raise ValueError(f'pose {k}: expected a finite position and a unit axis, got '
                             f'{positions[k].tolist()} and {axes[k].tolist()}')
        if (network.positions == positions[k]).all(axis=1).any():
            raise ValueError(f'pose {k}: {positions[k].tolist()} m is the position of a sensor')


def calibrate_geometry_blind(network: SensorNetwork, field: FloatArray, moment: float,
                             low: ArrayLike, high: ArrayLike,
                             settings: GeometrySettings) -> NetworkGeometry:
    """Estimate the geometry of a network from readings of a magnet at unknown poses.

    The initial poses are found with the median reading of each sensor as its bias. Biases, poses
    and moment are then fitted with a field error of at least 10 %; finally, all unknowns are fitted
    with the configured one. `low` and `high` [m, world frame] are corners of the box that contains
    the magnet; poses located outside are excluded from `rows`. The world frame is defined only by
    the priors of the sensors. Raises ValueError as `calibrate_geometry`, or if fewer than
    `MIN_POSES` poses are inside the box.
    """
    field, low, high = (np.asarray(a, dtype=float) for a in (field, low, high))
    s = settings
    shared_unit = np.append(np.zeros(N_SHARED - 1), s.moment_std)
    pose_unit = np.repeat([s.start_position_std, np.deg2rad(s.start_tilt_std_deg), s.ambient_std],
                          [3, 2, 3])
    rows, r, u = _initial_poses(network, field, moment, low, high)
    coarse = replace(s, gain_std=0.0, rotation_std_deg=0.0, position_std=0.0,
                     field_error=max(COARSE_ERROR, s.field_error))
    for stage in (coarse, s):
        if len(rows) < MIN_POSES:
            raise ValueError(f'found {len(rows)} of {len(field)} poses in the box; at least '
                             f'{MIN_POSES} are required; check the moment and the box')
        geometry = fitted_geometry(network, field[rows], r, u, moment, stage, shared_unit,
                                   pose_unit)
        fitted_rows, (r, u) = rows, geometry.poses
        is_inside = ((low <= r) & (r <= high)).all(axis=1)
        rows, r, u = rows[is_inside], r[is_inside], u[is_inside]
    return replace(geometry, rows=fitted_rows,
                   suspect_poses=tuple(int(fitted_rows[k]) for k in geometry.suspect_poses))


def _initial_poses(network: SensorNetwork, field: FloatArray, moment: float, low: FloatArray,
                   high: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Locate the magnet in each reading; return rows, positions and axes of the valid poses."""
    median = np.zeros(field.shape[1:])
    for j, a in zip(*np.nonzero((~np.isnan(field)).any(axis=0)), strict=True):
        median[j, a] = np.nanmedian(field[:, j, a])
    poses = [magnet_pose.locate_magnet(network, B - median, moment, low, high, COARSE_ERROR,
                                       COARSE_AMBIENT_STD) for B in field]
    rows = np.flatnonzero([pose.converged for pose in poses])
    positions, axes = (np.array([getattr(poses[k], name) for k in rows]).reshape(-1, 3)
                       for name in ('position', 'axis'))
    return rows, positions, axes
