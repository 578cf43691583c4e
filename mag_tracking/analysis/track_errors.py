"""Errors of tracks with respect to the truth, and consistency of their covariances."""

from collections.abc import Iterable
from typing import TypeAlias, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.analysis.track_log import PoseLog, TrackLog
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.geometry import rotation_from_quaternion

Truth: TypeAlias = tuple[IntArray, FloatArray, FloatArray]
"""Timestamps (n,) [ns], positions (n, 3) [m] and quaternions (n, 4) xyzw of a target; quaternions
are NaN if the orientation is unknown."""
NEAR_M = 5.0
"""Horizontal distance from the centre of the network within which vehicles are evaluated [m]."""


class PassErrors(TypedDict):
    """Errors of a vehicle's track, as returned by `pass_errors`."""

    rms: float | None
    """Horizontal RMS error of the poses within `NEAR_M` [m]; None if there are no such poses."""
    closest: float
    """Horizontal error of the pose whose true position is closest to the centre [m]."""
    closest_distance: float
    """Horizontal distance of this true position from the centre [m]."""
    anees: float
    """Mean NEES per axis of the poses within `NEAR_M`, or of the closest pose if no pose is
    within `NEAR_M`."""
    n: int
    """Number of poses whose true position is within `NEAR_M`."""


class MagnetErrors(TypedDict):
    """Errors of a magnet's track, as returned by `magnet_errors`."""

    position_mean: float
    """Mean position error [m]."""
    position_max: float
    """Maximum position error [m]."""
    axis_median_deg: float | None
    """Median angle between the estimated and the true axis [deg]; None if the truth has no
    orientations."""
    anees: float
    """Mean NEES per axis of the position."""
    n: int
    """Number of evaluated poses."""


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
    """Counts of poses that are not flagged as ambiguous, as returned by `unflagged_poses`."""

    n: int
    """Number of unflagged poses at times for which a true position is available."""
    wrong: int
    """Number of wrong poses among these poses."""
    without_truth: int
    """Number of unflagged poses at times for which no true position is available."""


WRONG_M, WRONG_STD = 2.0, 3.0
"""A pose is wrong if its horizontal error exceeds both this distance [m] and this number of
standard deviations in the direction of the error."""


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
