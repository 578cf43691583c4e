"""One running track: its bank of filters, the frames that it keeps, and its members.

A track usually has one target. Targets whose fields overlap at the sensors are members of one
track: they share a state, as what is wrongly taken for the field of one is missing in that of the
other.

Source: ICASSP11 section 2, T10 Alg. 2 and 3; PHD15 Paper A for the magnet.
"""

from collections import Counter
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.event_records import Disturbance
from mag_tracking.inference.axes import whitened_energy
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.starting_bank import StartingBank
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.bank_filter import BankFilter, NoTarget
from mag_tracking.stages.track.bank_size import WEIGHT_KEPT, most_hypotheses, most_sensors
from mag_tracking.stages.track.clock_evidence import ClockEvidence
from mag_tracking.stages.track.disturbances import Unexplained
from mag_tracking.stages.track.evidence import LEAST_WATCHED, OUT_OF_REACH
from mag_tracking.stages.track.member import Member, Update, View
from mag_tracking.stages.track.newcomer import (
    UNDECIDED_NATS,
    Joint,
    NewcomerSearch,
    NewcomerTest,
)
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.relinearisation import Relinearisation
from mag_tracking.stages.track.sensor_rejection import SensorRejection
from mag_tracking.stages.track.sensor_selection import SensorSubset, hand_on
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.smoothing import FixedLag, TrackState, WholeTrack
from mag_tracking.stages.track.something_else import SomethingElse
from mag_tracking.stages.track.target import Target
from mag_tracking.stages.track.vehicle_state import VehicleState
from mag_tracking.units import NS

UNDECIDED_S = 1.0
"""[s] Poses are in doubt for so long after another explanation was about as probable."""

UNFELT, FAINT = 0.1, 1.0
"""A member whose field has less energy than this in a frame, in units of its noise, is not felt;
and with less than that it does not disturb the others."""

TrackRecord = Track | SmoothedPose | Disturbance


class RunningTrack:
    """Targets that are being followed, one or several that share a state.

    Attributes
    ----------
    bank : FilterBank
        Their hypotheses.
    members : list of Member
        Those that are followed, in the order of their states.
    ended : str or None
        Why the last of them is over; None while it runs.
    is_lost : bool
        The last of them ended while it was still detected.
    """

    def __init__(self, id: int, target: Target, settings: TrackSettings, sensors: SensorSubset,
                 bank_filter: BankFilter, bank: FilterBank, counts: 'Counter[str]',
                 clocks: ClockEvidence, later: SensorSubset) -> None:
        """It starts with the `sensors`; `later` come in once its bank is small enough."""
        self.bank, self.counts, self._clocks = bank, counts, clocks
        self.ended: str | None = None
        self.is_lost = False
        self._target, self._settings = target, settings
        self.members = [Member(id, target, sensors, counts, clocks, 0)]
        self._use(sensors, bank_filter)
        self._later: SensorSubset | None = later
        self._relinearisation = Relinearisation(
            settings.relinearise_interval_s, settings.relinearise_window_s,
            settings.relinearise_most)
        self._whole = WholeTrack(settings.smooth_longest_s)
        self._lag = FixedLag(settings.smoothing_lag_s) if settings.smoothing_lag_s else None
        self._handover_due: int | None = None
        self._test = NewcomerTest()
        # A newcomer could not be sought: there are too many members.
        self._is_full = False

    def _use(self, sensors: SensorSubset, bank_filter: BankFilter,
             is_handover: bool = False) -> None:
        """From now on the track is of these sensors."""
        self._sensors, self._filter = sensors, bank_filter
        self._rejection = SensorRejection(sensors.network.names)
        self._no_target = NoTarget(len(sensors.network), self._settings.background_std)
        self._something_else = SomethingElse(sensors.network, self._settings.background_std,
                                             is_handover)
        for member in self.members:
            member.use(sensors)

    @property
    def id(self) -> int:
        """That of its first member."""
        return self.members[0].id

    @property
    def _one(self) -> Observation:
        """How the sensors see a single member."""
        if len(self.members) == 1:
            return self._filter.observation
        return self._filter.observation.of_one

    def configure(self, settings: TrackSettings) -> None:
        """Apply new values of the live settings."""
        self._settings = settings
        self._filter.configure(settings)
        self._relinearisation.begin_anew()
        if not settings.second_opinion:
            for member in self.members:
                member.use(self._sensors)

    def doubt(self, sensors: Sequence[int]) -> None:
        """The backgrounds of the `sensors` (rows) are doubtful, and so is a track that uses one."""
        if not np.isin((self._later or self._sensors).rows, sensors).any():
            return
        for member in self.members:
            if doubts.DOUBTFUL_BACKGROUND not in member.evidence.doubts:
                self.counts['tracks of a doubtful background'] += 1
                member.evidence.doubt(doubts.DOUBTFUL_BACKGROUND)

    def begin(self, frame: FieldFrame, recent: list[FieldFrame], unseen_coming: bool = False
              ) -> list[TrackRecord]:
        """Run through the `recent` frames before the detection, and publish the first one after.

        Parameters
        ----------
        frame : FieldFrame
            Of the whole network, with the detection.
        recent : list of FieldFrame
            Those before it, oldest first.
        unseen_coming : bool
            What came before says nothing of how this target came.
        """
        watched_ns = frame.stamp_ns - recent[0].stamp_ns if recent else 0
        first = self.members[0]
        first.evidence.doubt_start(
            unseen_coming or watched_ns < LEAST_WATCHED * self._settings.lookback_s * NS,
            self._sensors.whole, self._target.starts_anywhere)
        first.begin_ns = frame.stamp_ns
        if recent:
            self._filter.move(self.bank, (recent[0].stamp_ns - frame.stamp_ns) / NS)
        start = StartingBank.of(self.bank, self._filter.observation.n_target)
        self._whole.begin(copy(start), self._filter)
        self._relinearisation.begin(start)
        dt = 0.0
        for before, after in pairwise([*recent, frame]):
            self.step(before, dt, publish=False)
            dt = (after.stamp_ns - before.stamp_ns) / NS
        if self.ended is None:
            self._widen(dt)
        return self.step(frame, dt)

    def step(self, frame: FieldFrame, dt: float, publish: bool = True) -> list[TrackRecord]:
        """Predict, update, weigh; the records of a frame, if it is to be published.

        The `frame` is of the whole network, `dt` [s] after the one before.
        """
        if self.ended is not None:
            return []
        if not self._target.starts_anywhere:
            for member in self.members:
                member.evidence.watch((self._later or self._sensors).part_of(frame))
        used = self._update(self._sensors.part_of(frame), dt, publish)
        if used is None:
            return self.end('no hypothesis explains the field')
        if not publish and self._lag is None:
            return []
        best = self.bank.best()
        views = [self._view(i, best) for i in range(len(self.members))]
        lagged = [] if self._lag is None else self._lag.smoothed(
            self._filter, self.bank, best, used, dt, publish)
        late = [pose for i, view in enumerate(views) for pose in self._smoothed(
            i, view, False, lagged, self.members[i].is_doubted(self._settings))]
        if not publish:
            return []
        update = Update(used, dt, self.bank, self._filter, self._sensors, self._settings)
        out: list[TrackRecord] = [member.publish(update, view)
                                  for member, view in zip(self.members, views, strict=True)]
        self._handover_due = best if self._sensors.is_part else None
        return [*out, *late, *self._end_if_over(used)]

    def _view(self, i: int, best: int) -> View:
        """The bank of member `i` alone; `best` is the row of all members."""
        bank = self.bank.of_target(i, self._one.n_target)
        row = best if bank is self.bank else bank.best()
        return View(bank, row, self._one, self._relinearisation.gain(int(bank.origin[row])))

    def _update(self, frame: FieldFrame, dt: float, publish: bool) -> FieldFrame | None:
        """Move the bank through a frame; what was used of it, or None if nothing explains it."""
        s, bank = self._settings, self.bank
        predicted, log_likelihood, frame, rejected = self._rejection.advance(
            self._filter, bank, frame, dt)
        self.counts.update(rejected)
        evidence = bank.reweight(log_likelihood)
        for member in self.members:
            # Where no majority is left the track may as well be wrong.
            if rejected and np.count_nonzero(frame.n_samples) <= len(rejected):
                member.evidence.doubt(doubts.SENSORS_CONTRADICT)
        if not np.isfinite(evidence):
            self.counts['banks lost'] += 1
            return None
        self._compare(frame, dt, evidence)
        self._relinearisation.add(bank, predicted, log_likelihood, evidence, frame, dt)
        self.counts['hypotheses dropped'] += bank.prune(
            -np.log(s.prune_ratio),
            s.most_hypotheses if publish else max(s.most_hypotheses, s.most_at_start))
        self.counts.update(self._relinearisation.improve(self._filter, bank))
        self._whole.add(bank, frame, dt, publish)
        best = bank.best()
        self._test.add(float(np.nansum(bank.nis[best])), np.count_nonzero(~np.isnan(frame.field)),
                       frame.stamp_ns, bool(rejected),
                       bool(self._filter.are_long(bank.kind[best:best + 1])[0]))
        return frame

    def _compare(self, frame: FieldFrame, dt: float, evidence: float) -> None:
        """Count what a frame with the log-evidence of its targets says for something else, for no
        target, and for the filter."""
        best = self.bank.best()
        no_target = self._no_target.log_density(frame, dt, self._settings.background_drift)
        something_else = self._something_else.log_density(
            frame, dt, self._filter.model_error(self.bank, best, dt))
        for i, member in enumerate(self.members):
            member.evidence.add(evidence - no_target)
            if something_else is not None:
                member.evidence.explanation.add(evidence - something_else, frame.stamp_ns,
                                                self._settings.explained_ratio)
            mine = self._frame_of(i, best, frame, dt)
            member.evidence.take(mine, self._sensors.rows, self.bank.nis[best])
            if self._settings.second_opinion and not self._target.starts_anywhere:
                first = i * self._one.n_target
                member.opinion.add(mine, self.bank.x[best, first:first + self._one.n_target])

    def _frame_of(self, i: int, best: int, frame: FieldFrame, dt: float) -> FieldFrame:
        """A frame as member `i` alone would have made it, by hypothesis `best`."""
        if len(self.members) == 1:
            return frame
        others = self._filter.field_of_others(self.bank, best, i, frame, dt)
        return replace(frame, field=frame.field - others)

    def _is_out_of_reach(self, member: Member, frame: FieldFrame) -> bool:
        """Whether one of several members goes away, and is no longer felt."""
        assert member.last is not None
        state = self.bank.x[self.bank.best()]
        limit = FAINT if self._is_full else UNFELT
        return self._energy(self.members.index(member), state, frame) < limit \
            and not self._sensors.is_neared_by(member.last)

    def _energy(self, i: int, state: FloatArray, frame: FieldFrame) -> float:
        """Of the field of member `i` in a frame, in units of its noise, by a state (n_x,)."""
        field = self._filter.observation.field_of(state, [i], np.zeros(len(frame.field)))
        energy, _ = whitened_energy(np.where(np.isnan(frame.field), np.nan, field),
                                    frame.covariance)
        return float(energy.sum())

    def _faint_from(self, i: int) -> int:
        """The frame of the window from which on member `i` is hardly felt."""
        window, best = self._relinearisation.window, self.bank.best()
        if window is None:
            return 0
        row = int(np.searchsorted(window.anchor.origin, self.bank.origin[best]))
        felt = [self._energy(i, path[row], frame) > FAINT
                for path, frame in zip(window.paths, window.frames, strict=True)]
        return max((k for k, is_felt in enumerate(felt) if is_felt), default=-1) + 1

    def _end_if_over(self, frame: FieldFrame) -> list[TrackRecord]:
        """The closing records of those members that are over by their latest poses."""
        out: list[TrackRecord] = []
        for member in list(self.members):
            reason = member.reason_to_end(self._sensors, self._settings)
            if reason is None and len(self.members) > 1 and self._is_out_of_reach(member, frame):
                reason = OUT_OF_REACH
            if reason is None:
                continue
            member.is_lost = True
            out += self._end_member(member, reason)
        return out

    def _end_member(self, member: Member, reason: str) -> list[TrackRecord]:
        """End one member; the others go on without its states."""
        if len(self.members) == 1:
            self.is_lost = member.is_lost
            return self.end(reason)
        i = self.members.index(member)
        out = self._closing(i, reason)
        n_one = self._one.n_target
        self._relinearisation.without_target(self._filter, self.bank, i, self._faint_from(i))
        self.bank = self.bank.without_target(i, n_one)
        del self.members[i]
        self._filter = self._filter_of(len(self.members))
        self._rejection.clear()
        if self._lag is not None:
            self._lag.clear()
        return out

    def _filter_of(self, n_targets: int) -> BankFilter:
        """The filter of so many members."""
        return BankFilter(self._sensors.network, self._target.model, self._settings, n_targets)

    def end(self, reason: str) -> list[TrackRecord]:
        """End all members: the last record of each again, marked as ended, and smoothed poses."""
        self.ended = reason
        return [record for i in range(len(self.members)) for record in self._closing(i, reason)]

    def _closing(self, i: int, reason: str) -> list[TrackRecord]:
        """The closing records of member `i`."""
        member = self.members[i]
        member.ended = reason
        if len(self.members) == 1:
            member.opinion.conclude(self._clocks, self._sensors.rows)
        self.counts[f'tracks ended: {reason}'] += 1
        if member.last is None:
            return []
        best = self.bank.best()
        view = self._view(i, best)
        doubtful = member.evidence.ends_in_misfit or member.is_doubted(self._settings)
        rest = [] if self._lag is None else self._lag.rest(self._filter, self.bank, best)
        states, left_out = self._whole.smoothed(self.bank, best)
        self.counts['frames left out of smoothing'] += left_out
        self.counts['tracks too long to smooth'] += self._whole.too_long
        return [replace(member.last, ended=True),
                *self._smoothed(i, view, False, rest, doubtful),
                *self._smoothed(i, view, True, states, doubtful)]

    def _smoothed(self, i: int, view: View, complete: bool, states: list[TrackState],
                  doubtful: bool) -> list[SmoothedPose]:
        """The `SmoothedPose`s of member `i` of the states of all; of a complete track, with those
        before it shared its state."""
        member = self.members[i]
        mine = self._states_of(member.slot if complete else i, member, states)
        return member.smoothed(view.bank, view.best, complete,
                               [*member.early, *mine] if complete else mine, doubtful)

    def _states_of(self, slot: int, member: Member, states: list[TrackState]) -> list[TrackState]:
        """The states of a member, which has this place among the `states` of all."""
        n = self._one.n_target
        rows = slice(n * slot, n * (slot + 1))
        return [(stamp_ns, x[rows], P[rows, rows]) for stamp_ns, x, P in states
                if stamp_ns >= member.begin_ns]

    @property
    def unexplained(self) -> list[Unexplained]:
        """The fields during tracks that have ended, where a target never explained them."""
        found = [m.unexplained(self._something_else.uniform) for m in self.members if m.ended]
        return [u for u in found if u is not None]

    def newcomer(self) -> Joint | None:
        """An explanation of the latest frames with a vehicle more, where they ask for one and it
        is believed."""
        window, n = self._relinearisation.window, len(self.members)
        if self.ended is not None or self._target.starts_anywhere or window is None \
                or self.members[0].last is None:
            return None
        reason = self._test.due(window.frames[-1].stamp_ns)
        if reason is None:
            return None
        may_be_more = n < self._settings.most_together
        self._is_full = not may_be_more
        if self._is_full:
            self.counts['newcomers not sought: too many vehicles at once'] += 1
        self.counts['newcomers sought'] += 1
        found = NewcomerSearch(
            self.bank, window, self._filter_of, n, VehicleState(
                self._settings.vehicle, self._sensors.network,
                self._settings.background_std), reason, may_be_more).find()
        if self._test.believes(-np.inf if found is None else found.log_odds):
            return found
        if found is not None and found.log_odds > UNDECIDED_NATS:
            now_ns = window.frames[-1].stamp_ns
            for i, member in enumerate(self.members):
                if found.replaced in (None, i):
                    member.evidence.doubt_for(doubts.ANOTHER_VEHICLE, now_ns, UNDECIDED_S)
        return None

    def admit(self, joint: Joint, id: int) -> None:
        """Go on with another explanation; a newcomer becomes the member `id`."""
        window, best = joint.window, self.bank.best()
        begin_ns, now_ns = (window.frames[k].stamp_ns for k in (0, -1))
        states, _ = self._whole.smoothed(self.bank, best)
        before = [state for state in states if state[0] < begin_ns]
        for member in self.members:
            member.early += self._states_of(member.slot, member, before)
            member.begin_again()
        new = self._newcomer(id, joint, now_ns) if joint.adds else None
        self.bank, self._filter = joint.bank, joint.bank_filter
        self.members, self._is_full = self._in_order(new, joint), False
        for slot, member in enumerate(self.members):
            member.slot = slot
            member.evidence.add(joint.log_odds)
        self._relinearisation.resume(window)
        self._whole.resume(window, self._filter)
        self._rejection.clear()
        if self._lag is not None:
            self._lag.clear()

    def _newcomer(self, id: int, joint: Joint, now_ns: int) -> Member:
        """The member that a newcomer becomes."""
        new = Member(id, self._target, self._sensors, self.counts, self._clocks,
                     now_ns - round(self._settings.lookback_s * NS))
        new.evidence.doubt_start(False, self._sensors.whole, False)
        new.evidence.explanation.add(joint.log_odds, now_ns, self._settings.explained_ratio)
        return new

    def _in_order(self, new: Member | None, joint: Joint) -> list[Member]:
        """The members in the order of their states."""
        others = list(self.members)
        old = others.pop(joint.replaced) if joint.replaced is not None else None
        if new is None or old is None:
            return [*others, *([old] if old else []), *([new] if new else [])]
        best, n = joint.bank.best(), self._one.n_target
        first = n * len(others)
        paths = np.array([path[best, first:] for path in joint.window.paths])
        stamps = [frame.stamp_ns for frame in joint.window.frames]
        away = [old.distance_from(stamps, paths[:, k * n:k * n + 2]) for k in (0, 1)]
        return [*others, old, new] if away[0] <= away[1] else [*others, new, old]

    def hand_over(self) -> None:
        """Switch to the sensors near where the target is going, if those used are others."""
        best, self._handover_due = self._handover_due, None
        if best is None or self.ended is not None or len(self.members) > 1:
            return
        sensors = self._sensors.ahead_of(self.bank.x[best], min(
            self._settings.most_sensors, most_sensors(self._filter.observation, len(self.bank))))
        if sensors is not self._sensors:
            self._hand_on_to(sensors)
            self._whole.give_up()
            self._relinearisation.begin_anew()
            self.counts['tracks handed on to other sensors'] += 1

    def _widen(self, dt: float) -> None:
        """Use all sensors from the next frame on, which comes in `dt` [s], if the frames until now
        have made enough hypotheses improbable; else they come in with a handover."""
        sensors, self._later = self._later or self._sensors, None
        n, most = len(sensors.rows), most_hypotheses(self._filter.observation, len(sensors.rows))
        if n == len(self._sensors.rows) or not self.bank.outweigh(most, WEIGHT_KEPT):
            return
        self.counts['hypotheses dropped'] += self.bank.prune(np.inf, most)
        self._hand_on_to(sensors)
        anchor = self.bank.copy()
        self._filter.move(anchor, dt)
        self._whole.begin(anchor, self._filter)
        self._relinearisation.begin(anchor.copy())

    def _hand_on_to(self, sensors: SensorSubset) -> None:
        """Give the hypotheses the states of other sensors."""
        before = self._sensors.rows
        self.members[0].opinion.conclude(self._clocks, before)
        self._use(sensors, BankFilter(sensors.network, self._target.model, self._settings), True)
        own = self._filter.observation.own_covariance
        hand_on(self.bank, before, sensors.rows, own, self._settings.background_std)
        if self._lag is not None:
            self._lag.clear()
