"""A running track: its members, their published poses, and the evidence for and against them.

Targets whose fields overlap at the sensors are members of one track and share a state. Source:
ICASSP11 section 2, T10 Alg. 2 and 3; PHD15 Paper A for the magnet.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from mag_tracking.event_records import Disturbance
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.bank_filter import NEGLIGIBLE_ENERGY, WEAK_ENERGY, NoTarget
from mag_tracking.stages.track.cross_check import ClockComparison, CrossCheck
from mag_tracking.stages.track.disturbances import DisturbanceModel, UnexplainedField
from mag_tracking.stages.track.evidence import MIN_OBSERVED_FRACTION, OUT_OF_REACH
from mag_tracking.stages.track.joint import UNDECIDED_NATS, JointExplanation, NewTargetEvidence
from mag_tracking.stages.track.member import Member, members_in_order
from mag_tracking.stages.track.new_target_search import NewTargetSearch
from mag_tracking.stages.track.sensor_selection import SensorSubset
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.smoothing import TrackState
from mag_tracking.stages.track.track_bank import FrameUpdate, TrackBank
from mag_tracking.stages.track.window_search import VehicleState
from mag_tracking.units import NS

UNDECIDED_S, DOUBTED_S = 1.0, 3.0
"""[s] Durations of doubt after another explanation was not accepted, and was accepted."""
BELOW_SENSORS = 'vehicles that appear to pass below the sensors'

TrackRecord = Track | SmoothedPose | Disturbance
"""Record that the tracker returns: pose, smoothed pose or disturbance."""


class RunningTrack:
    """Track of a target, or of several `members` in the order of their states; `ended` is the
    reason why the last one has ended, and `is_lost` whether it was then still detected."""

    def __init__(self, id: int, bank: TrackBank, counts: 'Counter[str]', clocks: ClockComparison
                 ) -> None:
        self.counts, self._clocks = counts, clocks
        self.ended: str | None = None
        self.is_lost = False
        self._bank, self._target, self._settings = bank, bank.target, bank.settings
        self.members = [Member(id, bank.target, bank.sensors, counts, clocks, 0)]
        self._new_target_evidence = NewTargetEvidence()
        # Whether the track had the maximum number of members at the last search.
        self._is_at_limit = False
        self._handover_due: int | None = None
        self._use_bank_sensors(False)

    def _use_bank_sensors(self, is_handover: bool) -> None:
        """Restart the models without a target, and the cross-checks, with the bank's sensors."""
        sensors = self._bank.sensors
        self._no_target = NoTarget(len(sensors.network), self._settings.background_std)
        self._disturbance_model = DisturbanceModel(sensors.network, self._settings.background_std,
                                                   is_handover)
        for member in self.members:
            member.cross_check = CrossCheck(sensors.network)

    @property
    def bank(self) -> FilterBank:
        """Hypotheses of all members."""
        return self._bank.bank

    @property
    def _final_sensors(self) -> SensorSubset:
        """Sensors that the track uses after the frames before the detection."""
        return self._bank.later_sensors or self._bank.sensors

    def configure(self, settings: TrackSettings) -> None:
        """Apply new values of the live settings."""
        self._settings = settings
        self._bank.configure(settings)
        if not settings.cross_check:
            for member in self.members:
                member.cross_check = CrossCheck(self._bank.sensors.network)

    def flag_doubtful_sensors(self, sensors: Mapping[str, Sequence[int]]) -> None:
        """Flag the track if it uses one of `sensors`, given by reason."""
        for reason, rows in sensors.items():
            if not np.isin(self._final_sensors.rows, rows).any():
                continue
            for member in self.members:
                if reason not in member.evidence.doubts:
                    self.counts[f'tracks with doubtful readings: {reason}'] += 1
                    member.evidence.doubts.add(reason)

    def begin(self, frame: FieldFrame, recent: list[FieldFrame], approach_unobserved: bool = False
              ) -> list[TrackRecord]:
        """Process the `recent` frames (oldest first), and return the records of the detection
        frame; both are of the whole network, and may not show the approach of the target."""
        frames, first = [*recent, frame], self.members[0]
        first.evidence.flag_start(
            approach_unobserved or frame.stamp_ns - frames[0].stamp_ns
            < MIN_OBSERVED_FRACTION * self._settings.lookback_s * NS,
            self._final_sensors.full_network, self._target.starts_anywhere)
        first.begin_ns = frame.stamp_ns
        self._bank.begin(frames[0], frame)
        dt = 0.0
        for before, after in pairwise(frames):
            self.step(before, dt, publish=False)
            dt = (after.stamp_ns - before.stamp_ns) / NS
        rows = self._bank.sensors.rows
        if self.ended is None and self._bank.widen(dt):
            first.cross_check.finish(self._clocks, rows)
            self._use_bank_sensors(True)
        return self.step(frame, dt)

    def step(self, frame: FieldFrame, dt: float, publish: bool = True) -> list[TrackRecord]:
        """Advance the bank with a frame of the whole network; return records if `publish`."""
        if self.ended is not None:
            return []
        for member in () if self._target.starts_anywhere else self.members:
            member.evidence.check_approach(self._final_sensors.part_of(frame))
        used = self._bank.sensors.part_of(frame)
        before_gap = self._bank.restart_after_gap(used, dt)
        # The path before the gap was smoothed on its own.
        self.members[0].early += before_gap or []
        frame_update = self._bank.advance(used, dt if before_gap is None else 0.0)
        if not self._update_evidence(frame_update, dt):
            return self.end('no hypothesis explains the field')
        self._bank.store_and_prune(frame_update, publish)
        frame, bank, best = frame_update.frame, self.bank, self.bank.best()
        self._new_target_evidence.add(
            float(np.nansum(bank.nis[best])), np.count_nonzero(~np.isnan(frame.field)),
            frame.stamp_ns, frame_update.n_rejected > 0 and len(frame.field) == 2,
            bool(self._bank.filter.are_long(bank.kind[best:best + 1])[0]))
        if not publish and not self._settings.smoothing_lag_s:
            return []
        views = [self._view(i, best) for i in range(len(self.members))]
        lagged = self._bank.lag.smoothed(self._bank.filter, bank, best, frame, dt, publish)
        lagged_poses = [pose for i, view in enumerate(views) for pose in self._smoothed(
            i, view, False, lagged, self.members[i].is_doubtful(self._settings))]
        if not publish:
            return []
        out: list[TrackRecord] = [
            record for member, view in zip(self.members, views, strict=True)
            for record in member.publish(self._bank, *view, frame, dt)]
        self._handover_due = best if self._bank.sensors.is_part else None
        return [*out, *lagged_poses, *self._end_lost_members(frame)]

    def _view(self, i: int, best: int) -> tuple[FilterBank, int]:
        """Bank of member `i` alone, and its published hypothesis, if `best` is the joint one."""
        bank = self.bank.extract_target(i, self._bank.single_target.n_target)
        return bank, best if bank is self.bank else bank.best()

    def _update_evidence(self, frame_update: FrameUpdate, dt: float) -> bool:
        """Update the evidence of the members; return False if no hypothesis explains the frame."""
        frame = frame_update.frame
        if frame_update.n_rejected and np.count_nonzero(frame.n_samples) <= frame_update.n_rejected:
            # Without a majority of sensors, the track itself may be wrong.
            for member in self.members:
                member.evidence.doubts.add(doubts.SENSORS_CONTRADICT)
        if not np.isfinite(frame_update.evidence):
            self.counts['frames that no hypothesis explains'] += 1
            return False
        best = self.bank.best()
        no_target = self._no_target.log_density(frame, dt, self._settings.background_drift)
        disturbance_model = self._disturbance_model.log_density(
            frame, dt, self._bank.filter.model_error(self.bank, best, dt))
        n = self._bank.single_target.n_target
        for i, member in enumerate(self.members):
            member.evidence.add(frame_update.evidence - no_target)
            if disturbance_model is not None:
                member.evidence.bayes_factor.add(
                    frame_update.evidence - disturbance_model, frame.stamp_ns,
                    self._settings.min_bayes_factor)
            own_frame = frame if len(self.members) == 1 else replace(
                frame, field=frame.field - self._bank.filter.field_of_others(
                    self.bank, best, i, frame, dt))
            member.evidence.add_frame(own_frame, self._bank.sensors.rows, self.bank.nis[best])
            if self._settings.cross_check and not self._target.starts_anywhere:
                member.cross_check.add(own_frame, self.bank.x[best, i * n:(i + 1) * n])
        return True

    def _is_out_of_reach(self, i: int, frame: FieldFrame) -> bool:
        """Whether the field of member `i` is weak and the member does not approach a sensor."""
        last = self.members[i].last
        assert last is not None
        energy = self._bank.filter.field_energies(i, self.bank.x[self.bank.best()], frame).sum()
        return bool(energy < (WEAK_ENERGY if self._is_at_limit else NEGLIGIBLE_ENERGY)) \
            and not self._bank.sensors.is_approached_by(last)

    def _end_lost_members(self, frame: FieldFrame) -> list[TrackRecord]:
        """End the members that are lost or out of reach, and return their closing records."""
        out: list[TrackRecord] = []
        for member in list(self.members):
            reason, i = member.reason_to_end(self._bank.sensors, self._settings), \
                self.members.index(member)
            if reason is None and len(self.members) > 1 and self._is_out_of_reach(i, frame):
                reason = OUT_OF_REACH
            if reason is None:
                continue
            if len(self.members) == 1:
                self.is_lost = True
                return out + self.end(reason)
            out += self._close_member(i, reason)
            self._bank.without_target(i)
            del self.members[i]
        return out

    def end(self, reason: str) -> list[TrackRecord]:
        """End all members; return their last records, marked as ended, and smoothed poses."""
        self.ended = reason
        return [record for i in range(len(self.members))
                for record in self._close_member(i, reason)]

    def _close_member(self, i: int, reason: str) -> list[TrackRecord]:
        """End member `i`, and return its closing records."""
        member = self.members[i]
        member.ended = reason
        if len(self.members) == 1:
            member.cross_check.finish(self._clocks, self._bank.sensors.rows)
        self.counts[f'tracks ended: {reason}'] += 1
        if member.last is None:
            return []
        if member.passed_below:
            self.counts[BELOW_SENSORS] += 1
            member.evidence.doubts.add(doubts.BELOW_SENSORS)
        best = self.bank.best()
        view = self._view(i, best)
        doubtful = member.evidence.n_consecutive_misfits > 0 or member.is_doubtful(self._settings)
        return [replace(member.last, ended=True),
                *self._smoothed(i, view, False, self._bank.lag.remaining(
                    self._bank.filter, self.bank, best), doubtful),
                *self._smoothed(i, view, True, self._bank.smoothed(best), doubtful)]

    def _smoothed(self, i: int, view: tuple[FilterBank, int], complete: bool,
                  states: list[TrackState], doubtful: bool) -> list[SmoothedPose]:
        """Smoothed poses of member `i`; if `complete`, also those before other members joined."""
        member, n = self.members[i], self._bank.single_target.n_target
        own_states = member.states_of(member.slot if complete else i, n, states)
        return member.smoothed(*view, complete,
                               [*member.early, *own_states] if complete else own_states, doubtful)

    @property
    def unexplained(self) -> list[UnexplainedField]:
        """Unexplained fields of the members whose tracks have ended."""
        found = [m.unexplained(self._disturbance_model.uniform) for m in self.members if m.ended]
        return [u for u in found if u is not None]

    def new_target(self) -> JointExplanation | None:
        """Search for another explanation of the latest frames, if due; one that is nearly as
        probable as the track marks it as doubtful for a limited time."""
        window, n = self._bank.relinearisation.window, len(self.members)
        if self.ended is not None or self._target.starts_anywhere or window is None \
                or self.members[0].last is None:
            return None
        if (reason := self._new_target_evidence.due(window.frames[-1].stamp_ns)) is None:
            return None
        self._is_at_limit = n >= self._settings.max_joint_targets
        self.counts['searches for new targets'] += 1
        if self._is_at_limit:
            self.counts['new targets not added: too many vehicles at once'] += 1
        joint = NewTargetSearch(
            self.bank, window, self._bank.filter_of, n, VehicleState(
                self._settings.vehicle, self._bank.sensors.network,
                self._settings.background_std), reason, not self._is_at_limit).find()
        # A field that a disturbance explains is not evidence for another vehicle.
        if self._new_target_evidence.accepts(joint.log_odds if joint and all(
                m.evidence.bayes_factor.would_be_favoured(
                    joint.log_odds, self._settings.min_bayes_factor)
                for m in self.members) else -np.inf):
            return joint
        if joint is not None and joint.log_odds > UNDECIDED_NATS:
            for i, member in enumerate(self.members):
                if joint.replaced in (None, i):
                    member.evidence.flag_interval(
                        doubts.ANOTHER_VEHICLE, window.frames[-1].stamp_ns, UNDECIDED_S)
        return None

    def admit(self, joint: JointExplanation, id: int) -> None:
        """Continue with a joint explanation, and its new vehicle, if any, as track `id`."""
        begin_ns, now_ns = (joint.window.frames[k].stamp_ns for k in (0, -1))
        n, sensors = self._bank.single_target.n_target, self._bank.sensors
        ratio = self._settings.min_bayes_factor
        states = self._bank.smoothed(self.bank.best(), False)
        for member in self.members:
            member.early += member.states_of(member.slot, n, states, begin_ns)
            member.restart(sensors)
        new = None
        if joint.adds:
            new = Member(id, self._target, sensors, self.counts, self._clocks,
                         now_ns - round(self._settings.lookback_s * NS))
            new.start_alongside(self.members[0], sensors, now_ns, ratio)
        doubtful = joint.doubtful(n)
        self._bank.resume(joint)
        self.members, self._is_at_limit = members_in_order(self.members, new, joint, n), False
        for slot, member in enumerate(self.members):
            member.slot = slot
            member.evidence.add(joint.log_odds)
            member.evidence.bayes_factor.add(joint.log_odds, now_ns, ratio)
            if slot in doubtful:
                member.evidence.flag_interval(doubts.ANOTHER_VEHICLE, now_ns, DOUBTED_S, begin_ns)

    def hand_over(self) -> None:
        """Switch to the sensors near the predicted position, if a handover is due."""
        best, self._handover_due = self._handover_due, None
        if best is None or self.ended is not None or len(self.members) > 1:
            return
        rows = self._bank.sensors.rows
        if self._bank.hand_over(best):
            self.members[0].cross_check.finish(self._clocks, rows)
            self._use_bank_sensors(True)
