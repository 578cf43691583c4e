"""What tracks tell of how the sensors are turned: their mounting angles, folded into one answer.

Each track estimates the angles from the same prior, that of the network. What it adds to
the prior is its own; of several tracks these add up. Weaker than a calibration with a known
target: what the model leaves out of a vehicle is alike in all passes of one lane.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Track

MIN_SHARE = 0.05
"""A direction in which a track adds less than this share of what it adds in its best one is not
compared with what other tracks say."""


@dataclass(frozen=True)
class MountingEvidence:
    """What the tracks said."""

    turn: FloatArray
    """(n_sensors, 3) [rad] small rotations about the world's axes that take the orientations of
    the network to the better ones."""
    covariance: FloatArray
    """(n_sensors, 3, 3) [rad^2] of `turn`, world's axes."""
    scatter: FloatArray
    """(n_sensors,) how far the tracks differ among each other, against what they claim: mean of
    the squares, one when they claim what is true; NaN with fewer than two. Where it is above one
    the covariance has been widened by it."""
    n_tracks: int


def fold_mounting(network: SensorNetwork, prior_std: Iterable[FloatArray],
                  tracks: Sequence[Track]) -> MountingEvidence:
    """Fold the last poses of tracks into one estimate of the sensors' orientations.

    Parameters
    ----------
    network : SensorNetwork
        That the tracks were made with.
    prior_std : (n_sensors, 3) [rad]
        About the world's axes; what the tracks began with.
    tracks : list of Track
        With mounting angles; of each target the last pose that is not ambiguous.

    Returns
    -------
    MountingEvidence

    Raises ValueError for a track without mounting angles.
    """
    n = len(network)
    prior = np.array([np.diag(1.0 / np.square(std)) for std in prior_std])
    gains: list[FloatArray] = []
    pulls: list[FloatArray] = []
    for track in tracks:
        if len(track.mounting) != n:
            raise ValueError(f'track {track.id} has the mounting angles of {len(track.mounting)} '
                             f'sensors, not of {n}')
        # The angles turn the field, in the sensor's frame: the sensor is turned back.
        turn = -np.einsum('jik,jk->ji', network.R_ws, track.mounting)
        P = network.R_ws @ track.mounting_covariance @ network.R_sw
        information = np.linalg.inv(P)
        gains.append(_nonnegative(information - prior))
        # The prior pulls towards zero: what it does is the same in all.
        pulls.append(np.einsum('jik,jk->ji', information, turn))
    total = prior + np.sum(gains, axis=0) if gains else prior
    covariance = np.linalg.inv(total)
    turn = np.einsum('jik,jk->ji', covariance, np.sum(pulls, axis=0)) if pulls \
        else np.zeros((n, 3))
    scatter = _scatter(gains, pulls, turn, covariance) if len(tracks) > 1 else np.full(n, np.nan)
    widen = np.maximum(1.0, np.nan_to_num(scatter, nan=1.0))
    information = prior + (total - prior) / widen[:, None, None]
    covariance = np.linalg.inv(information)
    if pulls:
        turn = np.einsum('jik,jk->ji', covariance,
                         np.sum(pulls, axis=0) / widen[:, None])
    return MountingEvidence(turn, covariance, scatter, len(tracks))


def _nonnegative(information: FloatArray) -> FloatArray:
    """(n_sensors, 3, 3) without what rounding and the linearisation of the mean made negative."""
    values, vectors = np.linalg.eigh(information)
    kept: FloatArray = np.einsum('jik,jk,jlk->jil', vectors, np.maximum(values, 0.0), vectors)
    return kept


def _scatter(gains: Sequence[FloatArray], pulls: Sequence[FloatArray], turn: FloatArray,
             covariance: FloatArray) -> FloatArray:
    """(n_sensors,) mean square of what each track says against all, by what it claims."""
    squares, freedom = np.zeros(len(turn)), np.zeros(len(turn))
    for gain, pull in zip(gains, pulls, strict=True):
        off = pull - np.einsum('jik,jk->ji', gain, turn)
        inverse = np.linalg.pinv(gain, rcond=MIN_SHARE, hermitian=True)
        squares += np.einsum('ji,jik,jk->j', off, inverse, off)
        # What is compared, less what went into the answer that it is compared with.
        projection = inverse @ gain
        freedom += np.einsum('jii->j', projection - projection @ covariance @ gain)
    scatter: FloatArray = np.divide(squares, freedom, out=np.full(len(turn), np.nan),
                                    where=freedom > 1e-3)
    return scatter


def with_evidence(network: SensorNetwork, evidence: MountingEvidence) -> SensorNetwork:
    """The `SensorNetwork` turned by `MountingEvidence`, with its deviations."""
    turns = rotation_from_quaternion(quaternion_from_rotation_vector(evidence.turn))
    std = np.sqrt(np.einsum('jii->ji', evidence.covariance))
    return replace(network, R_ws=turns @ network.R_ws, orientation_std=tuple(std))
