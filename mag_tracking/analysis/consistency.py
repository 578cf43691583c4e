"""Error of a track relative to the path bound, for recordings with ground truth."""

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.crlb import path_bound
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import sensor_fields
from mag_tracking.physics.motion import constant_velocity, integrator_noise
from mag_tracking.report.metrics import interpolate_truth
from mag_tracking.report.track_log import TrackLog

MIN_MOTION = 1e-9
"""[m/s] Minimum speed for the width of the velocity prior; slower targets are at rest."""


def error_over_bound(network: SensorNetwork, log: TrackLog,
                     truth: tuple[IntArray, FloatArray, FloatArray], acceleration: FloatArray,
                     moment_walk: float, field_error: float, background_std: float,
                     rows: IntArray, axes: int) -> float | None:
    """Ratio of the RMS error of a track to the posterior Cramér-Rao bound along the true path.

    The bound is that of a point target with the moment of the track, since the true moment is
    unknown. It uses the motion model of the tracker, the sensor noise and the relative field error
    that the tracker allows for. The backgrounds are states, and there is no information on the
    first pose. Effects of the extent of a vehicle are not included.

    Parameters
    ----------
    network : SensorNetwork
    log : TrackLog
    truth : (timestamps (n,) ns, positions (n, 3) m, quaternions (n, 4) xyzw)
        (n,) ns, (n, 3) m, (n, 4).
    acceleration : (3,) array, m²/s³
        Spectral density of the acceleration.
    moment_walk : float, 1/s^0.5
        Random walk of the moment relative to its size.
    field_error : float
        Model error relative to the field.
    background_std : float, T
    rows : (k,) int array
        Poses whose errors are evaluated.
    axes : int
        2 = horizontal errors, 3 = errors in space.

    Returns
    -------
    float or None
        None if fewer than two poses have a ground truth.

    References
    ----------
    [T10]_ Alg. 2, linearised at the truth; [Tichavsky98]_.
    """
    true = interpolate_truth(truth, log.stamp_ns)
    known = np.flatnonzero(np.isfinite(true).all(axis=1))
    if axes == 2:
        # The true height is that of the road, not of the magnetic centre of the vehicle.
        true[:, 2] = np.array(log.position)[:, 2]
    rows = np.intersect1d(rows, known)
    if len(known) < 2 or not len(rows):
        return None
    t = log.seconds()[known]
    H, C = _linearised(network, log, true[known], t, known, field_error)
    F, Q = _motion(t, acceleration, moment_walk, log, known, H.shape[-1])
    P = path_bound(F, Q, H, C, _prior(network, true[known], t, log, known, background_std))
    chosen = np.isin(known, rows)
    variance = np.einsum('kii->ki', P[chosen])[:, :axes].sum(axis=1)
    error = np.array(log.position)[known[chosen]] - true[known[chosen]]
    return float(np.sqrt(np.mean(np.square(error[:, :axes]).sum(axis=1)) / np.mean(variance)))


def _linearised(network: SensorNetwork, log: TrackLog, true: FloatArray, t: FloatArray,
                known: IntArray, field_error: float) -> tuple[FloatArray, FloatArray]:
    """Jacobians (k, n_sensors, 3, n_x) by [r, v, m, backgrounds] at the truth, and covariances."""
    n, n_sensors = len(known), len(network)
    dr_dx, dm_dx = np.zeros((2, n, 1, 3, 9))
    dr_dx[:, 0, range(3), range(3)] = 1.0
    dm_dx[:, 0, range(3), range(6, 9)] = 1.0
    moment = np.array(log.moment)[known]
    h, H, _ = sensor_fields(network.positions, network.R_sw, true[:, None].copy(),
                            moment[:, None].copy(), dr_dx, dm_dx)
    backgrounds = np.eye(3 * n_sensors).reshape(n_sensors, 3, -1)
    H = np.concatenate([H, np.broadcast_to(backgrounds, (n, *backgrounds.shape))], axis=-1)
    measured = ~np.isnan(np.array(log.measured)[known])
    H = np.where(measured[..., None], H, np.nan)
    C = np.array(log.noise)[known] + field_error**2 * np.square(h).sum(axis=-1)[
        ..., None, None] * np.eye(3)
    return H, C


def _motion(t: FloatArray, acceleration: FloatArray, moment_walk: float, log: TrackLog,
            known: IntArray, n_x: int) -> tuple[FloatArray, FloatArray]:
    """F and Q (k, n_x, n_x) between consecutive poses; identity and zero for the first pose."""
    F, Q = np.tile(np.eye(n_x), (len(t), 1, 1)), np.zeros((len(t), n_x, n_x))
    for k, dt in enumerate(np.diff(t), 1):
        F[k, :6, :6] = constant_velocity(dt)
        Q[k, :6, :6] = integrator_noise(dt, acceleration)
        walk = moment_walk**2 * dt * np.square(log.moment[known[k]]).sum()
        Q[k, 6:9, 6:9] = walk * np.eye(3)
    return F, Q


def _prior(network: SensorNetwork, true: FloatArray, t: FloatArray, log: TrackLog,
           known: IntArray, background_std: float) -> FloatArray:
    """Prior covariance (n_x, n_x) of the first pose, from the length and speed of the path."""
    way = max(np.ptp(true, axis=0).max(), np.ptp(network.positions, axis=0).max())
    speed = max(np.linalg.norm(np.diff(true, axis=0), axis=1).max()
                / np.diff(t).min(), MIN_MOTION)
    std = np.full(9 + 3 * len(network), background_std)
    std[:3], std[3:6], std[6:9] = way, speed, np.linalg.norm(log.moment[known[0]])
    return np.diag(std**2)
