"""The bank of a running track, with the frames that are kept to relinearise and to smooth it."""

from collections import Counter
from copy import copy
from dataclasses import dataclass

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.inference.initial_bank import InitialBank
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.bank_size import WEIGHT_KEPT, max_hypotheses, max_sensors
from mag_tracking.stages.track.joint import Joint
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.reach import weak_from
from mag_tracking.stages.track.relinearisation import Relinearisation, Window
from mag_tracking.stages.track.sensor_rejection import SensorRejection
from mag_tracking.stages.track.sensor_selection import SensorSubset, hand_on
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.smoothing import FixedLag, TrackState, WholeTrack
from mag_tracking.stages.track.target import Target
from mag_tracking.units import NS


@dataclass(frozen=True)
class Advance:
    """A bank was moved through a frame."""

    frame: FieldFrame
    """What was used of it."""
    dt: float
    """[s] Since the frame before."""
    predicted: FloatArray
    """(n_hyp, n_x) before the update."""
    log_likelihood: FloatArray
    """(n_hyp,)"""
    evidence: float
    """Log-density of the frame by all hypotheses; -inf where none explains it."""
    n_rejected: int
    """Sensors that were left out."""


class TrackBank:
    """Hypotheses of the targets of a track, and the filter, sensors and frames that they are of.

    Attributes
    ----------
    bank : FilterBank
    filter : BankFilter
    sensors : SensorSubset
        Those that it uses.
    later : SensorSubset or None
        Those that it will use once the bank is small enough.
    """

    def __init__(self, target: Target, settings: TrackSettings, sensors: SensorSubset,
                 bank_filter: BankFilter, bank: FilterBank, counts: 'Counter[str]',
                 later: SensorSubset) -> None:
        """Parameters as for `RunningTrack`."""
        self._target, self._settings, self._counts = target, settings, counts
        self.bank, self.filter, self.sensors = bank, bank_filter, sensors
        self.later: SensorSubset | None = later
        self._rejection = SensorRejection(sensors.network.names)
        self._relinearisation = Relinearisation(
            settings.relinearise_interval_s, settings.relinearise_window_s,
            settings.relinearise_max_hypotheses)
        self._whole = WholeTrack(settings.max_smoothing_s)
        self._lag = FixedLag(settings.smoothing_lag_s) if settings.smoothing_lag_s else None

    @property
    def one(self) -> Observation:
        """How the sensors see a single target."""
        return self.filter.observation.of_one

    @property
    def window(self) -> Window | None:
        """The latest frames, with the paths of the hypotheses."""
        return self._relinearisation.window

    @property
    def is_lagged(self) -> bool:
        """Whether poses are smoothed with a fixed lag."""
        return self._lag is not None

    def gain(self, row: int) -> float:
        """[nats] Of the latest frames along the path of a hypothesis, less than in its filter."""
        return self._relinearisation.gain(int(self.bank.origin[row]))

    def filter_of(self, n_targets: int) -> BankFilter:
        """The filter of so many targets."""
        return BankFilter(self.sensors.network, self._target.model, self._settings, n_targets)

    def configure(self, settings: TrackSettings) -> None:
        """Apply new values of the live settings."""
        self._settings = settings
        self.filter.configure(settings)
        self._relinearisation.restart()

    def begin(self, first: FieldFrame, now: FieldFrame) -> None:
        """The bank, which is of the time of the frame `now`, begins with an earlier one."""
        if first is not now:
            self.filter.move(self.bank, (first.stamp_ns - now.stamp_ns) / NS)
        start = InitialBank.of(self.bank, self.filter.observation.n_target)
        self._whole.begin(copy(start), self.filter)
        self._relinearisation.begin(start)

    def advance(self, frame: FieldFrame, dt: float) -> Advance:
        """Move the bank through a frame of the sensors that it uses, and weigh it."""
        predicted, log_likelihood, used, rejected = self._rejection.advance(
            self.filter, self.bank, frame, dt)
        self._counts.update(rejected)
        return Advance(used, dt, predicted, log_likelihood, self.bank.reweight(log_likelihood),
                       len(rejected))

    def keep(self, advance: Advance, publish: bool) -> None:
        """Keep the frame of an `Advance`; drop what is improbable, and relinearise the rest."""
        s, bank = self._settings, self.bank
        self._relinearisation.add(bank, advance.predicted, advance.log_likelihood,
                                  advance.evidence, advance.frame, advance.dt)
        self._counts['hypotheses dropped'] += bank.prune(
            -np.log(s.prune_ratio),
            s.max_hypotheses if publish else max(s.max_hypotheses, s.max_initial_hypotheses))
        self._counts.update(self._relinearisation.improve(self.filter, bank))
        self._whole.add(bank, advance.frame, advance.dt, publish)

    def lagged(self, best: int, frame: FieldFrame, dt: float, publish: bool) -> list[TrackState]:
        """States that now lie the fixed lag back, by hypothesis `best`."""
        return [] if self._lag is None else self._lag.smoothed(self.filter, self.bank, best, frame,
                                                               dt, publish)

    def rest_of_lag(self, best: int) -> list[TrackState]:
        """States that are left of the fixed lag: the track ends."""
        return [] if self._lag is None else self._lag.rest(self.filter, self.bank, best)

    def smoothed(self, best: int, counts: bool = True) -> list[TrackState]:
        """States of the frames that are kept, by all of them and hypothesis `best`."""
        states, left_out = self._whole.smoothed(self.bank, best)
        if counts:
            self._counts['frames left out of smoothing'] += left_out
            self._counts['tracks too long to smooth'] += self._whole.too_long
        return states

    def without_target(self, i: int) -> None:
        """Target `i` of several is over."""
        best, n_targets = self.bank.best(), self.filter.observation.n_targets
        n = weak_from(self.filter, i, self.window, int(self.bank.origin[best]))
        self._relinearisation.without_target(self.filter, self.bank, i, n)
        self.bank = self.bank.without_target(i, self.one.n_target)
        self.filter = self.filter_of(n_targets - 1)
        self._rejection.clear()
        self._forget_lag()

    def resume(self, joint: Joint) -> None:
        """Go on with another explanation of the latest frames."""
        self.bank, self.filter = joint.bank, joint.bank_filter
        self._relinearisation.resume(joint.window)
        self._whole.resume(joint.window, self.filter)
        self._rejection.clear()
        self._forget_lag()

    def _forget_lag(self) -> None:
        """The states have changed: what is kept of the fixed lag is of others."""
        if self._lag is not None:
            self._lag.clear()

    def hand_over(self, best: int) -> bool:
        """Switch to the sensors near where hypothesis `best` is going; whether they are others."""
        sensors = self.sensors.ahead_of(self.bank.x[best], min(
            self._settings.max_sensors, max_sensors(self.filter.observation, len(self.bank))))
        if sensors is self.sensors:
            return False
        self._hand_on_to(sensors)
        self._whole.give_up()
        self._relinearisation.restart()
        self._counts['tracks handed on to other sensors'] += 1
        return True

    def widen(self, dt: float) -> bool:
        """Use all sensors from the next frame on, which comes in `dt` [s], if the frames until now
        have made enough hypotheses improbable; else they come in with a handover. Whether it did.
        """
        sensors, self.later = self.later or self.sensors, None
        n, most = len(sensors.rows), max_hypotheses(self.filter.observation, len(sensors.rows))
        if n == len(self.sensors.rows) or not self.bank.is_concentrated_in(most, WEIGHT_KEPT):
            return False
        self._counts['hypotheses dropped'] += self.bank.prune(np.inf, most)
        self._hand_on_to(sensors)
        anchor = self.bank.copy()
        self.filter.move(anchor, dt)
        self._whole.begin(anchor, self.filter)
        self._relinearisation.begin(anchor.copy())
        return True

    def _hand_on_to(self, sensors: SensorSubset) -> None:
        """Give the hypotheses the states of other sensors."""
        before, self.sensors = self.sensors.rows, sensors
        self.filter = self.filter_of(1)
        self._rejection = SensorRejection(sensors.network.names)
        hand_on(self.bank, before, sensors.rows, self.filter.observation.own_covariance,
                self._settings.background_std)
        self._forget_lag()
