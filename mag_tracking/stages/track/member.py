"""One target of a running track: its evidence, its doubts and its published records."""

from collections import Counter, deque
from collections.abc import Iterable, Sequence

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.physics.bounds import impossible_reason
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.cross_check import ClockComparison, CrossCheck
from mag_tracking.stages.track.disturbances import UnexplainedField
from mag_tracking.stages.track.evidence import LOST, TrackEvidence
from mag_tracking.stages.track.joint import JointExplanation
from mag_tracking.stages.track.plausibility import Plausibility
from mag_tracking.stages.track.published_pose import ambiguities, published_track, smoothed_pose
from mag_tracking.stages.track.sensor_selection import SensorSubset
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.smoothing import TrackState
from mag_tracking.stages.track.target import Target
from mag_tracking.stages.track.track_bank import TrackBank

MAX_POSITIONS = 64
"""Maximum number of stored positions, which show which of two vehicles continues a track."""


class Member:
    """Target of a running track; updates the event counts of the track manager.

    `early` are smoothed states from before the target shared its state with others, and `slot` is
    its index in the joint states that are stored for smoothing.
    """

    def __init__(self, id: int, target: Target, sensors: SensorSubset, counts: 'Counter[str]',
                 clocks: ClockComparison, begin_ns: int) -> None:
        self.id, self._target, self._counts, self._clocks = id, target, counts, clocks
        self.begin_ns, self.cross_check = begin_ns, CrossCheck(sensors.network)
        self.evidence, self._plausibility = TrackEvidence(len(sensors.full_network)), Plausibility()
        self.last: Track | None = None
        self.ended: str | None = None
        self.early: list[TrackState] = []
        self.slot = 0
        # Reason to end because the latest state is impossible; empty if it is possible.
        self._impossible = ''
        self._position_std = np.inf
        self._unobserved_length = target.unobserved_length()
        self._was_unambiguous = False
        # Timestamps and positions of the latest published poses.
        self._recent_positions: deque[tuple[int, FloatArray]] = deque(maxlen=MAX_POSITIONS)

    def restart(self, sensors: SensorSubset) -> None:
        """Drop the doubts caused by the field of another vehicle, and restart the checks."""
        self.evidence.drop_explained_doubts()
        self.cross_check, self._plausibility = CrossCheck(sensors.network), Plausibility()

    def start_alongside(self, first: 'Member', sensors: SensorSubset, stamp_ns: int, ratio: float
                        ) -> None:
        """Start as a new target of a track, with the first member's doubt about its approach and
        evidence against a disturbance (minimum Bayes factor `ratio`)."""
        self.evidence.flag_start(doubts.NOT_SEEN_APPROACHING in first.evidence.doubts,
                                 sensors.full_network, False)
        self.evidence.bayes_factor.add(first.evidence.bayes_factor.log_ratio, stamp_ns, ratio)

    def distance_from(self, stamps_ns: Sequence[int], path: FloatArray) -> float:
        """Mean distance [m] of the published positions from a path (n, 2); 0 if unknown."""
        position_at = dict(zip(stamps_ns, path, strict=True))
        distances = [float(np.hypot(*(position - position_at[stamp_ns])))
                     for stamp_ns, position in self._recent_positions if stamp_ns in position_at]
        return float(np.mean(distances)) if distances else 0.0

    def publish(self, track: TrackBank, bank: FilterBank, best: int, frame: FieldFrame, dt: float
                ) -> list[Track]:
        """Create and store the record of this member from hypothesis `best` of its own `bank`, `dt`
        seconds after the previous one; none if the state is impossible, which ends the member."""
        record = self._create_record(track, bank, best, frame, dt)
        self._impossible = impossible_reason(record.velocity, record.moment, record.mounting)
        if self._impossible:
            if track.filter.is_implausible(bank, best, frame):
                # The field contradicts the track, which is therefore lost, whatever its state.
                self._impossible = LOST
            return []
        self.last = record
        self._position_std = float(np.sqrt(np.trace(bank.P[best, :2, :2])))
        self._was_unambiguous |= not record.ambiguous
        self._recent_positions.append((record.stamp_ns, record.position[:2]))
        self._counts['poses'] += 1
        return [record]

    def _create_record(self, track: TrackBank, bank: FilterBank, best: int, frame: FieldFrame,
                       dt: float) -> Track:
        """Update the evidence with a frame, and return the `Track` record for this frame."""
        sensors, x, P = track.sensors, bank.x[best], bank.P[best]
        measured: BoolArray = ~np.isnan(frame.field)
        measuring = np.flatnonzero(measured.any(axis=1))
        is_single_sensor = len(sensors.network) > 1 and len(measuring) == 1
        self.evidence.count_single_sensor_time(is_single_sensor, dt)
        if self._unobserved_length is not None:
            self._unobserved_length.update(
                x, P, sensors.network.positions[measuring],
                self.last is not None and (self.evidence.is_doubtful or not self.last.ambiguous))
        reasons = self.evidence.update_doubts(
            self._doubts(track, bank, best, frame, dt, is_single_sensor), frame.stamp_ns)
        excess = 1.0 if self._target.starts_anywhere else self.evidence.innovations.excess
        return sensors.for_whole_network(published_track(
            bank, best, self._target.model, self._target.orientation, self._target.arrivals,
            self._target.kinds, stamp_ns=frame.stamp_ns, id=self.id, ended=False,
            existence=self.evidence.existence, degrees_of_freedom=int(measured.sum()),
            found=reasons, excess=excess, unobserved_length=self._unobserved_length,
            difference=self.cross_check.difference, ambiguous_poses=track.settings.ambiguous_poses,
            predicted=track.filter.predicted_field(track.bank, best, frame, dt),
            mounting=track.single_target.angles(x.copy()),
            mounting_covariance=track.single_target.angle_covariances(P)), track.settings)

    @property
    def passed_below(self) -> bool:
        """Whether the target passed below the sensors, and all else is plausible: if two sensors
        are exchanged, a vehicle fits well at the opposite point."""
        if self.last is None or self._target.starts_anywhere \
                or set(self.last.doubts) - {doubts.HEIGHT, doubts.BELOW_SENSORS}:
            return False
        return bool(self.last.position[2] + np.sqrt(self.last.covariance[2, 2]) < 0.0)

    def is_doubtful(self, settings: TrackSettings) -> bool:
        """Whether the whole track is currently doubtful."""
        return self.evidence.is_doubtful or self.cross_check.is_doubtful \
            or not self.evidence.bayes_factor.is_favoured(settings.min_bayes_factor) \
            or not self._target.starts_anywhere and self.evidence.is_sensed_by_one

    def _doubts(self, track: TrackBank, bank: FilterBank, best: int, frame: FieldFrame, dt: float,
                is_single_sensor: bool) -> set[str]:
        """Update the checks of the member, and return the doubts about its latest pose."""
        evidence, settings = self.evidence, track.settings
        reasons = evidence.doubts | ({doubts.ONE_SENSOR} if is_single_sensor else set())
        if track.filter.is_implausible(bank, best, frame):
            reasons.add(doubts.MISFIT)
        if not evidence.bayes_factor.is_favoured(settings.min_bayes_factor):
            reasons.add(doubts.DISTURBANCE_MODEL)
        # The field of a magnet at rest is as smooth as a disturbance, but its pose is correct.
        if self._target.starts_anywhere:
            return reasons
        reasons |= evidence.vehicle_doubts(
            bank.nis[best], int(np.count_nonzero(~np.isnan(frame.field))),
            settings.min_bayes_factor)
        if evidence.update_filter_doubt(track.relinearisation.gain(int(bank.origin[best])),
                                        frame.stamp_ns, settings.relinearise_window_s):
            self._counts['doubtful poses: the filter fits better than its path'] += 1
            reasons.add(doubts.OVERFIT)
        reasons |= self.cross_check.doubts(self._clocks.largest_offset_s(track.sensors.rows))
        reasons |= self._plausibility.evaluate(
            track.single_target, bank, best, settings.vehicle,
            np.deg2rad(settings.mounting_std_deg), dt)
        evidence.doubts |= reasons & doubts.PERMANENT
        return reasons | evidence.doubts

    def reason_to_end(self, sensors: SensorSubset, settings: TrackSettings) -> str | None:
        """Update the end conditions with the latest record; return the reason, if any."""
        if self._impossible:
            return self._impossible
        assert self.last is not None
        is_approaching = not self._target.starts_anywhere and sensors.is_approached_by(self.last)
        return self.evidence.reason_to_end(self.last, self._position_std, is_approaching, settings)

    def unexplained(self, uniform: float) -> UnexplainedField | None:
        """Field of a track with only ambiguous poses, if a disturbance explains it better."""
        if self._was_unambiguous or self.last is None \
                or self.evidence.bayes_factor.disfavoured_s(self.last.stamp_ns) <= 0.0:
            return None
        return UnexplainedField(self.id, self.begin_ns, self.evidence.largest, self.evidence.sensed,
                                uniform)

    def states_of(self, slot: int, n_one: int, states: Iterable[TrackState],
                  end_ns: float = np.inf) -> list[TrackState]:
        """States of the target at index `slot` before `end_ns`, with `n_one` states each."""
        rows = slice(n_one * slot, n_one * (slot + 1))
        return [(stamp_ns, x[rows], P[rows, rows]) for stamp_ns, x, P in states
                if self.begin_ns <= stamp_ns < end_ns]

    def smoothed(self, bank: FilterBank, best: int, complete: bool, states: list[TrackState],
                 doubtful: bool) -> list[SmoothedPose]:
        """Smoothed poses of the states of hypothesis `best`; ambiguous if `doubtful`, and where the
        filter was, as smoothing corrects its errors only in part."""
        ambiguous = doubtful or bool(ambiguities(bank, best, bank.is_separated(best)))
        poses = [smoothed_pose(
            self._target.model, self._target.orientation, x, P, stamp_ns=stamp_ns, id=self.id,
            kind=int(bank.kind[best]), kinds=self._target.kinds,
            unobserved_length=self._unobserved_length, complete=complete, difference=difference,
            ambiguous=ambiguous or self.evidence.was_filter_doubtful(stamp_ns))
            for (stamp_ns, x, P), difference in zip(states, self.cross_check.differences(states),
                                                    strict=True)]
        possible = [p for p in poses if not impossible_reason(p.velocity, p.moment)]
        self._counts['smoothed poses not published: impossible'] += len(poses) - len(possible)
        return possible


def members_in_order(members: Sequence[Member], new: Member | None, joint: JointExplanation,
                     n_one: int) -> list[Member]:
    """The members and a new target, ordered like the states in a joint explanation, with `n_one`
    per vehicle; a member that two vehicles replace continues as the one nearer to its positions."""
    others = list(members)
    replaced = others.pop(joint.replaced) if joint.replaced is not None else None
    if new is None or replaced is None:
        return [*others, *([replaced] if replaced else []), *([new] if new else [])]
    first = n_one * len(others)
    paths = np.array([path[joint.bank.best(), first:] for path in joint.window.paths])
    stamps = [frame.stamp_ns for frame in joint.window.frames]
    distances = [replaced.distance_from(stamps, paths[:, k * n_one:k * n_one + 2]) for k in (0, 1)]
    return [*others, replaced, new] if distances[0] <= distances[1] else [*others, new, replaced]
