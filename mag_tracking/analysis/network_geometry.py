"""A network's geometry from the network itself: what a magnet's poses tell of its sensors.

PHD15 Paper A names it as future work. Positions, orientations, gains and biases of fixed sensors
are found by maximum a posteriori, together with what is unknown between a tracked tool and the
board, or together with the poses themselves where nothing tracks the magnet.
"""

from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.analysis.network_fit import (
    GeometryProblem,
    NormalEquations,
    Unknowns,
    median_ratio,
    solve,
)
from mag_tracking.analysis.network_readings import (
    POSE,
    SENSOR,
    SHARED,
    Prediction,
    TrackedMagnet,
    rotation,
    tool_rotations,
)
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.network import SensorNetwork
from mag_tracking.settings import param


@dataclass(frozen=True)
class GeometrySettings:
    """What is known beforehand, as standard deviations; zero means exactly."""

    gain_std: float = param(0.03, 'Of a sensor\'s gain.', '', (0.0, 1.0))
    rotation_std_deg: float = param(2.0, 'Of a sensor\'s orientation, per axis.', 'deg',
                                    (0.0, 45.0))
    position_std: float = param(1e-3, 'Of a sensor\'s position, per axis.', 'm', (0.0, 100.0))
    moment_std: float = param(0.0, 'Of the magnet\'s moment, relative to its size.', '',
                              (0.0, 1.0))
    board_shift_std: float = param(
        0.01, 'Of the network against the tracker, per axis.', 'm', (0.0, 100.0))
    board_rotation_std_deg: float = param(
        2.0, 'Of the network against the tracker, per axis.', 'deg', (0.0, 45.0))
    tool_offset_std: float = param(
        0.01, 'Of the magnet against the tracked point, per axis.', 'm', (0.0, 100.0))
    tool_tilt_std_deg: float = param(
        3.0, 'Of the magnet against the tracked axis, per axis.', 'deg', (0.0, 45.0))
    tracker_position_std: float = param(
        3e-4, 'Of one tracked position, per axis.', 'm', (0.0, 100.0))
    tracker_tilt_std_deg: float = param(0.2, 'Of one tracked axis, each way.', 'deg', (0.0, 45.0))
    start_position_std: float = param(
        0.1, 'Of a start, per axis, where nothing tracks the magnet.', 'm', (0.0, 100.0))
    start_tilt_std_deg: float = param(
        30.0, 'Of the axis of such a start, each way.', 'deg', (0.0, 60.0))
    ambient_std: float = param(
        1e-7, 'Of the change of the ambient field from pose to pose, per axis, alike everywhere.',
        'T', (0.0, 1e-3))
    field_error: float = param(
        0.01, 'What the dipole errs by, relative to the field.', '', (0.0, 1.0))
    iterations: int = param(60, 'No more steps than these.', '', (1, 10000))


@dataclass(frozen=True)
class NetworkGeometry:
    """A calibrated network; where `reason` is not empty it is not to be used.

    Deviations are those of the posterior, with readings as bad as the fit has them where that is
    worse than stated.
    """

    network: SensorNetwork
    """As corrected: positions, orientations, and the biases as background."""
    position_std: FloatArray
    """(n, 3) [m]."""
    rotation_std: FloatArray
    """(n, 3) [rad], about the sensor's own axes."""
    gain: FloatArray
    """(n,)."""
    gain_std: FloatArray
    bias: FloatArray
    """(n, 3) [T], sensor frame; NaN where an axis never reported."""
    bias_std: FloatArray
    """(n, 3) [T]; infinite where an axis never reported."""
    magnet: TrackedMagnet
    rows: IntArray
    """(K,) of the readings that were used."""
    shared: FloatArray
    """(12,) as for `TrackedMagnet.poses`."""
    shared_std: FloatArray
    """(12,)."""
    pose: FloatArray
    """(K, 8) as for `TrackedMagnet.poses`."""
    pose_covariance: FloatArray
    """(K, 8, 8)."""
    covariance: FloatArray
    """(10 n + 12,) squared, of all sensors' numbers (bias, gain, rotation, position), then of the
    shared ones."""
    normalised_cost: float
    """About one where model, noise and field error are right."""
    sensor_residual: FloatArray
    """(n,) root mean square of what is left over, in its deviations; NaN without readings."""
    pose_residual: FloatArray
    """(K,) the middle of the sensors' residuals, over that of the noise."""
    suspect_sensors: tuple[str, ...]
    """Names of those that do not fit with the others, or only after corrections beyond
    `STRANGE` deviations."""
    suspect_poses: tuple[int, ...]
    """Rows of poses that do not fit with the others."""
    converged: bool
    reason: str

    def signal(self, field: FloatArray) -> FloatArray:
        """Readings (..., n, 3) [T], sensor frame, without biases and gains; NaN stays NaN."""
        signal: FloatArray = (np.asarray(field, dtype=float) - self.bias) / self.gain[:, None]
        return signal

    def magnet_poses(self, positions: FloatArray,
                     axes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where tracked poses have the magnet.

        `positions` (K, 3) [m] and unit `axes` (K, 3), tracker, as for `calibrate_geometry`.
        Returns positions (K, 3) [m] and axes (K, 3), world.
        """
        magnet = replace(self.magnet, tool=np.asarray(positions, dtype=float),
                         R_tool=tool_rotations(np.asarray(axes, dtype=float)))
        return _places(magnet, self.shared, np.zeros((len(magnet.tool), POSE)))

    @property
    def moment(self) -> tuple[float, float]:
        """[A m^2]; and its deviation."""
        moment = self.magnet.moment * np.exp(self.shared[11])
        return moment, moment * self.shared_std[11]

    @property
    def tool_offset(self) -> tuple[FloatArray, FloatArray]:
        """(3,) [m], tool: the magnet's centre from the tracked point; and its deviation."""
        return self.shared[6:9], self.shared_std[6:9]

    @property
    def tool_tilt(self) -> tuple[FloatArray, FloatArray]:
        """(2,) [slope], tool: the moment's x and y over its z; and its deviation."""
        return self.shared[9:11], self.shared_std[9:11]

    @property
    def poses(self) -> tuple[FloatArray, FloatArray]:
        """Positions (K, 3) [m] and axes (K, 3), world, of the magnet when it was calibrated."""
        return _places(self.magnet, self.shared, self.pose)


def _places(magnet: TrackedMagnet, shared: FloatArray,
            pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions and unit axes."""
    r, m, *_ = magnet.poses(shared, pose)
    return r, m / np.linalg.norm(m, axis=1)[:, None]


MIN_POSES = 3
"""With fewer, a sensor's bias cannot be told from the magnet's field."""

MIN_CHANGE = 0.1
"""[rad], and relative to the distance: a magnet that moves and turns less stays where it is."""

STRANGE = 4.0
"""A correction of more deviations than this is no small one."""

MISFIT = 3.0
"""What fits worse than the middle of its kind by this factor does not belong to it."""

MAX_COST = 100.0
"""A normalised cost beyond is none of a dipole and these sensors."""


def calibrate_geometry(network: SensorNetwork, field: FloatArray, positions: FloatArray,
                       axes: FloatArray, moment: float,
                       settings: GeometrySettings) -> NetworkGeometry:
    """Geometry of a network from readings of a magnet that is tracked.

    Parameters
    ----------
    network : SensorNetwork
        As stated, with the `noise_std` of every sensor.
    field : (K, n, 3) [T], sensor frame
        Readings with their constant background; NaN = not measured.
    positions : (K, 3) [m], tracker
        Of the tracked point. Tracker and world are the same but for the settings' shift and turn.
    axes : (K, 3)
        Unit vectors, tracker: the moment's direction but for the tilt.
    moment : float [A m^2]
    settings : GeometrySettings

    Returns
    -------
    NetworkGeometry

    Raises
    ------
    ValueError
        Shapes that do not fit, poses that are not finite or not unit, a pose without readings or
        at the place of a sensor, a sensor without noise, a moment of no size.

    Source: MAP by Levenberg and Marquardt with redescending weights; the gauge (a turn of the
    board is one of all sensors) is the priors'. PHD15 Paper A section 8 asks for it.
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
    """As `calibrate_geometry`, with prior deviations of one's own.

    `shared_unit` (12,) of what is shared and `pose_unit` (8,) of a pose, in the units of
    `TrackedMagnet.poses`; zero means fixed.
    """
    field, positions, axes = (np.asarray(a, dtype=float) for a in (field, positions, axes))
    _check(network, field, positions, axes, moment)
    problem = GeometryProblem(network, field, positions, axes, moment, settings, shared_unit,
                              pose_unit)
    x, (W, priors, scale, trust), predicted, converged = solve(problem, settings.iterations)
    cost = _normalised_cost(problem, x, predicted, W, trust, priors)
    # The readings are made worse, not the priors.
    worse = max(1.0, cost / scale)
    P, P_pose = NormalEquations(problem, x, predicted, W / worse, priors).covariance()
    n = len(network)
    unit = np.append(problem.sensor_unit.ravel(), problem.shared_unit)
    covariance = P * unit[:, None] * unit
    std = np.sqrt(np.diagonal(covariance))
    sensor_std, shared_std = std[:-SHARED].reshape(n, SENSOR), std[-SHARED:]
    sensor, shared, pose = problem.in_si(x)
    turn = rotation(sensor[:, 4:7])
    by_sensor, by_pose = _residuals(problem, predicted)
    outlier_sensors, outlier_poses = _suspects(problem, x, by_sensor, by_pose)
    reason = _doubt(problem, x, converged, cost)
    return NetworkGeometry(
        network=replace(network, positions=network.positions + sensor[:, 7:],
                        R_ws=network.R_ws @ turn, background=tuple(
                            b if h.all() else None
                            for b, h in zip(sensor[:, :3], problem.reported, strict=True))),
        position_std=sensor_std[:, 7:], rotation_std=sensor_std[:, 4:7],
        gain=1.0 + sensor[:, 3], gain_std=sensor_std[:, 3],
        bias=np.where(problem.reported, sensor[:, :3], np.nan),
        bias_std=np.where(problem.reported, sensor_std[:, :3], np.inf),
        magnet=problem.magnet, rows=np.arange(len(pose)), shared=shared,
        shared_std=shared_std, pose=pose,
        pose_covariance=P_pose * np.outer(problem.pose_unit, problem.pose_unit),
        covariance=covariance, normalised_cost=cost, sensor_residual=by_sensor,
        pose_residual=by_pose, suspect_sensors=outlier_sensors, suspect_poses=outlier_poses,
        converged=not reason, reason=reason)


def _normalised_cost(problem: GeometryProblem, x: Unknowns, predicted: Prediction, W: FloatArray,
                     trust: FloatArray, priors: Unknowns) -> float:
    """Weighted sum of squares over the degrees of freedom that the priors leave; NaN if none."""
    P, P_pose = NormalEquations(problem, x, predicted, W, priors).covariance()
    e2, count, _ = problem.misfit(predicted[0], predicted[1])
    known = np.append(priors[0].ravel(), priors[1]) @ np.diagonal(P)
    known += np.einsum('ki,kii->', priors[2], P_pose)
    unknowns = len(P) + POSE * len(P_pose) - known
    freedom = (trust * count).sum() - unknowns
    return float((trust[:, :, None] * e2).sum() / freedom) if freedom >= 1.0 else np.nan


def _residuals(problem: GeometryProblem, predicted: Prediction) -> tuple[FloatArray, FloatArray]:
    """Of sensors (n,) their root mean square, of poses (K,) the middle of the sensors'."""
    e2, count, _ = problem.misfit(predicted[0], predicted[1])
    e2 = e2.sum(axis=2)
    by_pose = np.sqrt([np.median(median_ratio(d2, c)[c > 0])
                       for d2, c in zip(e2.T, count.T, strict=True)])
    fits = by_pose <= MISFIT * np.median(by_pose)
    reported = count[:, fits].sum(axis=1)
    by_sensor = np.sqrt(e2[:, fits].sum(axis=1) / np.where(reported > 0, reported, np.nan))
    return by_sensor, by_pose


def _suspects(problem: GeometryProblem, x: Unknowns, by_sensor: FloatArray,
              by_pose: FloatArray) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Names of the sensors and rows of the poses that do not fit."""
    sensors = by_sensor > MISFIT * np.nanmedian(by_sensor)
    sensors |= (np.abs(x[0][:, 3:]) > STRANGE).any(axis=1)
    poses = by_pose > MISFIT * np.median(by_pose)
    poses |= (np.abs(x[2]) > STRANGE).any(axis=1)
    return (tuple(problem.network.names[j] for j in np.flatnonzero(sensors)),
            tuple(int(k) for k in np.flatnonzero(poses)))


def _at_one_place(problem: GeometryProblem, x: Unknowns) -> bool:
    """Whether the magnet neither moved, compared with its distance, nor turned."""
    r, u = _places(problem.magnet, *problem.in_si(x)[1:])
    nearest = np.linalg.norm(problem.network.positions - r.mean(axis=0), axis=1).min()
    return bool((np.ptp(r, axis=0) < MIN_CHANGE * nearest).all()
                and (np.ptp(u, axis=0) < MIN_CHANGE).all())


def _doubt(problem: GeometryProblem, x: Unknowns, converged: bool, cost: float) -> str:
    """Why it is no answer; empty where it is one."""
    K, most = len(problem.magnet.tool), problem.settings.iterations
    if K < MIN_POSES:
        reason = f'{K} poses, at least {MIN_POSES} are needed to tell biases from the magnet'
    elif _at_one_place(problem, x):
        reason = 'the poses are at one place: nothing is learnt of the geometry'
    elif not converged:
        reason = f'no minimum within {most} steps'
    elif np.isnan(cost):
        reason = 'fewer readings than unknowns'
    elif cost > MAX_COST:
        reason = (f'not what the model describes: the normalised cost is {cost:.0f} (wrong poses '
                  'or moment, another network, or a noise_std that is too small)')
    else:
        reason = ''
    return reason


def _check(network: SensorNetwork, field: FloatArray, positions: FloatArray, axes: FloatArray,
           moment: float) -> None:
    """Raise ValueError for what cannot be used."""
    K, n = len(positions), len(network)
    if field.shape != (K, n, 3) or positions.shape != (K, 3) or axes.shape != (K, 3):
        raise ValueError(f'expected field (K, {n}, 3), positions and axes (K, 3), got '
                         f'{field.shape}, {positions.shape}, {axes.shape}')
    if K == 0:
        raise ValueError('no poses')
    for name, std in zip(network.names, network.noise_std, strict=True):
        if std is None or not (np.asarray(std) > 0.0).all():
            raise ValueError(f'sensor {name}: noise_std is {std}, expected it above 0 T')
    for k in range(K):
        if not (np.isfinite(positions[k]).all()
                and abs(np.linalg.norm(axes[k]) - 1.0) <= 1e-3):
            raise ValueError(f'pose {k}: expected a finite position and a unit axis, got '
                             f'{positions[k].tolist()} and {axes[k].tolist()}')
        if (network.positions == positions[k]).all(axis=1).any():
            raise ValueError(f'pose {k}: {positions[k].tolist()} m is the place of a sensor')
        if np.isnan(field[k]).all():
            raise ValueError(f'pose {k}: no sensor has a reading')
    if np.isinf(field).any():
        raise ValueError('a reading is infinite')
    if not (np.isfinite(moment) and moment > 0.0):
        raise ValueError(f'moment is {moment}, expected it above 0 A m^2')
