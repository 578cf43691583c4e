"""Published track of a bank: the best hypothesis, its pose, its covariance and its doubts."""

from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import TypeAlias, TypedDict

import numpy as np

from mag_tracking import geometry
from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.covariances import inflated_to_cover, second_moment
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.physics.bounds import are_possible
from mag_tracking.physics.sources import SourceModel
from mag_tracking.records import Hypotheses, PoseUncertainty, SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.initiation_vehicle import MAX_CAR_ROW
from mag_tracking.stages.track.sensor_selection import offset_from_nearest
from mag_tracking.stages.track.settings import BEST, MIXTURE

MIN_SPEED_STDS = 3.0
"""A vehicle has a heading if its speed exceeds this number of standard deviations."""
UNOBSERVED_VARIANCE = np.pi**2
"""[rad^2] Variance of an angle that is not observable from the field."""
NEGLIGIBLE_WEIGHT, AMBIGUOUS_WEIGHT = 1e-6, 0.05
"""Relative weight below which a hypothesis is excluded from covariances, and total weight of other
positions or arrival directions above which a track is ambiguous."""
Flags: TypeAlias = tuple[bool, bool, bool]
"""Whether the rotation about the x, y and z axis of the body is unobservable."""
OrientationEstimate: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, Flags]
"""Quaternion (4,), derivative (3, n_t) of the small rotation about the world axes with respect to
the target state, variance (3, 3) [rad²] of the unobservable part, to be added, and flags."""


class UnobservedLength:
    """Uncertainty of the middle of a vehicle due to the part that no sensor has observed yet.

    Until its rear has passed a sensor, an apparent car may be the engine of a truck. The iron of a
    long vehicle is at its engine, axles and load, so the row of dipoles is shorter than the
    vehicle: the rest is assumed to be behind it and, once observed, at either end. All kinds of
    vehicle, with `lengths` and `length_stds` in m, are equally frequent.
    """

    def __init__(self, lengths: Sequence[float], length_stds: Sequence[float]) -> None:
        self._lengths, self._stds = np.array(lengths), np.array(length_stds)
        self._forward: FloatArray = np.zeros(2)
        self._distance_travelled = -np.inf
        self._last_position: FloatArray = np.zeros(2)

    def update(self, x: FloatArray, P: FloatArray, positions: FloatArray, is_certain: bool) -> None:
        """Update the direction of travel and, if the position `is_certain`, the distance travelled;
        `positions` (n_sensors, 3) are those of the sensors that measured."""
        self._forward = self._direction(x, P)
        if not is_certain or not len(positions):
            return
        if self._distance_travelled > 0.0:
            # After the first sensor, the distance along the path is also valid in a turn.
            self._distance_travelled += float(np.linalg.norm(x[:2] - self._last_position))
        else:
            self._distance_travelled = float(offset_from_nearest(x[:2], positions) @ self._forward)
        self._last_position = x[:2].copy()

    def covariance(self, x: FloatArray, P: FloatArray, length: float, kind: int) -> FloatArray:
        """Covariance (2, 2) [m²] of the middle, in addition to that of the position."""
        half_hidden = 0.5 * (self._lengths - length)
        second_moment = np.maximum(half_hidden, 0.0)**2 + 0.25 * self._stds**2
        # A longer vehicle would have been observed once its middle has passed a sensor.
        is_possible = ((self._lengths > self._lengths[kind]) & (half_hidden > 0.0)
                       & (self._distance_travelled < half_hidden))
        variance = second_moment[is_possible].sum() / len(self._lengths)
        if self._lengths[kind] > MAX_CAR_ROW:
            is_sensed = self._distance_travelled >= half_hidden[kind]
            variance += second_moment[kind] / (3.0 if is_sensed else 1.0)
        forward = self._direction(x, P)
        covariance: FloatArray = variance * np.outer(forward, forward)
        return covariance

    def _direction(self, x: FloatArray, P: FloatArray) -> FloatArray:
        """Unit vector (2,) of the motion; the previous one if the target hardly moves."""
        speed = float(np.hypot(x[3], x[4]))
        is_moving = speed > MIN_SPEED_STDS * np.sqrt(max(0.0, P[3, 3] + P[4, 4]))
        return x[3:5] / speed if is_moving else self._forward


class PoseFields(TypedDict):
    """Entries of `Track` and `SmoothedPose` that are computed from a target state."""

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
    """Orientation along the velocity; roll and pitch are unobservable."""

    def __call__(self, x: FloatArray, P: FloatArray) -> OrientationEstimate:
        """Orientation of a target state `x` (n_t,) with covariance `P` (n_t, n_t)."""
        squared_speed = x[3] ** 2 + x[4] ** 2
        T = np.zeros((3, len(x)))
        if squared_speed > 0.0:
            T[2, 3], T[2, 4] = -x[4] / squared_speed, x[3] / squared_speed
        is_yaw_known = squared_speed > 0.0 and T[2] @ P @ T[2] < UNOBSERVED_VARIANCE
        if not is_yaw_known:
            T[:] = 0.0
        unobserved = np.diag([1.0, 1.0, 0.0 if is_yaw_known else 1.0]) * UNOBSERVED_VARIANCE
        return self.quaternions(x[None])[0], T, unobserved, (True, True, not is_yaw_known)

    def quaternions(self, x: FloatArray) -> FloatArray:
        """Quaternions (n, 4) of states (n, n_t)."""
        return geometry.quaternions_from_yaw(np.arctan2(x[:, 4], x[:, 3]))


@dataclass(frozen=True)
class MagnetOrientation:
    """Orientation along the moment; the rotation about the moment is unobservable."""

    axis: FloatArray
    """(3,) Direction of the moment in the frame of the magnet."""

    def __call__(self, x: FloatArray, P: FloatArray) -> OrientationEstimate:
        """Orientation of a target state `x` (n_t,)."""
        m = x[6:9]
        squared_norm = m @ m
        T = np.zeros((3, len(x)))
        # dm = w x m determines the part of w perpendicular to m: w = m x dm / |m|^2.
        T[:, 6:9] = geometry.cross_matrix(m) / squared_norm
        along = np.outer(m, m) / squared_norm
        nearest = int(np.argmax(np.abs(self.axis)))
        return (geometry.quaternion_between(self.axis, m), T, UNOBSERVED_VARIANCE * along,
                (nearest == 0, nearest == 1, nearest == 2))

    def quaternions(self, x: FloatArray) -> FloatArray:
        """Quaternions (n, 4) of states (n, n_t)."""
        return np.array([geometry.quaternion_between(self.axis, m) for m in x[:, 6:9]])


Orientation: TypeAlias = VehicleOrientation | MagnetOrientation
"""Function that computes the orientation from a target state."""


def published_track(bank: FilterBank, best: int, model: SourceModel, orientation: Orientation,
                    arrivals: Sequence[str], kinds: Sequence[str], found: Set[str],
                    unobserved_length: UnobservedLength | None, *, excess: float = 1.0,
                    ambiguous_poses: str = MIXTURE, difference: FloatArray,
                    stamp_ns: int, id: int, ended: bool, existence: float,
                    degrees_of_freedom: int, predicted: FloatArray, mounting: FloatArray,
                    mounting_covariance: FloatArray) -> Track:
    """Track record of hypothesis `best`; the keywords from `stamp_ns` are entries of `Track`.

    `found` are the doubts without the ambiguities of the bank. The covariance is multiplied by
    `excess`, and covers the `difference` (6,) [m, m/s] from another possible state.
    """
    n_t = len(model.state_names)
    is_separated = bank.is_separated(best)
    P = covariance_about(bank, best, model, is_separated)
    fields, flags = _pose_fields(model, orientation, bank.x[best, :n_t], excess * P,
                                 int(bank.kind[best]), unobserved_length, difference)
    reasons = doubts.ordered({*found, *ambiguities(bank, best, is_separated)})
    uncertainty: PoseUncertainty | None = PoseUncertainty(
        fields['covariance'], fields['orientation_covariance'],
        fields['position_orientation_covariance'])
    if reasons and ambiguous_poses != BEST:
        uncertainty = mixture_uncertainty(
            bank, best, is_separated, model, orientation, fields, P, excess) \
            if ambiguous_poses == MIXTURE else None
    weights = np.exp(bank.log_w)
    moments = model.dipoles(bank.x[:, :n_t]).m.sum(axis=1)
    order = np.argsort(-bank.log_w, kind='stable')
    order = order[are_possible(bank.x[order, 3:6], moments[order])]
    hypotheses = Hypotheses(
        tuple(arrivals[k] for k in bank.label[order].tolist()), weights[order], bank.x[order, :6],
        bank.P[order, :6, :6], moments[order], tuple(kinds[k] for k in bank.kind[order].tolist()))
    nis = bank.nis[best]
    return Track(
        stamp_ns=stamp_ns, id=id, ended=ended, existence=existence,
        degrees_of_freedom=degrees_of_freedom, predicted=predicted, mounting=mounting,
        mounting_covariance=mounting_covariance,
        nis=float('nan') if np.isnan(nis).all() else float(np.nansum(nis)),
        nis_by_sensor=nis.copy(), weight=float(weights[best]), arrival=arrivals[bank.label[best]],
        kind=kinds[bank.kind[best]],
        kind_weight=float(weights.sum(where=bank.kind == bank.kind[best])),
        ambiguous=bool(reasons), doubts=reasons,
        unobservable=(False, False, False, *flags), hypotheses=hypotheses,
        topic_uncertainty=uncertainty, **fields)


def covariance_about(bank: FilterBank, best: int, model: SourceModel, is_separated: BoolArray
                     ) -> FloatArray:
    """Covariance (n_t, n_t) about the state of hypothesis `best` from all hypotheses at its
    position; those at others (`is_separated`) make the track ambiguous instead."""
    return _second_moment(bank, best, model, np.where(is_separated, -np.inf, bank.log_w))


def _second_moment(bank: FilterBank, best: int, model: SourceModel,
                   log_w: FloatArray) -> FloatArray:
    """Covariance about hypothesis `best`, from all hypotheses with log-weights `log_w` (n_hyp,)."""
    n_t = len(model.state_names)
    weight = np.exp(log_w - log_w.max())
    rows = np.flatnonzero(weight >= NEGLIGIBLE_WEIGHT)
    x = bank.x[rows, :n_t]
    difference = x - bank.x[best, :n_t]
    if 'L' in model.state_names:
        # A negative length describes the same row from its other end.
        L = model.state_names.index('L')
        difference[:, L] = np.abs(x[:, L]) - abs(bank.x[best, L])
    return second_moment(weight[rows], difference, bank.P[rows, :n_t, :n_t])


def mixture_uncertainty(bank: FilterBank, best: int, is_separated: BoolArray, model: SourceModel,
                        orientation: Orientation, published: PoseFields, P_unwidened: FloatArray,
                        excess: float) -> PoseUncertainty:
    """Uncertainty of a pose, `published` for hypothesis `best` with a wider covariance than
    `P_unwidened` of `covariance_about`, if any hypothesis may be correct."""
    n_t = len(model.state_names)
    widening = published['covariance'] - excess * P_unwidened[:6, :6]
    covariance = widening + excess * _second_moment(bank, best, model, bank.log_w)[:6, :6]
    # Headings may be opposite, for which a linearisation is invalid.
    log_w = np.where(is_separated, bank.log_w, -np.inf)
    rows = np.flatnonzero(log_w >= bank.log_w.max() + np.log(NEGLIGIBLE_WEIGHT))
    if not len(rows):
        return PoseUncertainty(covariance, published['orientation_covariance'],
                               published['position_orientation_covariance'])
    weight = np.exp(log_w[rows])
    rotations = geometry.rotation_vectors_between(
        published['orientation'], orientation.quaternions(bank.x[rows, :n_t]))
    displacement = bank.x[rows, :3] - bank.x[best, :3]
    return PoseUncertainty(
        covariance, published['orientation_covariance']
        + np.einsum('n,ni,nj->ij', weight, rotations, rotations),
        (1.0 - weight.sum()) * published['position_orientation_covariance']
        + np.einsum('n,ni,nj->ij', weight, displacement, rotations))


def ambiguities(bank: FilterBank, best: int, is_separated: BoolArray) -> set[str]:
    """Doubts about the position and the arrival direction of the best hypothesis."""
    arrival_weight = np.exp(bank.log_w).sum(where=bank.label == bank.label[best])
    return doubts.applying({
        doubts.ANOTHER_PLACE: bank.weight(is_separated) > AMBIGUOUS_WEIGHT,
        doubts.ANOTHER_ARRIVAL: 1.0 - arrival_weight > AMBIGUOUS_WEIGHT})


def smoothed_pose(model: SourceModel, orientation: Orientation, x: FloatArray, P: FloatArray, *,
                  unobserved_length: UnobservedLength | None, difference: FloatArray,
                  stamp_ns: int, id: int, kind: int, kinds: Sequence[str], ambiguous: bool,
                  complete: bool) -> SmoothedPose:
    """Record of a smoothed state; `difference` is as for `published_track`."""
    n_t = len(model.state_names)
    return SmoothedPose(stamp_ns=stamp_ns, id=id, kind=kinds[kind], ambiguous=ambiguous,
                        complete=complete,
                        **_pose_fields(model, orientation, x[:n_t], P[:n_t, :n_t], kind,
                                       unobserved_length, difference)[0])


def _pose_fields(model: SourceModel, orientation: Orientation, x: FloatArray, P: FloatArray,
                 kind: int, unobserved_length: UnobservedLength | None, difference: FloatArray
                 ) -> tuple[PoseFields, Flags]:
    """Compute the entries of a record, and the flags of unobservable rotations, from a state."""
    dipoles = model.dipoles(x[None])
    dm_dx = dipoles.dm_dx[0].sum(axis=0)
    length, length_std = 0.0, 0.0
    if 'L' in model.state_names:
        L = model.state_names.index('L')
        # A negative length describes the same row from its other end.
        length, length_std = abs(float(x[L])), float(np.sqrt(max(P[L, L], 0.0)))
    if unobserved_length is not None:
        middle_covariance = unobserved_length.covariance(x, P, length, kind)
        P = P.copy()
        P[:2, :2] += middle_covariance
    P = inflated_to_cover(P, difference)
    q, T, unobserved, flags = orientation(x, P)
    return {'position': x[:3].copy(), 'velocity': x[3:6].copy(), 'covariance': P[:6, :6].copy(),
            'orientation': q, 'orientation_covariance': T @ P @ T.T + unobserved,
            'position_orientation_covariance': P[:3] @ T.T,
            'moment': dipoles.m[0].sum(axis=0), 'moment_covariance': dm_dx @ P @ dm_dx.T,
            'length': length, 'length_std': length_std}, flags
