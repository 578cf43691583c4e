"""One running track: its bank of filters, the frames that it keeps, and its evidence.

Source: ICASSP11 section 2, T10 Alg. 2 and 3; PHD15 Paper A for the magnet.
"""

from collections import Counter
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np

from mag_tracking.arrays import BoolArray, IntArray
from mag_tracking.event_records import Disturbance
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.starting_bank import StartingBank
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.bank_filter import BankFilter, NoTarget
from mag_tracking.stages.track.bank_size import WEIGHT_KEPT, most_hypotheses, most_sensors
from mag_tracking.stages.track.clock_evidence import ClockEvidence
from mag_tracking.stages.track.disturbances import Unexplained
from mag_tracking.stages.track.evidence import LEAST_WATCHED, TrackEvidence
from mag_tracking.stages.track.plausibility import Plausibility
from mag_tracking.stages.track.published_pose import ambiguities, published_track, smoothed_pose
from mag_tracking.stages.track.relinearisation import Relinearisation
from mag_tracking.stages.track.second_opinion import SecondOpinion
from mag_tracking.stages.track.sensor_rejection import SensorRejection
from mag_tracking.stages.track.sensor_selection import SensorSubset, hand_on
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.smoothing import FixedLag, TrackState, WholeTrack
from mag_tracking.stages.track.something_else import SomethingElse
from mag_tracking.stages.track.target import Target
from mag_tracking.units import NS

TrackRecord = Track | SmoothedPose | Disturbance


class RunningTrack:
    """A target that is being followed.

    Attributes
    ----------
    id : int
    bank : FilterBank
        Its hypotheses.
    ended : str or None
        Why it is over; None while it runs.
    is_lost : bool
        It ended while the target was still detected.
    """

    def __init__(self, id: int, target: Target, settings: TrackSettings, sensors: SensorSubset,
                 bank_filter: BankFilter, bank: FilterBank, counts: 'Counter[str]',
                 clocks: ClockEvidence, later: SensorSubset) -> None:
        """It starts with the `sensors`; `later` come in once its bank is small enough."""
        self.id, self.bank, self.counts, self._clocks = id, bank, counts, clocks
        self.ended: str | None = None
        self.is_lost = False
        self._target, self._settings = target, settings
        self._evidence, self._plausibility = TrackEvidence(len(sensors.whole)), Plausibility()
        self._use(sensors, bank_filter)
        self._later: SensorSubset | None = later
        self._relinearisation = Relinearisation(
            settings.relinearise_interval_s, settings.relinearise_window_s,
            settings.relinearise_most)
        self._whole = WholeTrack(settings.smooth_longest_s)
        self._lag = FixedLag(settings.smoothing_lag_s) if settings.smoothing_lag_s else None
        self._last: Track | None = None
        self._spread = np.inf
        self._unseen = target.unseen()
        self._handover_due: int | None = None
        self._was_sure = False
        self._begin_ns = 0

    def _use(self, sensors: SensorSubset, bank_filter: BankFilter,
             is_handover: bool = False) -> None:
        """From now on the track is of these sensors."""
        self._sensors, self._filter = sensors, bank_filter
        self._rejection = SensorRejection(sensors.network.names)
        self._no_target = NoTarget(len(sensors.network), self._settings.background_std)
        self._something_else = SomethingElse(sensors.network, self._settings.background_std,
                                             is_handover)
        self._opinion = SecondOpinion(sensors.network)

    def configure(self, settings: TrackSettings) -> None:
        """Apply new values of the live settings."""
        self._settings = settings
        self._filter.configure(settings)
        self._relinearisation.begin_anew()
        if not settings.second_opinion:
            self._opinion = SecondOpinion(self._sensors.network)

    def doubt(self, sensors: Sequence[int]) -> None:
        """The backgrounds of the `sensors` (rows) are doubtful, and so is a track that uses one."""
        if doubts.DOUBTFUL_BACKGROUND not in self._evidence.doubts \
                and np.isin((self._later or self._sensors).rows, sensors).any():
            self.counts['tracks of a doubtful background'] += 1
            self._evidence.doubt(doubts.DOUBTFUL_BACKGROUND)

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
        self._evidence.doubt_start(
            unseen_coming or watched_ns < LEAST_WATCHED * self._settings.lookback_s * NS,
            self._sensors.whole, self._target.starts_anywhere)
        self._begin_ns = frame.stamp_ns
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
            self._evidence.watch((self._later or self._sensors).part_of(frame))
        used = self._update(self._sensors.part_of(frame), dt, publish)
        if used is None:
            return self.end('no hypothesis explains the field')
        if not publish and self._lag is None:
            return []
        best = self.bank.best()
        late = [] if self._lag is None else self._smoothed(best, False, self._lag.smoothed(
            self._filter, self.bank, best, used, dt, publish), self._is_doubted())
        return [*self._publish(used, dt, best), *late, *self._end_if_over()] if publish else []

    def _update(self, frame: FieldFrame, dt: float, publish: bool) -> FieldFrame | None:
        """Move the bank through a frame; what was used of it, or None if nothing explains it."""
        s, bank = self._settings, self.bank
        predicted, log_likelihood, frame, rejected = self._rejection.advance(
            self._filter, bank, frame, dt)
        self.counts.update(rejected)
        # Where no majority is left the track may as well be wrong.
        if rejected and np.count_nonzero(frame.n_samples) <= len(rejected):
            self._evidence.doubt(doubts.SENSORS_CONTRADICT)
        evidence = bank.reweight(log_likelihood)
        if not np.isfinite(evidence):
            self.counts['banks lost'] += 1
            return None
        self._evidence.add(evidence - self._no_target.log_density(frame, dt, s.background_drift))
        self._compare(frame, dt, evidence)
        self._relinearisation.add(bank, predicted, log_likelihood, frame, dt)
        self.counts['hypotheses dropped'] += bank.prune(
            -np.log(s.prune_ratio),
            s.most_hypotheses if publish else max(s.most_hypotheses, s.most_at_start))
        self.counts.update(self._relinearisation.improve(self._filter, bank))
        self._whole.add(bank, frame, dt, publish)
        return frame

    def _publish(self, frame: FieldFrame, dt: float, best: int) -> list[TrackRecord]:
        """The `Track` of the hypothesis `best`."""
        self._last = self._published(frame, dt, best)
        self._spread = float(np.sqrt(np.trace(self.bank.P[best, :2, :2])))
        self._was_sure |= not self._last.ambiguous
        self.counts['poses'] += 1
        self._handover_due = best if self._sensors.is_part else None
        return [self._last]

    def _end_if_over(self) -> list[TrackRecord]:
        """The closing records, if the latest pose says that the track is over."""
        assert self._last is not None
        is_coming = not self._target.starts_anywhere and self._sensors.is_neared_by(self._last)
        reason = self._evidence.reason_to_end(self._last, self._spread, is_coming, self._settings)
        if reason is None:
            return []
        self.is_lost = True
        return self.end(reason)

    def _look(self, best: int, measured: IntArray) -> None:
        """Note how far a vehicle has come, by the sensors (rows) that measured."""
        if self._unseen is not None:
            self._unseen.look(
                self.bank.x[best], self.bank.P[best], self._sensors.network.positions[measured],
                self._last is not None and (self._evidence.doubted or not self._last.ambiguous))

    def _published(self, frame: FieldFrame, dt: float, best: int) -> Track:
        """The `Track` of the hypothesis `best`, with what it says of the sensors."""
        bank, observation = self.bank, self._filter.observation
        measured: BoolArray = ~np.isnan(frame.field)
        by = np.flatnonzero(measured.any(axis=1))
        alone = len(self._sensors.network) > 1 and len(by) == 1
        self._evidence.support(alone, dt)
        self._look(best, by)
        found = self._evidence.note(self._doubts(frame, dt, best, alone), frame.stamp_ns)
        excess = 1.0 if self._target.starts_anywhere else self._evidence.innovations.excess
        return self._sensors.widened(published_track(
            bank, best, self._target.model, self._target.orientation, self._target.arrivals,
            self._target.kinds, stamp_ns=frame.stamp_ns, id=self.id, ended=False,
            existence=self._evidence.existence, degrees_of_freedom=int(measured.sum()),
            found=found, excess=excess, unseen=self._unseen,
            difference=self._opinion.difference, ambiguous_poses=self._settings.ambiguous_poses,
            predicted=self._filter.predicted_field(bank, best, frame, dt),
            mounting=observation.angles(bank.x[best].copy()),
            mounting_covariance=observation.angle_covariances(bank.P[best])), self._settings)

    @property
    def unexplained(self) -> Unexplained | None:
        """The field during the track, if a target never explained it; else None."""
        evidence = self._evidence
        if self._was_sure or self._last is None \
                or evidence.explanation.unexplained_s(self._last.stamp_ns) <= 0.0:
            return None
        return Unexplained(self.id, self._begin_ns, evidence.largest, evidence.felt,
                           self._something_else.uniform)

    def _is_doubted(self) -> bool:
        """Whether all of the track, as it stands, may be wrong."""
        return self._evidence.doubted or self._opinion.is_doubtful \
            or not self._evidence.explanation.leads(self._settings.explained_ratio) \
            or not self._target.starts_anywhere and self._evidence.is_felt_by_one

    def _doubts(self, frame: FieldFrame, dt: float, best: int, alone: bool) -> set[str]:
        """Doubts about the pose of hypothesis `best`; `alone`: one sensor measured."""
        bank, evidence, settings = self.bank, self._evidence, self._settings
        found = evidence.doubts | ({doubts.ONE_SENSOR} if alone else set())
        if self._filter.is_strange(bank, best, frame):
            found.add(doubts.MISFIT)
        if not evidence.explanation.leads(settings.explained_ratio):
            found.add(doubts.SOMETHING_ELSE)
        # A magnet may rest: it is then as smooth as anything, and is where it was.
        if self._target.starts_anywhere:
            return found
        found |= evidence.vehicle_doubts(
            bank.nis[best], int(np.count_nonzero(~np.isnan(frame.field))), settings.explained_ratio)
        if self._overfits(best, frame.stamp_ns):
            found.add(doubts.OVERFIT)
        found |= self._opinion.doubts(self._clocks.apart_s(self._sensors.rows))
        found |= self._plausibility.judge(
            self._filter.observation, bank, best, settings.vehicle,
            np.deg2rad(settings.mounting_std_deg), dt)
        for reason in found & doubts.FOR_GOOD:
            evidence.doubt(reason)
        return found | evidence.doubts

    def _compare(self, frame: FieldFrame, dt: float, evidence: float) -> None:
        """Count what a frame with the log-evidence of a target says for something else, and for
        the filter."""
        best = self.bank.best()
        something_else = self._something_else.log_density(
            frame, dt, self._filter.model_error(self.bank, best, dt))
        if something_else is not None:
            self._evidence.explanation.add(evidence - something_else, frame.stamp_ns,
                                           self._settings.explained_ratio)
        self._evidence.take(frame, self._sensors.rows, self.bank.nis[best])
        if self._settings.second_opinion and not self._target.starts_anywhere:
            self._opinion.add(frame, self.bank.x[best])

    def _overfits(self, best: int, stamp_ns: int) -> bool:
        """Whether the filter fits the frames much better than the path of hypothesis `best`."""
        overfits = self._evidence.doubts_filter(
            self._relinearisation.gain(int(self.bank.origin[best])), stamp_ns,
            self._settings.relinearise_window_s)
        if overfits:
            self.counts['poses in doubt: the filter fits better than its path'] += 1
        return overfits

    def _smoothed(self, best: int, complete: bool, states: list[TrackState],
                  doubtful: bool) -> list[SmoothedPose]:
        """The `SmoothedPose`s of states of the hypothesis `best`.

        Smoothing removes the doubts about its filter only in part.
        """
        ambiguous = doubtful or bool(ambiguities(self.bank, best, self.bank.apart(best)))
        return [smoothed_pose(
            self._target.model, self._target.orientation, x, P, stamp_ns=stamp_ns, id=self.id,
            kind=int(self.bank.kind[best]), kinds=self._target.kinds, unseen=self._unseen,
            complete=complete, difference=difference,
            ambiguous=ambiguous or self._evidence.doubted_filter(stamp_ns))
            for (stamp_ns, x, P), difference in zip(states, self._opinion.differences(states),
                                                    strict=True)]

    def _smoothed_at_the_end(self) -> list[SmoothedPose]:
        """What is left of a fixed lag, and the whole track."""
        best, doubtful = self.bank.best(), self._evidence.ends_in_misfit or self._is_doubted()
        rest = [] if self._lag is None else self._smoothed(best, False, self._lag.rest(
            self._filter, self.bank, best), doubtful)
        states, left_out = self._whole.smoothed(self.bank, best)
        self.counts['frames left out of smoothing'] += left_out
        self.counts['tracks too long to smooth'] += self._whole.too_long
        return rest + self._smoothed(best, True, states, doubtful)

    def end(self, reason: str) -> list[TrackRecord]:
        """End the track: its last record again, marked as ended, then the smoothed poses."""
        self.ended = reason
        self._opinion.conclude(self._clocks, self._sensors.rows)
        self.counts[f'tracks ended: {reason}'] += 1
        return [] if self._last is None else [replace(self._last, ended=True),
                                              *self._smoothed_at_the_end()]

    def hand_over(self) -> None:
        """Switch to the sensors near where the target is going, if those used are others."""
        best, self._handover_due = self._handover_due, None
        if best is None or self.ended is not None:
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
        self._opinion.conclude(self._clocks, before)
        self._use(sensors, BankFilter(sensors.network, self._target.model, self._settings), True)
        own = self._filter.observation.own_covariance
        hand_on(self.bank, before, sensors.rows, own, self._settings.background_std)
        if self._lag is not None:
            self._lag.clear()
