"""Error of a track relative to its Cramér-Rao bound, for recordings with ground truth."""

import numpy as np

from mag_tracking.analysis.track_errors import interpolate_truth
from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.crlb import path_bound
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import sensor_fields
from mag_tracking.physics.sources import constant_velocity, integrator_noise

MIN_VELOCITY_STD = 1e-9
"""[m/s] Minimum standard deviation of the velocity prior, for targets at rest."""


def error_over_bound(network: SensorNetwork, log: TrackLog,
                     truth: tuple[IntArray, FloatArray, FloatArray], acceleration: FloatArray,
                     moment_walk: float, field_error: float, background_std: float,
                     rows: IntArray, axes: int) -> float | None:
    """Ratio of the RMS error of a track to the posterior Cramér-Rao bound along the true path.

    The bound applies to a point target with the estimated moment, because the true one is unknown,
    and the tracker's motion model, sensor noise and relative field error; the backgrounds are
    states. None if fewer than two poses have a ground truth, or none of the evaluated `rows` of the
    log. T10 Alg. 2, linearised at the truth; [Tichavsky98]_. `truth` is timestamps [ns], positions
    [m] and quaternions (xyzw); `acceleration` (3,) its spectral density [m²/s³]; `moment_walk` the
    relative random walk of the moment [1/s^0.5]; `background_std` in T is that of the prior; `axes`
    is 2 for the horizontal error, 3 for the error in space.
    """
    true_path = interpolate_truth(truth, log.stamp_ns)
    truth_rows = np.flatnonzero(np.isfinite(true_path).all(axis=1))
    if axes == 2:
        # The ground truth contains the height of the road, not of the magnetic centre.
        true_path[:, 2] = np.array(log.position)[:, 2]
    rows = np.intersect1d(rows, truth_rows)
    if len(truth_rows) < 2 or not len(rows):
        return None
    t = log.seconds()[truth_rows]
    H, C = _measurement_model(network, log, true_path[truth_rows], truth_rows, field_error)
    n_x, moments = H.shape[-1], np.array(log.moment)[truth_rows]
    F, Q = np.tile(np.eye(n_x), (len(t), 1, 1)), np.zeros((len(t), n_x, n_x))
    for k, dt in enumerate(np.diff(t), 1):
        F[k, :6, :6] = constant_velocity(dt)
        Q[k, :6, :6] = integrator_noise(dt, acceleration)
        Q[k, 6:9, 6:9] = moment_walk**2 * dt * np.square(moments[k]).sum() * np.eye(3)
    # The prior has the extent and speed of the path as standard deviations.
    steps = np.linalg.norm(np.diff(true_path[truth_rows], axis=0), axis=1)
    std = np.full(n_x, background_std)
    std[:3] = max(np.ptp(true_path[truth_rows], axis=0).max(),
                  np.ptp(network.positions, axis=0).max())
    std[3:6] = max(steps.max() / np.diff(t).min(), MIN_VELOCITY_STD)
    std[6:9] = np.linalg.norm(moments[0])
    P = path_bound(F, Q, H, C, np.diag(std**2))
    is_evaluated = np.isin(truth_rows, rows)
    variance = np.einsum('kii->ki', P[is_evaluated])[:, :axes].sum(axis=1)
    error = np.array(log.position)[truth_rows[is_evaluated]] - true_path[truth_rows[is_evaluated]]
    return float(np.sqrt(np.mean(np.square(error[:, :axes]).sum(axis=1)) / np.mean(variance)))


def _measurement_model(network: SensorNetwork, log: TrackLog, true_path: FloatArray,
                       truth_rows: IntArray, field_error: float) -> tuple[FloatArray, FloatArray]:
    """Jacobians (k, n_sensors, 3, n_x) of the field with respect to [r, v, m, backgrounds], NaN
    without a measurement, and noise covariances (k, n_sensors, 3, 3)."""
    n, n_sensors = len(truth_rows), len(network)
    dr_dx, dm_dx = np.zeros((2, n, 1, 3, 9))
    dr_dx[:, 0, range(3), range(3)] = 1.0
    dm_dx[:, 0, range(3), range(6, 9)] = 1.0
    moment = np.array(log.moment)[truth_rows]
    h, H, _ = sensor_fields(network.positions, network.R_sw, true_path[:, None].copy(),
                            moment[:, None].copy(), dr_dx, dm_dx)
    backgrounds = np.eye(3 * n_sensors).reshape(n_sensors, 3, -1)
    H = np.concatenate([H, np.broadcast_to(backgrounds, (n, *backgrounds.shape))], axis=-1)
    measured = ~np.isnan(np.array(log.measured)[truth_rows])
    H = np.where(measured[..., None], H, np.nan)
    C = np.array(log.noise)[truth_rows] + field_error**2 * np.square(h).sum(axis=-1)[
        ..., None, None] * np.eye(3)
    return H, C
