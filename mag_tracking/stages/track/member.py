"""One target of a running track: its evidence, its doubts, and what is published of it."""

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import BoolArray, FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.clock_comparison import ClockComparison
from mag_tracking.stages.track.cross_check import CrossCheck
from mag_tracking.stages.track.disturbances import Unexplained
from mag_tracking.stages.track.evidence import TrackEvidence
from mag_tracking.stages.track.joint import Joint
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.plausibility import Plausibility
from mag_tracking.stages.track.published_pose import ambiguities, published_track, smoothed_pose
from mag_tracking.stages.track.sensor_selection import SensorSubset
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.smoothing import TrackState
from mag_tracking.stages.track.target import Target

MAX_PLACES = 64
"""Number of places of a target that are remembered, to tell it from another one."""


@dataclass(frozen=True)
class Update:
    """The bank of a running track after a frame."""

    frame: FieldFrame
    """The used fields, of the sensors that the track uses."""
    dt: float
    """[s] Since the frame before."""
    bank: FilterBank
    """The hypotheses of all members."""
    bank_filter: BankFilter
    sensors: SensorSubset
    settings: TrackSettings


@dataclass(frozen=True)
class View:
    """The bank of a running track, of one member alone."""

    bank: FilterBank
    best: int
    """Row of the hypothesis that is published of it."""
    observation: Observation
    gain: float
    """[nats] Of the latest frames along the path of that hypothesis, less than in its filter."""


class Member:
    """A target of a running track.

    Attributes
    ----------
    id : int
    evidence : TrackEvidence
    opinion : CrossCheck
    last : Track or None
        The latest record.
    ended : str or None
        Why it is over; None while it is followed.
    is_lost : bool
        It ended while the target was still detected.
    early : list of TrackState
        Smoothed states before the target shared its state with others.
    slot : int
        Where its states are among those of the frames that are kept for smoothing.
    """

    def __init__(self, id: int, target: Target, sensors: SensorSubset, counts: 'Counter[str]',
                 clocks: ClockComparison, begin_ns: int) -> None:
        self.id, self._target, self._counts, self._clocks = id, target, counts, clocks
        self.begin_ns, self._sensors = begin_ns, sensors
        self.evidence, self._plausibility = TrackEvidence(len(sensors.whole)), Plausibility()
        self.opinion = CrossCheck(sensors.network)
        self.last: Track | None = None
        self.ended: str | None = None
        self.is_lost = False
        self.early: list[TrackState] = []
        self.slot = 0
        self._spread = np.inf
        self._unobserved_length = target.unobserved_length()
        self._was_sure = False
        # Where the latest poses were published.
        self._places: deque[tuple[int, FloatArray]] = deque(maxlen=MAX_PLACES)

    def use(self, sensors: SensorSubset) -> None:
        """From now on the target is measured by these sensors."""
        self._sensors = sensors
        self.opinion = CrossCheck(sensors.network)

    def restart(self, sensors: SensorSubset) -> None:
        """Drop the doubts that were due to the field of another vehicle."""
        self.evidence.forgive()
        self.use(sensors)
        self._plausibility = Plausibility()

    def start_alongside(self, first: 'Member', stamp_ns: int, ratio: float) -> None:
        """It begins as a new target beside the `first` member of a track, whose doubts about how it
        came, and whose evidence against something else, are its own.

        `ratio` is that by which a target has to explain the frames better.
        """
        self.evidence.doubt_start(doubts.NOT_SEEN_APPROACHING in first.evidence.doubts,
                                  self._sensors.whole, False)
        self.evidence.bayes_factor.add(first.evidence.bayes_factor.log_ratio, stamp_ns, ratio)

    def distance_from(self, stamps_ns: Sequence[int], path: FloatArray) -> float:
        """[m] mean distance of the latest poses from a path (n, 2) with these timestamps.

        0 where no pose was published at them.
        """
        at = dict(zip(stamps_ns, path, strict=True))
        away = [float(np.hypot(*(place - at[stamp_ns]))) for stamp_ns, place in self._places
                if stamp_ns in at]
        return float(np.mean(away)) if away else 0.0

    def publish(self, update: Update, view: View) -> Track:
        """The `Track` of a frame."""
        self.last = self._published(update, view)
        self._spread = float(np.sqrt(np.trace(view.bank.P[view.best, :2, :2])))
        self._was_sure |= not self.last.ambiguous
        self._places.append((self.last.stamp_ns, self.last.position[:2]))
        self._counts['poses'] += 1
        return self.last

    def _published(self, update: Update, view: View) -> Track:
        """The `Track` of a frame, with what it says of the sensors."""
        frame, dt, sensors, best = update.frame, update.dt, update.sensors, view.best
        measured: BoolArray = ~np.isnan(frame.field)
        by = np.flatnonzero(measured.any(axis=1))
        alone = len(sensors.network) > 1 and len(by) == 1
        self.evidence.support(alone, dt)
        if self._unobserved_length is not None:
            self._unobserved_length.update(
                view.bank.x[best], view.bank.P[best], sensors.network.positions[by],
                self.last is not None and (self.evidence.doubted or not self.last.ambiguous))
        found = self.evidence.note(self._doubts(update, view, alone), frame.stamp_ns)
        excess = 1.0 if self._target.starts_anywhere else self.evidence.innovations.excess
        return sensors.for_whole_network(published_track(
            view.bank, best, self._target.model, self._target.orientation, self._target.arrivals,
            self._target.kinds, stamp_ns=frame.stamp_ns, id=self.id, ended=False,
            existence=self.evidence.existence, degrees_of_freedom=int(measured.sum()),
            found=found, excess=excess, unobserved_length=self._unobserved_length,
            difference=self.opinion.difference,
            ambiguous_poses=update.settings.ambiguous_poses,
            predicted=update.bank_filter.predicted_field(update.bank, best, frame, dt),
            mounting=view.observation.angles(view.bank.x[best].copy()),
            mounting_covariance=view.observation.angle_covariances(view.bank.P[best])),
            update.settings)

    def is_doubted(self, settings: TrackSettings) -> bool:
        """Whether all of the track, as it stands, may be wrong."""
        return self.evidence.doubted or self.opinion.is_doubtful \
            or not self.evidence.bayes_factor.leads(settings.min_bayes_factor) \
            or not self._target.starts_anywhere and self.evidence.is_felt_by_one

    def _doubts(self, update: Update, view: View, alone: bool) -> set[str]:
        """Doubts about the pose of the best hypothesis; `alone`: one sensor measured."""
        bank, best, evidence, settings = view.bank, view.best, self.evidence, update.settings
        found = evidence.doubts | ({doubts.ONE_SENSOR} if alone else set())
        if update.bank_filter.is_implausible(bank, best, update.frame):
            found.add(doubts.MISFIT)
        if not evidence.bayes_factor.leads(settings.min_bayes_factor):
            found.add(doubts.SOMETHING_ELSE)
        # A magnet may rest: it is then as smooth as anything, and is where it was.
        if self._target.starts_anywhere:
            return found
        found |= evidence.vehicle_doubts(
            bank.nis[best], int(np.count_nonzero(~np.isnan(update.frame.field))),
            settings.min_bayes_factor)
        if self._overfits(update, view):
            found.add(doubts.OVERFIT)
        found |= self.opinion.doubts(self._clocks.apart_s(update.sensors.rows))
        found |= self._plausibility.evaluate(
            view.observation, bank, best, settings.vehicle,
            np.deg2rad(settings.mounting_std_deg), update.dt)
        for reason in found & doubts.FOR_GOOD:
            evidence.doubt(reason)
        return found | evidence.doubts

    def _overfits(self, update: Update, view: View) -> bool:
        """Whether the filter fits the frames much better than the path of its hypothesis."""
        overfits = self.evidence.doubts_filter(view.gain, update.frame.stamp_ns,
                                               update.settings.relinearise_window_s)
        if overfits:
            self._counts['poses in doubt: the filter fits better than its path'] += 1
        return overfits

    def reason_to_end(self, sensors: SensorSubset, settings: TrackSettings) -> str | None:
        """Why the target is over by its latest record; None while it goes on."""
        assert self.last is not None
        is_coming = not self._target.starts_anywhere and sensors.is_approached_by(self.last)
        return self.evidence.reason_to_end(self.last, self._spread, is_coming, settings)

    def unexplained(self, uniform: float) -> Unexplained | None:
        """The field during the track, if a target never explained it; else None.

        `uniform` is the probability that it was one field over the network.
        """
        if self._was_sure or self.last is None \
                or self.evidence.bayes_factor.unexplained_s(self.last.stamp_ns) <= 0.0:
            return None
        return Unexplained(self.id, self.begin_ns, self.evidence.largest, self.evidence.felt,
                           uniform)

    def states_of(self, slot: int, n_one: int, states: Iterable[TrackState],
                  end_ns: float = np.inf) -> list[TrackState]:
        """Its states from when it began until before `end_ns`, which have this place among the
        `states` of all members, each of which has `n_one`."""
        rows = slice(n_one * slot, n_one * (slot + 1))
        return [(stamp_ns, x[rows], P[rows, rows]) for stamp_ns, x, P in states
                if self.begin_ns <= stamp_ns < end_ns]

    def smoothed(self, bank: FilterBank, best: int, complete: bool, states: list[TrackState],
                 doubtful: bool) -> list[SmoothedPose]:
        """The `SmoothedPose`s of states of the hypothesis `best` of this member's `bank`.

        Smoothing removes the doubts about its filter only in part.
        """
        ambiguous = doubtful or bool(ambiguities(bank, best, bank.apart(best)))
        return [smoothed_pose(
            self._target.model, self._target.orientation, x, P, stamp_ns=stamp_ns, id=self.id,
            kind=int(bank.kind[best]), kinds=self._target.kinds,
            unobserved_length=self._unobserved_length, complete=complete, difference=difference,
            ambiguous=ambiguous or self.evidence.doubted_filter(stamp_ns))
            for (stamp_ns, x, P), difference in zip(states, self.opinion.differences(states),
                                                    strict=True)]


def in_order(members: Sequence[Member], new: Member | None, joint: Joint, n_one: int
             ) -> list[Member]:
    """Members, and a new target, in the order of the states of a `Joint`.

    Where two vehicles take the place of one, that is the one of them which was where its poses
    were. Each vehicle has `n_one` states.
    """
    others = list(members)
    old = others.pop(joint.replaced) if joint.replaced is not None else None
    if new is None or old is None:
        return [*others, *([old] if old else []), *([new] if new else [])]
    first = n_one * len(others)
    paths = np.array([path[joint.bank.best(), first:] for path in joint.window.paths])
    stamps = [frame.stamp_ns for frame in joint.window.frames]
    away = [old.distance_from(stamps, paths[:, k * n_one:k * n_one + 2]) for k in (0, 1)]
    return [*others, old, new] if away[0] <= away[1] else [*others, new, old]
