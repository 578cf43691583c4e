"""From a bank to what is published: the best hypothesis, its pose and its honest doubts."""

from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Protocol, TypeAlias, TypedDict

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.geometry import (
    cross_matrix,
    quaternion_between,
    quaternions_from_yaw,
    rotation_vectors_between,
)
from mag_tracking.inference.covariance_union import inflated_to_cover
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.mixture import second_moment
from mag_tracking.physics.sources import SourceModel
from mag_tracking.records import Hypotheses, PoseUncertainty, SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.settings import BEST, MIXTURE
from mag_tracking.stages.track.unobserved_length import UnobservedLength

UNOBSERVED_VARIANCE = np.pi**2
"""[rad^2] of an angle that the field does not determine."""

NO_WEIGHT = 1e-6
"""Hypotheses lighter than the heaviest by this ratio add nothing to a covariance."""

DOUBT = 0.05
"""Other places, or other arrivals, with more weight than this make a track ambiguous."""


Flags: TypeAlias = tuple[bool, bool, bool]
"""Which rotations about the body's x, y, z are not observed."""

OrientationEstimate: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, Flags]
"""Quaternion, derivative, unobserved variance and flags; see `VehicleOrientation`."""


class Orientation(Protocol):
    """How a target's orientation follows from its state; see `VehicleOrientation`."""

    def __call__(self, x: FloatArray, P: FloatArray) -> OrientationEstimate:
        """Quaternion, derivative, unobserved variance and flags."""

    def quaternions(self, x: FloatArray) -> FloatArray:
        """Quaternions (n, 4) of states (n, n_t)."""


class PoseFields(TypedDict):
    """The fields that a `Track` and a `SmoothedPose` have in common and a state determines."""

    position: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    orientation: FloatArray
    orientation_covariance: FloatArray
    position_orientation_covariance: FloatArray
    moment: FloatArray
    moment_covariance: FloatArray
    length: float
    length_std: float


class VehicleOrientation:
    """Heading of the velocity; roll and pitch are not observed."""

    def __call__(self, x: FloatArray, P: FloatArray) -> OrientationEstimate:
        """Of one state.

        Parameters
        ----------
        x : (n_t,), P : (n_t, n_t)
            A target state that begins with position and velocity.

        Returns
        -------
        q : (4,) xyzw
        T : (3, n_t)
            Derivative of the small rotation about world axes by the state.
        unobserved : (3, 3)
            Variance of what is not observed, to be added.
        flags : (3,) bool
            Body x, y, z.
        """
        speed2 = x[3] ** 2 + x[4] ** 2
        T = np.zeros((3, len(x)))
        if speed2 > 0.0:
            T[2, 3], T[2, 4] = -x[4] / speed2, x[3] / speed2
        yaw_known = speed2 > 0.0 and T[2] @ P @ T[2] < UNOBSERVED_VARIANCE
        if not yaw_known:
            T[:] = 0.0
        unobserved = np.diag([1.0, 1.0, 0.0 if yaw_known else 1.0]) * UNOBSERVED_VARIANCE
        return self.quaternions(x[None])[0], T, unobserved, (True, True, not yaw_known)

    def quaternions(self, x: FloatArray) -> FloatArray:
        """Quaternions (n, 4) of states (n, n_t)."""
        return quaternions_from_yaw(np.arctan2(x[:, 4], x[:, 3]))


@dataclass(frozen=True)
class MagnetOrientation:
    """Direction of the moment; the roll about it is not observed."""

    axis: FloatArray
    """(3,) direction of the moment in the magnet's own frame. The flag of what is not observed goes
    to the body axis nearest to it."""

    def __call__(self, x: FloatArray, P: FloatArray) -> OrientationEstimate:
        """Of one state, as that of a vehicle."""
        m = x[6:9]
        size2 = m @ m
        T = np.zeros((3, len(x)))
        # dm = w x m gives the part of w across m: w = m x dm / |m|^2.
        T[:, 6:9] = cross_matrix(m) / size2
        along = np.outer(m, m) / size2
        nearest = int(np.argmax(np.abs(self.axis)))
        return (quaternion_between(self.axis, m), T, UNOBSERVED_VARIANCE * along,
                (nearest == 0, nearest == 1, nearest == 2))

    def quaternions(self, x: FloatArray) -> FloatArray:
        """Quaternions (n, 4) of states (n, n_t)."""
        return np.array([quaternion_between(self.axis, m) for m in x[:, 6:9]])


def published_track(bank: FilterBank, best: int, model: SourceModel, orientation: Orientation,
                    names: Sequence[str], kinds: Sequence[str], found: Set[str],
                    unseen: UnobservedLength | None, *, excess: float = 1.0,
                    ambiguous_poses: str = MIXTURE, difference: FloatArray,
                    stamp_ns: int, id: int, ended: bool, existence: float,
                    degrees_of_freedom: int, predicted: FloatArray, mounting: FloatArray,
                    mounting_covariance: FloatArray) -> Track:
    """The `Track` of a bank's hypothesis `best`.

    Parameters
    ----------
    bank : FilterBank
    best : int
        Row of the hypothesis to publish.
    model : SourceModel
    orientation : function
        Takes state and covariance of the target, as `VehicleOrientation`.
    names : sequence of str
        The arrival of each label.
    kinds : sequence of str
        The name of each kind.
    found : set of str
        What speaks against the pose, of `doubts`; the bank's own ambiguity is added.
    unseen : UnobservedLength, optional
        How the length of a vehicle moves its middle; None for a small target.
    excess : float
        The innovations are this many times larger than stated: so is the covariance, then.
    ambiguous_poses : str
        `track.ambiguous_poses`.
    difference : (6,) [m], [m/s]
        The target may as well be so far from the published position and velocity; the covariance
        covers that.
    stamp_ns, id, ended, existence, degrees_of_freedom, predicted, mounting, mounting_covariance
        Fields of `Track` that the bank does not know.
    """
    n_t = len(model.state_names)
    apart = bank.apart(best)
    P = covariance_about(bank, best, model, apart)
    said, flags = _said_of(model, orientation, bank.x[best, :n_t], excess * P,
                           int(bank.kind[best]), unseen, difference)
    reasons = doubts.ordered({*found, *ambiguities(bank, best, apart)})
    uncertainty: PoseUncertainty | None = own_uncertainty(said)
    if reasons and ambiguous_poses != BEST:
        uncertainty = mixture_uncertainty(bank, best, apart, model, orientation, said, P, excess) \
            if ambiguous_poses == MIXTURE else None
    weights = np.exp(bank.log_w)
    moments = model.dipoles(bank.x[:, :n_t]).m.sum(axis=1)
    order = np.argsort(-bank.log_w, kind='stable')
    hypotheses = Hypotheses(
        tuple(names[k] for k in bank.label[order].tolist()), weights[order], bank.x[order, :6],
        bank.P[order, :6, :6], moments[order], tuple(kinds[k] for k in bank.kind[order].tolist()))
    nis = bank.nis[best]
    return Track(
        stamp_ns=stamp_ns, id=id, ended=ended, existence=existence,
        degrees_of_freedom=degrees_of_freedom, predicted=predicted, mounting=mounting,
        mounting_covariance=mounting_covariance,
        nis=float('nan') if np.isnan(nis).all() else float(np.nansum(nis)),
        nis_by_sensor=nis.copy(), weight=float(weights[best]), arrival=names[bank.label[best]],
        kind=kinds[bank.kind[best]],
        kind_weight=float(weights.sum(where=bank.kind == bank.kind[best])),
        ambiguous=bool(reasons), doubts=reasons,
        unobservable=(False, False, False, *flags), hypotheses=hypotheses,
        topic_uncertainty=uncertainty, **said)


def covariance_about(bank: FilterBank, best: int, model: SourceModel, apart: BoolArray
                     ) -> FloatArray:
    """Covariance (n_t, n_t) about the state of hypothesis `best`, of all that are not `apart`.

    Hypotheses that are not apart differ by where each was linearised, by the kind of target and by
    its motion; that they do is part of the error. Those that are apart make the track ambiguous.
    """
    return _second_moment(bank, best, model, np.where(apart, -np.inf, bank.log_w))


def _second_moment(bank: FilterBank, best: int, model: SourceModel,
                   log_w: FloatArray) -> FloatArray:
    """As `covariance_about`, of the hypotheses by their log-weights (n_hyp,)."""
    n_t = len(model.state_names)
    weight = np.exp(log_w - log_w.max())
    rows = np.flatnonzero(weight >= NO_WEIGHT)
    x = bank.x[rows, :n_t]
    difference = x - bank.x[best, :n_t]
    if 'L' in model.state_names:
        # From its other end it is the same row.
        L = model.state_names.index('L')
        difference[:, L] = np.abs(x[:, L]) - abs(bank.x[best, L])
    return second_moment(weight[rows], difference, bank.P[rows, :n_t, :n_t])


def mixture_uncertainty(bank: FilterBank, best: int, apart: BoolArray, model: SourceModel,
                        orientation: Orientation, here: PoseFields, P_here: FloatArray,
                        excess: float = 1.0) -> PoseUncertainty:
    """Uncertainty about the pose of hypothesis `best`, where each hypothesis may be right.

    Parameters
    ----------
    bank : FilterBank
    best : int
    apart : (n_hyp,) bool
        `FilterBank.apart` of it.
    model : SourceModel
    orientation : function
    here : PoseFields
        As published of the hypotheses at this place.
    P_here : (n_t, n_t) array
        `covariance_about` before it was widened to `here`.
    excess : float
        As for `published_track`.
    """
    n_t = len(model.state_names)
    widening = here['covariance'] - excess * P_here[:6, :6]
    covariance = widening + excess * _second_moment(bank, best, model, bank.log_w)[:6, :6]
    # Headings may be opposite, and are too far apart for a derivative.
    log_w = np.where(apart, bank.log_w, -np.inf)
    rows = np.flatnonzero(log_w >= bank.log_w.max() + np.log(NO_WEIGHT))
    if not len(rows):
        return PoseUncertainty(covariance, here['orientation_covariance'],
                               here['position_orientation_covariance'])
    weight = np.exp(log_w[rows])
    turned = rotation_vectors_between(here['orientation'],
                                      orientation.quaternions(bank.x[rows, :n_t]))
    moved = bank.x[rows, :3] - bank.x[best, :3]
    return PoseUncertainty(
        covariance, here['orientation_covariance'] + np.einsum('n,ni,nj->ij', weight, turned,
                                                               turned),
        (1.0 - weight.sum()) * here['position_orientation_covariance']
        + np.einsum('n,ni,nj->ij', weight, moved, turned))


def own_uncertainty(said: PoseFields) -> PoseUncertainty:
    """Uncertainty of the published fields themselves."""
    return PoseUncertainty(said['covariance'], said['orientation_covariance'],
                           said['position_orientation_covariance'])


def ambiguities(bank: FilterBank, best: int, apart: BoolArray) -> set[str]:
    """Whether another place, or another arrival, than that of hypothesis `best` is possible.

    `apart` (n_hyp,) is `FilterBank.apart` of it.
    """
    found = set()
    if bank.weight(apart) > DOUBT:
        found.add(doubts.ANOTHER_PLACE)
    if 1.0 - np.exp(bank.log_w).sum(where=bank.label == bank.label[best]) > DOUBT:
        found.add(doubts.ANOTHER_ARRIVAL)
    return found


def smoothed_pose(model: SourceModel, orientation: Orientation, x: FloatArray, P: FloatArray, *,
                  unseen: UnobservedLength | None, difference: FloatArray, stamp_ns: int, id: int,
                  kind: int, kinds: Sequence[str], ambiguous: bool, complete: bool
                  ) -> SmoothedPose:
    """The `SmoothedPose` of a state `x` (n_x,) with covariance `P` (n_x, n_x).

    The other parameters are as for `published_track`.
    """
    n_t = len(model.state_names)
    return SmoothedPose(stamp_ns=stamp_ns, id=id, kind=kinds[kind], ambiguous=ambiguous,
                        complete=complete,
                        **_said_of(model, orientation, x[:n_t], P[:n_t, :n_t], kind, unseen,
                                   difference)[0])


def _said_of(model: SourceModel, orientation: Orientation, x: FloatArray, P: FloatArray,
             kind: int, unseen: UnobservedLength | None, difference: FloatArray
             ) -> tuple[PoseFields, Flags]:
    """What a target state says, as fields of a record, and which rotations it does not."""
    dipoles = model.dipoles(x[None])
    dm_dx = dipoles.dm_dx[0].sum(axis=0)
    length, length_std = 0.0, 0.0
    if 'L' in model.state_names:
        L = model.state_names.index('L')
        # From its other end it is the same row.
        length, length_std = abs(float(x[L])), float(np.sqrt(max(P[L, L], 0.0)))
    if unseen is not None:
        of_middle = unseen.covariance(x, P, length, kind)
        P = P.copy()
        P[:2, :2] += of_middle
    P = inflated_to_cover(P, difference)
    q, T, unobserved, flags = orientation(x, P)
    return {'position': x[:3].copy(), 'velocity': x[3:6].copy(), 'covariance': P[:6, :6].copy(),
            'orientation': q, 'orientation_covariance': T @ P @ T.T + unobserved,
            'position_orientation_covariance': P[:3] @ T.T,
            'moment': dipoles.m[0].sum(axis=0), 'moment_covariance': dm_dx @ P @ dm_dx.T,
            'length': length, 'length_std': length_std}, flags
