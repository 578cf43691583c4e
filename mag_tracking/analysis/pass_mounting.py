"""Sensor orientations from the mounting angles that tracks estimate.

Each track estimates the mounting errors with the same prior, that of the network. The information
that each track adds to the prior is independent and is summed. The result is weaker than a
calibration with a known target, since the model errors of vehicles are similar in all passes of
one lane.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Track

MIN_SHARE = 0.05
"""Minimum information in a direction relative to the best direction of the track. Weaker directions
are not compared between tracks."""


@dataclass(frozen=True)
class MountingEvidence:
    """Sensor orientations fused from tracks."""

    rotation: FloatArray
    """(n_sensors, 3) [rad] small rotations about the world axes that correct the orientations of
    the network."""
    covariance: FloatArray
    """(n_sensors, 3, 3) [rad²] of `rotation`, world axes."""
    scatter: FloatArray
    """(n_sensors,) mean squared normalised difference between the tracks; one if their covariances
    are consistent, NaN with fewer than two tracks. If it exceeds one, the covariance is scaled by
    it."""
    n_tracks: int


def fuse_mounting(network: SensorNetwork, prior_std: Iterable[FloatArray],
                  tracks: Sequence[Track]) -> MountingEvidence:
    """Fuse the mounting angles of tracks into one estimate of the sensor orientations.

    Parameters
    ----------
    network : SensorNetwork
        The network that the tracks were made with.
    prior_std : iterable of n_sensors (3,) array, rad
        Prior standard deviations of the tracks, about the world axes.
    tracks : sequence of Track
        The last unambiguous pose of each target, with mounting angles.

    Returns
    -------
    MountingEvidence

    Raises
    ------
    ValueError
        If a track has no mounting angles, or those of another number of sensors.
    """
    n = len(network)
    prior = np.array([np.diag(1.0 / np.square(std)) for std in prior_std])
    gains: list[FloatArray] = []
    pulls: list[FloatArray] = []
    for track in tracks:
        if len(track.mounting) != n:
            raise ValueError(f'track {track.id} has mounting angles of {len(track.mounting)} '
                             f'sensors, expected {n}')
        # The angles rotate the field in the sensor frame; the sensor is rotated the other way.
        rotation = -np.einsum('jik,jk->ji', network.R_ws, track.mounting)
        P = network.R_ws @ track.mounting_covariance @ network.R_sw
        information = np.linalg.inv(P)
        gains.append(_nonnegative(information - prior))
        # The prior mean is zero and adds nothing to the information vector.
        pulls.append(np.einsum('jik,jk->ji', information, rotation))
    total = prior + np.sum(gains, axis=0) if gains else prior
    covariance = np.linalg.inv(total)
    rotation = np.einsum('jik,jk->ji', covariance, np.sum(pulls, axis=0)) if pulls \
        else np.zeros((n, 3))
    scatter = _scatter(gains, pulls, rotation, covariance) if len(tracks) > 1 \
        else np.full(n, np.nan)
    widen = np.maximum(1.0, np.nan_to_num(scatter, nan=1.0))
    information = prior + (total - prior) / widen[:, None, None]
    covariance = np.linalg.inv(information)
    if pulls:
        rotation = np.einsum('jik,jk->ji', covariance,
                         np.sum(pulls, axis=0) / widen[:, None])
    return MountingEvidence(rotation, covariance, scatter, len(tracks))


def _nonnegative(information: FloatArray) -> FloatArray:
    """Information (n_sensors, 3, 3) without negative eigenvalues from rounding or linearisation."""
    values, vectors = np.linalg.eigh(information)
    kept: FloatArray = np.einsum('jik,jk,jlk->jil', vectors, np.maximum(values, 0.0), vectors)
    return kept


def _scatter(gains: Sequence[FloatArray], pulls: Sequence[FloatArray], rotation: FloatArray,
             covariance: FloatArray) -> FloatArray:
    """Mean squared normalised difference (n_sensors,) between each track and the fused estimate."""
    squares, freedom = np.zeros(len(rotation)), np.zeros(len(rotation))
    for gain, pull in zip(gains, pulls, strict=True):
        off = pull - np.einsum('jik,jk->ji', gain, rotation)
        inverse = np.linalg.pinv(gain, rcond=MIN_SHARE, hermitian=True)
        squares += np.einsum('ji,jik,jk->j', off, inverse, off)
        # Degrees of freedom: the fused estimate contains the track itself.
        projection = inverse @ gain
        freedom += np.einsum('jii->j', projection - projection @ covariance @ gain)
    scatter: FloatArray = np.divide(squares, freedom, out=np.full(len(rotation), np.nan),
                                    where=freedom > 1e-3)
    return scatter


def with_evidence(network: SensorNetwork, evidence: MountingEvidence) -> SensorNetwork:
    """Correct the orientations of a network.

    Parameters
    ----------
    network : SensorNetwork
    evidence : MountingEvidence

    Returns
    -------
    SensorNetwork
        With the standard deviations of the evidence.
    """
    turns = rotation_from_quaternion(quaternion_from_rotation_vector(evidence.rotation))
    std = np.sqrt(np.einsum('jii->ji', evidence.covariance))
    return replace(network, R_ws=turns @ network.R_ws, orientation_std=tuple(std))
