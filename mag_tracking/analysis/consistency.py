"""A track's error against what its sensors allow: the path bound, with truth at hand."""

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.inference.crlb import path_bound
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import sensor_fields
from mag_tracking.physics.motion import constant_velocity, integrator_noise
from mag_tracking.report.metrics import interpolate_truth
from mag_tracking.report.track_log import TrackLog

MIN_MOTION = 1e-9
"""[m/s] Slower is at rest, for the width of the prior."""


def error_over_bound(network: SensorNetwork, log: TrackLog,
                     truth: tuple[IntArray, FloatArray, FloatArray], acceleration: FloatArray,
                     moment_walk: float, field_error: float, background_std: float,
                     rows: IntArray, axes: int) -> float | None:
    """Ratio of a track's RMS error to the bound for filters along the true path.

    The bound is that of a point target with the track's own moment (nobody knows the true one),
    the motion that the tracker assumes, the sensors' noise and the relative field error that the
    tracker allows for; the backgrounds are states, and nothing else is known at the first pose.
    What a vehicle is beyond a point is not in it.

    Parameters
    ----------
    network : SensorNetwork
    log : TrackLog
    truth : (stamps (n,) [ns], positions (n, 3) [m], quaternions (n, 4))
    acceleration : (3,) [m^2/s^3] spectral density
    moment_walk : float [1/s^0.5]
        Random walk of the moment relative to its size.
    field_error : float
    background_std : float [T]
    rows : (k,) int
        Poses of which the errors count.
    axes : int
        2 = in the plane, 3 = in space.

    Returns a float, None where there are not two poses with truth.
    Source: T10 Alg. 2 linearised at the truth; Tichavsky et al. 1998.
    """
    true = interpolate_truth(truth, log.stamp_ns)
    known = np.flatnonzero(np.isfinite(true).all(axis=1))
    if axes == 2:
        # The truth of a vehicle is on the road, its iron is not.
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
    """Jacobians (k, n_sensors, 3, n_x) by [r, v, m, backgrounds] at the truth, and noise."""
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
    """F and Q (k, n_x, n_x) from pose to pose; the first is none."""
    F, Q = np.tile(np.eye(n_x), (len(t), 1, 1)), np.zeros((len(t), n_x, n_x))
    for k, dt in enumerate(np.diff(t), 1):
        F[k, :6, :6] = constant_velocity(dt)
        Q[k, :6, :6] = integrator_noise(dt, acceleration)
        walk = moment_walk**2 * dt * np.square(log.moment[known[k]]).sum()
        Q[k, 6:9, 6:9] = walk * np.eye(3)
    return F, Q


def _prior(network: SensorNetwork, true: FloatArray, t: FloatArray, log: TrackLog,
           known: IntArray, background_std: float) -> FloatArray:
    """(n_x, n_x) before the first pose: as far as the way is long, as fast as it went."""
    way = max(np.ptp(true, axis=0).max(), np.ptp(network.positions, axis=0).max())
    speed = max(np.linalg.norm(np.diff(true, axis=0), axis=1).max()
                / np.diff(t).min(), MIN_MOTION)
    std = np.full(9 + 3 * len(network), background_std)
    std[:3], std[3:6], std[6:9] = way, speed, np.linalg.norm(log.moment[known[0]])
    return np.diag(std**2)
