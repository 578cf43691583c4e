"""Sensor orientations from the mounting angles estimated by tracks.

The prior of the mounting errors is common to all tracks. The information that a track adds to the
prior is independent of other tracks and is summed over all tracks. The result is less accurate than
a calibration with a known target, because vehicle model errors are similar in all passes of a lane.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Track

MIN_INFORMATION_FRACTION = 0.05
"""Minimum information about a direction, relative to the best-known direction of the track.
Directions with less information are not compared between tracks."""


@dataclass(frozen=True)
class MountingEvidence:
    """Corrections of the sensor orientations, fused from tracks."""

    rotation: FloatArray
    """(n_sensors, 3) [rad] small rotations about the world axes, which correct the orientations."""
    covariance: FloatArray
    """(n_sensors, 3, 3) [rad²] covariance of `rotation`, world axes."""
    scatter: FloatArray
    """(n_sensors,) chi-square per degree of freedom of the tracks relative to `rotation`. About one
    if the track covariances are consistent; NaN for fewer than two tracks. Values above one scale
    the covariance."""
    n_tracks: int
    """Number of fused tracks."""


def fuse_mounting(network: SensorNetwork, prior_std: Iterable[FloatArray],
                  tracks: Sequence[Track]) -> MountingEvidence:
    """Fuse the mounting angles that the last unambiguous poses of tracks estimate.

    `prior_std` (3,) [rad] are about the world axes. Raises ValueError for a track with mounting
    angles of another number of sensors.
    """
    n = len(network)
    prior = np.array([np.diag(1.0 / np.square(std)) for std in prior_std])
    gains: list[FloatArray] = []
    information_vectors: list[FloatArray] = []
    for track in tracks:
        if len(track.mounting) != n:
            raise ValueError(f'track {track.id} has mounting angles of {len(track.mounting)} '
                             f'sensors, expected {n}')
        # The angles rotate the field in the sensor frame; the sensor has the inverse rotation.
        rotation = -np.einsum('jik,jk->ji', network.R_ws, track.mounting)
        P = network.R_ws @ track.mounting_covariance @ network.R_sw
        information = np.linalg.inv(P)
        gains.append(_remove_negative_eigenvalues(information - prior))
        # The prior mean is zero and adds nothing to the information vector.
        information_vectors.append(np.einsum('jik,jk->ji', information, rotation))
    total_information = prior + np.sum(gains, axis=0) if gains else prior
    covariance = np.linalg.inv(total_information)
    rotation = np.einsum('jik,jk->ji', covariance, np.sum(information_vectors, axis=0)) \
        if information_vectors else np.zeros((n, 3))
    scatter = _track_scatter(gains, information_vectors, rotation, covariance) if len(tracks) > 1 \
        else np.full(n, np.nan)
    inflation = np.maximum(1.0, np.nan_to_num(scatter, nan=1.0))
    information = prior + (total_information - prior) / inflation[:, None, None]
    covariance = np.linalg.inv(information)
    if information_vectors:
        rotation = np.einsum('jik,jk->ji', covariance,
                             np.sum(information_vectors, axis=0) / inflation[:, None])
    return MountingEvidence(rotation, covariance, scatter, len(tracks))


def _remove_negative_eigenvalues(information: FloatArray) -> FloatArray:
    """Return the information (n_sensors, 3, 3) with negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(information)
    clipped: FloatArray = np.einsum('jik,jk,jlk->jil', vectors, np.maximum(values, 0.0), vectors)
    return clipped


def _track_scatter(gains: Sequence[FloatArray], information_vectors: Sequence[FloatArray],
                   rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Chi-square per degree of freedom (n_sensors,) of single tracks about the fused angles; NaN
    without degrees of freedom."""
    squares, freedom = np.zeros(len(rotation)), np.zeros(len(rotation))
    for gain, information_vector in zip(gains, information_vectors, strict=True):
        residual = information_vector - np.einsum('jik,jk->ji', gain, rotation)
        inverse = np.linalg.pinv(gain, rcond=MIN_INFORMATION_FRACTION, hermitian=True)
        squares += np.einsum('ji,jik,jk->j', residual, inverse, residual)
        # The fused estimate includes the track, which reduces the degrees of freedom.
        projection = inverse @ gain
        freedom += np.einsum('jii->j', projection - projection @ covariance @ gain)
    scatter: FloatArray = np.divide(squares, freedom, out=np.full(len(rotation), np.nan),
                                    where=freedom > 1e-3)
    return scatter


def with_pass_mounting(network: SensorNetwork, evidence: MountingEvidence) -> SensorNetwork:
    """Copy the network with orientations and their stds corrected by fused mounting angles."""
    corrections = rotation_from_quaternion(quaternion_from_rotation_vector(evidence.rotation))
    std = np.sqrt(np.einsum('jii->ji', evidence.covariance))
    return replace(network, R_ws=corrections @ network.R_ws, orientation_std=tuple(std))
