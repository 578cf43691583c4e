"""Tracks against truth: errors, and whether the covariance told the truth about them."""

from collections.abc import Iterable
from typing import TypeAlias, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.geometry import rotation_from_quaternion
from mag_tracking.report.track_log import SmoothedLog, TrackLog

Truth: TypeAlias = tuple[IntArray, FloatArray, FloatArray]
"""Stamps (n,) [ns], positions (n, 3) [m], quaternions (n, 4) xyzw."""


class PassErrors(TypedDict):
    """What `pass_errors` returns."""

    rms: float | None
    closest: float
    closest_distance: float
    anees: float
    n: int


class MagnetErrors(TypedDict):
    """What `magnet_errors` returns."""

    position_mean: float
    position_max: float
    axis_median_deg: float
    anees: float
    n: int


def interpolate_truth(truth: Truth, stamps_ns: ArrayLike) -> FloatArray:
    """Positions (n, 3) of `truth` (stamps, positions, quaternions) at `stamps_ns`; NaN outside."""
    t, position, _ = truth
    seconds = (t - t[0]) / 1e9
    at = (np.asarray(stamps_ns, dtype=np.int64) - t[0]) / 1e9
    return np.stack([np.interp(at, seconds, position[:, k], left=np.nan, right=np.nan)
                     for k in range(3)], axis=1)


def pass_errors(log: TrackLog | SmoothedLog, truth: Truth, centre: FloatArray,
                radius: float = 5.0) -> PassErrors | None:
    """Errors of a vehicle's track.

    Parameters
    ----------
    log : TrackLog
    truth : (stamps (n,), positions (n, 3), quaternions (n, 4))
    centre : (3,) [m]
        The pass is measured about this point.
    radius : float [m]

    Returns
    -------
    dict
        rms : horizontal RMS error within `radius` of the centre, None if it was
        never there; closest : error at the closest point; closest_distance;
        anees : mean of NEES / 2 over the same poses (or the closest one); n.
        None where the track has no truth.
    """
    true = interpolate_truth(truth, log.stamp_ns)[:, :2]
    rows = near_poses(log, truth, centre, radius)
    if not len(rows):
        return None
    error = np.array(log.position)[:, :2] - true
    size = np.hypot(*error.T)
    distance = np.hypot(*(true - centre[:2]).T)
    closest = int(np.nanargmin(distance))
    near = distance[rows] < radius
    nees = [error[k] @ np.linalg.solve(log.covariance[k][:2, :2], error[k]) / 2 for k in rows]
    return {'rms': float(np.sqrt(np.mean(size[rows] ** 2))) if near.all() else None,
            'closest': float(size[closest]), 'closest_distance': float(distance[closest]),
            'anees': float(np.mean(nees)), 'n': int(near.sum())}


class UnflaggedPoses(TypedDict):
    """What `unflagged_poses` returns."""

    n: int
    wrong: int
    without_truth: int


WRONG_M, WRONG_STD = 2.0, 3.0
"""A pose is wrong whose horizontal error is larger than this, and than so many standard deviations
in its direction."""


def unflagged_poses(logs: Iterable[TrackLog], truths: Iterable[Truth]) -> UnflaggedPoses:
    """Poses of vehicles that are not flagged as ambiguous, and how many of them are wrong.

    Parameters
    ----------
    logs : iterable of TrackLog
    truths : iterable of (stamps (n,), positions (n, 3), quaternions (n, 4))
        A pose is wrong if it is wrong about every one that was there at its time.

    Returns
    -------
    dict
        n : poses without a flag at whose time there is a true one; wrong : of them;
        without_truth : poses without a flag at whose time there is none.
    """
    truths, n, n_wrong, n_without = list(truths), 0, 0, 0
    for log in logs:
        sure = ~np.array(log.ambiguous, dtype=bool)
        if not sure.any():
            continue
        stamps = np.array(log.stamp_ns, dtype=np.int64)[sure]
        position = np.array(log.position)[sure][:, :2]
        P = np.array(log.covariance)[sure][:, :2, :2]
        known, wrong = np.zeros(len(stamps), dtype=bool), np.ones(len(stamps), dtype=bool)
        for truth in truths:
            error = position - interpolate_truth(truth, stamps)[:, :2]
            there = np.isfinite(error).all(axis=1)
            error = np.where(there[:, None], error, 0.0)
            size = np.hypot(*error.T)
            std = np.sqrt(np.einsum('ni,nij,nj->n', error, P, error)) / np.maximum(size, 1e-9)
            known |= there
            wrong &= ~there | (size > WRONG_M) & (size > WRONG_STD * std)
        n, n_wrong = n + int(known.sum()), n_wrong + int((known & wrong).sum())
        n_without += int((~known).sum())
    return {'n': n, 'wrong': n_wrong, 'without_truth': n_without}


def near_poses(log: TrackLog | SmoothedLog, truth: Truth, centre: FloatArray,
               radius: float = 5.0) -> IntArray:
    """Indices (k,) of the poses whose truth is within `radius` [m] of `centre`.

    The closest one where it was never there; none without truth.
    """
    true = interpolate_truth(truth, log.stamp_ns)[:, :2]
    known = np.isfinite(true).all(axis=1)
    if not known.any():
        return np.zeros(0, dtype=int)
    distance = np.where(known, np.hypot(*(true - centre[:2]).T), np.inf)
    near = np.flatnonzero(distance < radius)
    return near if len(near) else np.array([np.argmin(distance)])


MAGNET_SKIP = 3
"""Poses at the start of a magnet's track that do not count."""


def magnet_errors(log: TrackLog | SmoothedLog, truth: Truth, axis: ArrayLike = (0.0, 0.0, 1.0),
                  skip: int = MAGNET_SKIP) -> MagnetErrors | None:
    """Errors of a magnet's track, each pose against the truth nearest in time.

    Parameters
    ----------
    log : TrackLog
    truth : (stamps (n,), positions (n, 3), quaternions (n, 4))
    axis : (3,)
        Direction of the moment in the magnet's frame.
    skip : int
        Poses at the start that do not count.

    Returns
    -------
    dict
        position_mean, position_max [m], axis_median_deg, anees (3 axes), n;
        None with no pose left.
    """
    stamps = np.array(log.stamp_ns, dtype=np.int64)[skip:]
    if not len(stamps):
        return None
    nearest = np.abs(truth[0][None, :] - stamps[:, None]).argmin(axis=1)
    error = np.array(log.position)[skip:] - truth[1][nearest]
    true_axis = rotation_from_quaternion(truth[2][nearest]) @ np.asarray(axis, dtype=float)
    moment = np.array(log.moment)[skip:]
    cosine = np.einsum('ni,ni->n', moment, true_axis) / (
        np.linalg.norm(moment, axis=1) * np.linalg.norm(true_axis, axis=1))
    C = np.array(log.covariance)[skip:, :3, :3]
    nees = np.einsum('ni,ni->n', error, np.linalg.solve(C, error[:, :, None])[:, :, 0]) / 3
    size = np.linalg.norm(error, axis=1)
    return {'position_mean': float(size.mean()), 'position_max': float(size.max()),
            'axis_median_deg': float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))),
            'anees': float(nees.mean()), 'n': len(stamps)}
