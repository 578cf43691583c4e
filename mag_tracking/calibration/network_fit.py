"""Least-squares fit of the geometry of a network to readings of a magnet on a tracked tool.

Readings couple each pose to the sensors but not to other poses. The poses are therefore eliminated
from the normal equations block by block.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.stats import chi2

from mag_tracking import geometry
from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import dipole_field, dipole_jacobians
from mag_tracking.settings import param

N_SENSOR, N_SHARED, N_POSE = 10, 12, 8
"""Numbers of unknowns: per sensor (bias, gain, rotation, position); shared (shift and rotation of
the board, offset and tilt of the magnet in the tool, log of the moment); per pose (position, tilt,
ambient field)."""
Prediction: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Predicted readings and their derivatives; see `predicted_readings`."""
ASSUMED_NOISE = 1e-7
"""Noise assumed for sensors of a board without a configured noise [T]. Near a magnet, the error of
the field model is larger."""
OUTLIER_PROBABILITY = 1e-3
"""Readings whose residuals are less probable than this under the noise are down-weighted."""
STEP_TOLERANCE = 1e-3
"""Squared norm of a step, in posterior standard deviations, below which the fit has converged."""
MAX_DAMPING = 1e10
"""Damping factor at which the search for a step that reduces the cost is abandoned."""
Unknowns: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Unknowns of the sensors (n, 10), shared unknowns (12,) and unknowns of the poses (K, 8)."""
Weights: TypeAlias = tuple[FloatArray, Unknowns, float, FloatArray]
"""Return values of `GeometryProblem.weights`."""


def tool_rotations(axes: FloatArray) -> FloatArray:
    """Minimal rotations (K, 3, 3) from the tool frame to the tracker frame, from the tool's z axes,
    whose roll is not measured."""
    return geometry.rotation_from_quaternion(
        np.array([geometry.quaternion_between([0.0, 0.0, 1.0], a) for a in axes]))


def rotation(v: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors [rad]."""
    return geometry.rotation_from_quaternion(geometry.quaternion_from_rotation_vector(v))


@dataclass(frozen=True)
class TrackedMagnet:
    """A magnet on a tracked tool, with uncertain alignment to the tool and to the board."""

    tool: FloatArray
    """(K, 3) [m] tracked points, tracker frame."""
    R_tool: FloatArray
    """(K, 3, 3) rotations from the tool frame to the tracker frame; z is the axis of the tool."""
    pivot: FloatArray
    """(3,) [m] centre of the rotation between board and tracker, tracker frame."""
    moment: float
    """[A m²] Nominal moment."""

    def poses(self, shared: FloatArray, pose: FloatArray) -> tuple[
            FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Positions [m] and moments [A m²] of the magnet, world frame, and their derivatives.

        `shared` is shift [m] and rotation vector [rad] from the tracker to the board (world) frame,
        offset [m] and tilt [slope] of the magnet in the tool frame, log of the moment over its
        nominal value; `pose` is corrections of position [m, world frame] and tilt [slope, tool
        frame], and the change of the ambient field [T, world frame], which does not affect the
        pose. Each result is (K, 3), and is first differentiated by `shared`, (K, 3, 12), then by
        `pose`, (K, 3, 8).
        """
        K = len(self.tool)
        R_b, J_b = rotation(shared[3:6]), geometry.left_jacobian(shared[3:6])
        R = R_b @ self.R_tool
        arm = (self.tool - self.pivot) @ R_b.T + R @ shared[6:9]
        axis = np.hstack([shared[9:11] + pose[:, 3:5], np.ones((K, 1))])
        length = np.linalg.norm(axis, axis=1)[:, None]
        axis = axis / length
        m = self.moment * np.exp(shared[11]) * np.einsum('kij,kj->ki', R, axis)
        slope = (np.eye(3) - axis[:, :, None] * axis[:, None, :])[:, :, :2] / length[:, :, None]
        dm_dtilt = self.moment * np.exp(shared[11]) * R @ slope
        dr, dm = np.zeros((2, K, 3, N_SHARED))
        dr[:, :, :3] = np.eye(3)
        dr[:, :, 3:6] = -geometry.cross_matrix(arm) @ J_b
        dr[:, :, 6:9] = R
        dm[:, :, 3:6] = -geometry.cross_matrix(m) @ J_b
        dm[:, :, 9:11] = dm_dtilt
        dm[:, :, 11] = m
        dr_pose, dm_pose = np.zeros((2, K, 3, N_POSE))
        dr_pose[:, :, :3] = np.eye(3)
        dm_pose[:, :, 3:5] = dm_dtilt
        return self.pivot + shared[:3] + arm + pose[:, :3], m, dr, dm, dr_pose, dm_pose

    def positions_and_axes(self, shared: FloatArray,
                           pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions [m] and unit axes of the magnet, each (K, 3), world frame; see `poses`."""
        r, m, *_ = self.poses(shared, pose)
        return r, m / np.linalg.norm(m, axis=1)[:, None]


def predicted_readings(network: SensorNetwork, magnet: TrackedMagnet, sensor: FloatArray,
                       shared: FloatArray, pose: FloatArray) -> Prediction:
    """Predict the reading of each sensor at each pose, and its derivatives.

    `sensor` (n, 10) is bias [T, sensor frame], gain minus one, rotation vector [rad, nominal sensor
    frame] and position minus the nominal position [m, world frame]. Returns readings and readings
    without the bias (n, K, 3) [T, sensor frame], then derivatives by `sensor`, `shared` and `pose`,
    NaN for a magnet at a sensor. TSP14 eq. (2), (30) for the dipole; T10 section 6.3 for the
    corrections, here with finite rotations.
    """
    r, m, *derivatives = magnet.poses(shared, pose)
    d = (network.positions + sensor[:, 7:])[:, None] - r
    R_correction = np.swapaxes(rotation(sensor[:, 4:7]), 1, 2)
    gain = (1.0 + sensor[:, 3])[:, None, None]
    M = gain * R_correction @ network.R_sw
    nominal = np.einsum('nij,nkj->nki', network.R_sw, dipole_field(d, m) + pose[:, 5:])
    dB_dr, dB_dm = dipole_jacobians(d, m)
    dB_dr, dB_dm = M[:, None] @ dB_dr, M[:, None] @ dB_dm
    by_sensor = np.zeros((*d.shape, N_SENSOR))
    by_sensor[..., :3] = np.eye(3)
    field = np.einsum('nij,nkj->nki', R_correction, nominal)
    by_sensor[..., 3] = field
    by_sensor[..., 4:7] = ((gain * R_correction)[:, None] @ geometry.cross_matrix(nominal)
                           @ geometry.left_jacobian(sensor[:, 4:7])[:, None])
    by_sensor[..., 7:] = dB_dr
    dr, dm, dr_pose, dm_pose = derivatives
    by_pose = dB_dm @ dm_pose - dB_dr @ dr_pose
    by_pose[..., 5:] = M[:, None]
    signal = gain * field
    return (signal + sensor[:, None, :3], signal, by_sensor, dB_dm @ dm - dB_dr @ dr, by_pose)


@dataclass(frozen=True)
class GeometrySettings:
    """Prior standard deviations, where zero means exactly known, and limits of the fit."""

    gain_std: float = param(0.03, 'Standard deviation of the gain of a sensor.', '', (0.0, 1.0))
    rotation_std_deg: float = param(
        2.0, 'Standard deviation of the orientation of a sensor, per axis.', 'deg', (0.0, 45.0))
    position_std: float = param(
        1e-3, 'Standard deviation of the position of a sensor, per axis.', 'm', (0.0, 100.0))
    moment_std: float = param(
        0.0, 'Standard deviation of the moment of the magnet, relative to its magnitude.', '',
        (0.0, 1.0))
    board_shift_std: float = param(
        0.01, 'Standard deviation of the position of the network relative to the tracker, per '
        'axis.', 'm', (0.0, 100.0))
    board_rotation_std_deg: float = param(
        2.0, 'Standard deviation of the orientation of the network relative to the tracker, per '
        'axis.', 'deg', (0.0, 45.0))
    tool_offset_std: float = param(
        0.01, 'Standard deviation of the offset of the magnet from the tracked point, per axis.',
        'm', (0.0, 100.0))
    tool_tilt_std_deg: float = param(
        3.0, 'Standard deviation of the tilt of the magnet from the tracked axis, per axis.',
        'deg', (0.0, 45.0))
    tracker_position_std: float = param(
        3e-4, 'Standard deviation of the tracked position of one pose, per axis.', 'm',
        (0.0, 100.0))
    tracker_tilt_std_deg: float = param(
        0.2, 'Standard deviation of the tracked tilt of one pose, per axis.', 'deg', (0.0, 45.0))
    start_position_std: float = param(
        0.1, 'Standard deviation of the starting position of an untracked magnet, per axis.', 'm',
        (0.0, 100.0))
    start_tilt_std_deg: float = param(
        30.0, 'Standard deviation of the starting tilt of an untracked magnet, per axis.', 'deg',
        (0.0, 60.0))
    ambient_std: float = param(
        1e-7, 'Standard deviation of the change of the ambient field from pose to pose, per axis; '
        'the change is the same at all sensors.', 'T', (0.0, 1e-3))
    field_error: float = param(
        0.01, 'Error of the dipole model relative to the field.', '', (0.0, 1.0))
    iterations: int = param(60, 'Maximum number of steps.', '', (1, 10000))


class GeometryProblem:
    """Least-squares problem of a geometry calibration: readings, priors and predictions.

    The arguments are those of `fitted_geometry`; `field` is stored as (n, K, 3), with `variance`
    (n, 1, 3) T², and `has_readings` (n, 3) tells whether an axis has any reading. The methods take
    the unknowns `x` in units of their prior stds, such as `sensor_unit` (n, 10).
    """

    def __init__(self, network: SensorNetwork, field: FloatArray, positions: FloatArray,
                 axes: FloatArray, moment: float, settings: GeometrySettings,
                 shared_unit: FloatArray, pose_unit: FloatArray) -> None:
        self.network, self.settings = network, settings
        self.shared_unit, self.pose_unit = shared_unit, pose_unit
        self.field = np.ascontiguousarray(np.swapaxes(field, 0, 1))
        self.variance = np.square(np.array(network.noise_std))[:, None]
        self.magnet = TrackedMagnet(positions, tool_rotations(axes), positions.mean(axis=0),
                                    float(moment))
        self.has_readings: BoolArray = np.any(~np.isnan(self.field), axis=1)
        s = settings
        self.sensor_unit = np.hstack([np.array(network.noise_std), np.tile(np.repeat(
            [s.gain_std, np.deg2rad(s.rotation_std_deg), s.position_std], [1, 3, 3]),
            (len(network), 1))])

    def predicted(self, x: Unknowns) -> Prediction:
        """`predicted_readings` with derivatives in units of the priors."""
        sensor, shared, pose = self.in_si(x)
        f, signal, by_sensor, by_shared, by_pose = predicted_readings(
            self.network, self.magnet, sensor, shared, pose)
        return (f, signal, by_sensor * self.sensor_unit[:, None, None],
                by_shared * self.shared_unit, by_pose * self.pose_unit)

    def in_si(self, x: Unknowns) -> Unknowns:
        """Convert unknowns from units of their priors to SI units."""
        sensor, shared, pose = x
        return sensor * self.sensor_unit, shared * self.shared_unit, pose * self.pose_unit

    def squared_residuals(self, f: FloatArray,
                          signal: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """Squared residuals over their variance, 0 if unmeasured, numbers of measured axes (n, K),
        and the variance, of the prediction `f` (n, K, 3) [T] with biases and `signal` without."""
        squared_signal = np.einsum('nki,nki->nk', signal, signal)[:, :, None]
        variance = self.variance + self.settings.field_error**2 * squared_signal
        e2 = np.square(self.field - f) / variance
        return np.nan_to_num(e2), (~np.isnan(e2)).sum(axis=2), variance

    def weights(self, f: FloatArray, signal: FloatArray, x: Unknowns) -> Weights:
        """Robust weights of readings and priors, noise scale, and robust weights (n, K), 0 to 1.

        The weights of the readings (n, K, 3) are over the scaled variance. The scale is the median
        of `median_ratio` over all sensors and poses with readings, at least one.
        """
        e2, count, variance = self.squared_residuals(f, signal)
        d2 = e2.sum(axis=2)
        scale = max(1.0, float(np.median(median_ratio(d2, count)[count > 0])))
        robust_weights = _robust_weights(d2 / scale, count)
        W = robust_weights[:, :, None] / (variance * scale)
        W[np.isnan(self.field)] = 0.0
        # The square root limits the down-weighting: a large correction is an error to be estimated,
        # not an outlier to be ignored.
        sensor, pose = (np.sqrt(_robust_weights(np.square(v).sum(axis=1), v.shape[1]))[:, None]
                        for v in (x[0][:, 3:], x[2]))
        # A bias has no prior, except on an axis without readings, where it would be undetermined.
        prior_weights = (np.hstack([1.0 * ~self.has_readings, np.tile(sensor, N_SENSOR - 3)]),
                         np.ones(N_SHARED), np.tile(pose, N_POSE))
        return W, prior_weights, scale, robust_weights

    def cost(self, x: Unknowns, f: FloatArray, W: FloatArray, prior_weights: Unknowns) -> float:
        """Weighted sum of the squared residuals and of the squared unknowns (priors); infinite if a
        prediction is not finite."""
        e = np.nan_to_num(self.field - f)
        cost = (W * e * e).sum() + sum(
            (w * v**2).sum() for w, v in zip(prior_weights, x, strict=True))
        return cost if np.isfinite(f).all() else np.inf


def median_ratio(d2: FloatArray, count: IntArray) -> FloatArray:
    """Ratio of each sum `d2` of `count` squared normalised residuals to its median for pure noise;
    one where nothing was measured."""
    return np.where(count > 0, d2 / chi2.median(np.maximum(count, 1)), 1.0)


def _robust_weights(d2: FloatArray, count: IntArray | int) -> FloatArray:
    """Robust weights (0 to 1) from the sums `d2` of `count` squared residuals."""
    limit = chi2.isf(OUTLIER_PROBABILITY, np.maximum(count, 1))
    return limit / np.maximum(d2, limit)


class NormalEquations:
    """Normal equations of a geometry calibration; the poses are eliminated block by block.

    `A` (N, N) and `g` (N,) are information and negative gradient of [sensors, shared], `A_pose`
    (K, 8, 8) and `g_pose` (K, 8) those of each pose, `C` (K, N, 8) is the cross information.
    """

    def __init__(self, problem: GeometryProblem, x: Unknowns, predicted: Prediction, W: FloatArray,
                 prior_weights: Unknowns) -> None:
        f, _, by_sensor, by_shared, by_pose = predicted
        n, K = W.shape[:2]
        sqrt_weights = np.sqrt(W)
        e = (sqrt_weights * np.nan_to_num(problem.field - f)).reshape(n, 3 * K)
        Js, Jh = ((sqrt_weights[..., None] * J).reshape(n, 3 * K, -1)
                  for J in (by_sensor, by_shared))
        Jp = sqrt_weights[..., None] * by_pose
        Jst = np.swapaxes(Js, 1, 2)
        m = N_SENSOR * n
        A = np.zeros((m + N_SHARED, m + N_SHARED))
        for j, block in enumerate(Jst @ Js):
            block_slice = slice(N_SENSOR * j, N_SENSOR * j + N_SENSOR)
            A[block_slice, block_slice] = block + np.diag(prior_weights[0][j])
        A[:m, m:] = (Jst @ Jh).reshape(m, N_SHARED)
        A[m:, :m] = A[:m, m:].T
        Jh_all = Jh.reshape(-1, N_SHARED)
        A[m:, m:] = Jh_all.T @ Jh_all + np.diag(prior_weights[1])
        self.A = A
        self.g = np.concatenate([
            (np.einsum('nyi,ny->ni', Js, e) - prior_weights[0] * x[0]).ravel(),
            Jh_all.T @ e.ravel() - prior_weights[1] * x[1]])
        pose_jacobians = np.swapaxes(Jp, 0, 1).reshape(K, 3 * n, N_POSE)
        self.A_pose = np.swapaxes(pose_jacobians, 1, 2) @ pose_jacobians \
            + prior_weights[2][:, :, None] * np.eye(N_POSE)
        self.g_pose = np.einsum('kyi,ky->ki', pose_jacobians, np.swapaxes(
            e.reshape(n, K, 3), 0, 1).reshape(K, 3 * n)) - prior_weights[2] * x[2]
        sensor_pose = np.einsum('nkai,nkap->knip', Js.reshape(n, K, 3, N_SENSOR), Jp)
        shared_pose = np.einsum('nkai,nkap->kip', Jh.reshape(n, K, 3, N_SHARED), Jp)
        self.C = np.concatenate([sensor_pose.reshape(K, m, N_POSE), shared_pose], axis=1)

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Steps of [sensors, shared] (N,) and poses (K, 8), with diagonals damped."""
        A = self.A + damping * np.diag(np.diagonal(self.A))
        A_pose = self.A_pose * (1.0 + damping * np.eye(N_POSE))
        CB = self.C @ np.linalg.inv(A_pose)
        S = A - self._lost_information(CB)
        dx = np.linalg.solve(S, self.g - np.einsum('kip,kp->i', CB, self.g_pose))
        residual = self.g_pose - np.einsum('kip,i->kp', self.C, dx)
        return dx, np.linalg.solve(A_pose, residual[..., None])[..., 0]

    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """Covariances of [sensors, shared] (N, N) and of each pose (K, 8, 8)."""
        B = np.linalg.inv(self.A_pose)
        CB = self.C @ B
        P = np.linalg.inv(self.A - self._lost_information(CB))
        P = 0.5 * (P + P.T)
        return P, B + np.swapaxes(CB, 1, 2) @ (P @ CB)

    def _lost_information(self, CB: FloatArray) -> FloatArray:
        """Information (N, N) on [sensors, shared] that is lost by eliminating the poses."""
        N = len(self.g)
        lost: FloatArray = (np.swapaxes(CB, 0, 1).reshape(N, -1)
                            @ np.swapaxes(self.C, 0, 1).reshape(N, -1).T)
        return lost


def solve(problem: GeometryProblem, iterations: int) -> tuple[Unknowns, Weights, Prediction, bool]:
    """Minimise a `GeometryProblem` by Levenberg-Marquardt, from the median residuals as biases; the
    last value is whether it converged."""
    n, K, damping, converged = len(problem.network), len(problem.magnet.tool), 1e-3, False
    x: Unknowns = np.zeros((n, N_SENSOR)), np.zeros(N_SHARED), np.zeros((K, N_POSE))
    residuals = problem.field - problem.predicted(x)[0]
    for j, a in zip(*np.nonzero(problem.has_readings), strict=True):
        x[0][j, a] = np.nanmedian(residuals[j, :, a]) / problem.sensor_unit[j, a]
    predicted = problem.predicted(x)
    for _ in range(iterations):
        W, prior_weights, *_ = problem.weights(predicted[0], predicted[1], x)
        equations = NormalEquations(problem, x, predicted, W, prior_weights)
        cost = problem.cost(x, predicted[0], W, prior_weights)
        while damping < MAX_DAMPING:
            dx, dpose = equations.step(damping)
            m = len(dx) - N_SHARED
            candidate = x[0] + dx[:m].reshape(-1, N_SENSOR), x[1] + dx[m:], x[2] + dpose
            candidate_predicted = problem.predicted(candidate)
            if problem.cost(candidate, candidate_predicted[0], W, prior_weights) <= cost:
                break
            damping *= 10.0
        else:
            break
        x, predicted, damping = candidate, candidate_predicted, 0.1 * damping
        if dx @ equations.g + (dpose * equations.g_pose).sum() < STEP_TOLERANCE:
            converged = True
            break
    return x, problem.weights(predicted[0], predicted[1], x), predicted, converged
