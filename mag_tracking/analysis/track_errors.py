"""Errors of tracks with respect to the truth, relative to their covariances and to the bound."""

from collections.abc import Iterable
from typing import TypeAlias, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.analysis.track_log import PoseLog, TrackLog
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.geometry import rotation_from_quaternion
from mag_tracking.inference.crlb import path_bound
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import sensor_fields
from mag_tracking.physics.sources import constant_velocity, integrator_noise

Truth: TypeAlias = tuple[IntArray, FloatArray, FloatArray]
"""Timestamps (n,) [ns], positions (n, 3) [m] and quaternions (n, 4) xyzw of a target; quaternions
are NaN if the orientation is unknown."""
NEAR_M = 5.0
"""Horizontal distance from the centre of the network within which vehicles are evaluated [m]."""


class PassErrors(TypedDict):
    """Horizontal errors of the `n` poses of a vehicle whose true position is within `NEAR_M`."""

    rms: float | None
    """RMS error of these poses [m]; None if there are none."""
    closest: float
    closest_distance: float
    """Error of the pose whose true position is closest to the centre, and its distance [m]."""
    anees: float
    """Mean NEES per axis of these poses, or of the closest pose if there are none."""
    n: int


class MagnetErrors(TypedDict):
    """Position errors [m] of the `n` evaluated poses of a magnet."""

    position_mean: float
    position_max: float
    axis_median_deg: float | None
    """Median angle between the estimated and the true axis; None for a truth without it."""
    anees: float
    """Mean NEES per axis of the position."""
    n: int


def interpolate_truth(truth: Truth, stamps_ns: ArrayLike) -> FloatArray:
    """True positions (n, 3) [m] at given times [ns]; NaN outside the time range of the truth."""
    t, position, _ = truth
    seconds = (t - t[0]) / 1e9
    at = (np.asarray(stamps_ns, dtype=np.int64) - t[0]) / 1e9
    return np.stack([np.interp(at, seconds, position[:, k], left=np.nan, right=np.nan)
                     for k in range(3)], axis=1)


def pass_errors(log: PoseLog, truth: Truth, centre: FloatArray) -> PassErrors | None:
    """Horizontal errors of a vehicle's track within `NEAR_M` of `centre` (3,).

    None if no pose has a true position.
    """
    true = interpolate_truth(truth, log.stamp_ns)[:, :2]
    rows = near_poses(log, truth, centre)
    if not len(rows):
        return None
    error = np.array(log.position)[:, :2] - true
    magnitude = np.hypot(*error.T)
    distance = np.hypot(*(true - centre[:2]).T)
    closest = int(np.nanargmin(distance))
    near = distance[rows] < NEAR_M
    nees = [error[k] @ np.linalg.solve(log.covariance[k][:2, :2], error[k]) / 2 for k in rows]
    return {'rms': float(np.sqrt(np.mean(magnitude[rows] ** 2))) if near.all() else None,
            'closest': float(magnitude[closest]), 'closest_distance': float(distance[closest]),
            'anees': float(np.mean(nees)), 'n': int(near.sum())}


class UnflaggedPoses(TypedDict):
    """Counts of poses without the ambiguous flag: with a truth, wrong ones, without a truth."""

    n: int
    wrong: int
    without_truth: int


WRONG_M, WRONG_STD = 2.0, 3.0
"""A pose is wrong if its horizontal error exceeds this distance [m], and these stds along it."""


def unflagged_poses(logs: Iterable[TrackLog], truths: Iterable[Truth]) -> UnflaggedPoses:
    """Count the vehicle poses without the ambiguous flag, and the wrong poses among them.

    A pose is wrong if its error exceeds `WRONG_M` and `WRONG_STD` standard deviations for every
    target whose truth covers the time of the pose.
    """
    truths, n, n_wrong, n_without = list(truths), 0, 0, 0
    for log in logs:
        is_unflagged = ~np.array(log.ambiguous, dtype=bool)
        if not is_unflagged.any():
            continue
        stamps = np.array(log.stamp_ns, dtype=np.int64)[is_unflagged]
        position = np.array(log.position)[is_unflagged][:, :2]
        P = np.array(log.covariance)[is_unflagged][:, :2, :2]
        has_truth, wrong = np.zeros(len(stamps), dtype=bool), np.ones(len(stamps), dtype=bool)
        for truth in truths:
            error = position - interpolate_truth(truth, stamps)[:, :2]
            is_covered = np.isfinite(error).all(axis=1)
            error = np.where(is_covered[:, None], error, 0.0)
            magnitude = np.hypot(*error.T)
            std = np.sqrt(np.einsum('ni,nij,nj->n', error, P, error)) / np.maximum(magnitude, 1e-9)
            has_truth |= is_covered
            wrong &= ~is_covered | (magnitude > WRONG_M) & (magnitude > WRONG_STD * std)
        n, n_wrong = n + int(has_truth.sum()), n_wrong + int((has_truth & wrong).sum())
        n_without += int((~has_truth).sum())
    return {'n': n, 'wrong': n_wrong, 'without_truth': n_without}


def near_poses(log: PoseLog, truth: Truth, centre: FloatArray) -> IntArray:
    """Indices (k,) of the poses whose true position is horizontally within `NEAR_M` of `centre`.

    If there are none, the index of the closest pose; empty if no pose has a true position.
    """
    true = interpolate_truth(truth, log.stamp_ns)[:, :2]
    has_truth = np.isfinite(true).all(axis=1)
    if not has_truth.any():
        return np.zeros(0, dtype=int)
    distance = np.where(has_truth, np.hypot(*(true - centre[:2]).T), np.inf)
    near = np.flatnonzero(distance < NEAR_M)
    return near if len(near) else np.array([np.argmin(distance)])


MAGNET_SKIP = 3
"""Number of poses at the start of a magnet's track that are not evaluated."""


def magnet_errors(log: PoseLog, truth: Truth, axis: ArrayLike = (0.0, 0.0, 1.0),
                  skip: int = MAGNET_SKIP) -> MagnetErrors | None:
    """Errors of a magnet's track, relative to the truth nearest in time.

    `axis` (3,) is the direction of the moment in the frame of the magnet. The first `skip` poses
    are not evaluated; None if there are no others.
    """
    stamps = np.array(log.stamp_ns, dtype=np.int64)[skip:]
    if not len(stamps):
        return None
    nearest = np.abs(truth[0][None, :] - stamps[:, None]).argmin(axis=1)
    error = np.array(log.position)[skip:] - truth[1][nearest]
    has_axis = np.isfinite(truth[2][nearest]).all(axis=1)
    true_axis = rotation_from_quaternion(truth[2][nearest][has_axis]) \
        @ np.asarray(axis, dtype=float)
    moment = np.array(log.moment)[skip:][has_axis]
    cosine = np.einsum('ni,ni->n', moment, true_axis) / (
        np.linalg.norm(moment, axis=1) * np.linalg.norm(true_axis, axis=1))
    C = np.array(log.covariance)[skip:, :3, :3]
    nees = np.einsum('ni,ni->n', error, np.linalg.solve(C, error[:, :, None])[:, :, 0]) / 3
    magnitude = np.linalg.norm(error, axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return {'position_mean': float(magnitude.mean()), 'position_max': float(magnitude.max()),
            'axis_median_deg': float(np.median(angle)) if len(angle) else None,
            'anees': float(nees.mean()), 'n': len(stamps)}


MIN_VELOCITY_STD = 1e-9
"""[m/s] Minimum standard deviation of the velocity prior, for targets at rest."""


def error_over_bound(network: SensorNetwork, log: TrackLog,
                     truth: Truth, acceleration: FloatArray,
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
