"""Bank of a running track, with the frames that are stored for relinearisation and smoothing."""

from collections import Counter
from copy import copy
from typing import NamedTuple

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.filter_bank import FilterBank, InitialBank
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track import sensor_selection
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.joint import JointExplanation
from mag_tracking.stages.track.observation import Observation
from mag_tracking.stages.track.relinearisation import Relinearisation
from mag_tracking.stages.track.sensor_selection import SensorRejection, SensorSubset
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.smoothing import NOT_SMOOTHED, FixedLag, TrackState, WholeTrack
from mag_tracking.stages.track.target import MIN_WEIGHT, Target, max_hypotheses, max_sensors
from mag_tracking.units import NS

PRUNE_RATIO = 1e-12
"""Relative weight below which a hypothesis is dropped ([T10]_ Alg. 3)."""
MAX_INITIAL_HYPOTHESES = 1200
"""Maximum number of hypotheses before the detection, where frames hardly show the origin."""
RELINEARISE_INTERVAL_S, MAX_RELINEARISED = 0.15, 20
"""[s] Interval between relinearisations, and maximum number of relinearised hypotheses."""


class FrameUpdate(NamedTuple):
    """Result of the prediction and update of a bank with a frame."""

    frame: FieldFrame
    """Frame of the update, in which rejected sensors are missing."""
    dt: float
    """[s] Time since the previous frame."""
    predicted: FloatArray
    """(n_hyp, n_x) States before the update."""
    log_likelihood: FloatArray
    """(n_hyp,) Log-likelihood of the frame for each hypothesis."""
    evidence: float
    """Log-density of the frame over all hypotheses; -inf if no hypothesis explains it."""
    n_rejected: int
    """Number of rejected sensors."""


class TrackBank:
    """Hypotheses of the targets of a track, with their filter, sensors and frames; `later_sensors`
    will be used as soon as the bank is small enough, and are None afterwards."""

    def __init__(self, target: Target, settings: TrackSettings, sensors: SensorSubset,
                 bank_filter: BankFilter, bank: FilterBank, counts: 'Counter[str]',
                 later_sensors: SensorSubset) -> None:
        self.target, self.settings, self._counts = target, settings, counts
        self.bank, self.filter, self.sensors = bank, bank_filter, sensors
        self.later_sensors: SensorSubset | None = later_sensors
        self._rejection = SensorRejection(sensors.network.names)
        self.relinearisation = Relinearisation(
            RELINEARISE_INTERVAL_S, settings.relinearise_window_s, MAX_RELINEARISED)
        self._whole_track = WholeTrack(settings.max_smoothing_s)
        self.lag = FixedLag(settings.smoothing_lag_s)

    @property
    def single_target(self) -> Observation:
        """Measurement model of a single target."""
        return self.filter.observation.single_target

    def filter_of(self, n_targets: int) -> BankFilter:
        """Filter for a given number of targets."""
        return BankFilter(self.sensors.network, self.target.model, self.settings, n_targets)

    def configure(self, settings: TrackSettings) -> None:
        """Apply new values of the live settings."""
        self.settings = settings
        self.filter = self.filter_of(self.filter.observation.n_targets)
        self.relinearisation.restart()

    def begin(self, first: FieldFrame, detection: FieldFrame) -> None:
        """Move the bank back from the detection to the first frame, and begin to store frames."""
        if first is not detection:
            self.filter.move(self.bank, (first.stamp_ns - detection.stamp_ns) / NS)
        start = InitialBank.of(self.bank, self.filter.observation.n_target)
        self._whole_track.begin(copy(start), self.filter)
        self.relinearisation.begin(start)

    def advance(self, frame: FieldFrame, dt: float) -> FrameUpdate:
        """Predict and update the bank with a frame, and weight the hypotheses."""
        predicted, log_likelihood, used, rejected = self._rejection.advance(
            self.filter, self.bank, frame, dt)
        self._counts.update(rejected)
        return FrameUpdate(used, dt, predicted, log_likelihood, self.bank.reweight(log_likelihood),
                           len(rejected))

    def restart_after_gap(self, frame: FieldFrame, dt: float) -> list[TrackState] | None:
        """Start the hypotheses again at the time of `frame` if the target was lost in the gap
        before it, and return the smoothed states before the gap; None if not started again."""
        network = self.sensors.network
        if not self.target.is_lost_after(self.settings, network, dt):
            return None
        bank = self.target.start(self.settings, network, frame,
                                  self.filter.observation.own_covariance)
        if bank is None:
            return None
        states = self.smoothed(self.bank.best(), False)
        self.bank = bank
        self._counts['hypotheses started again after a gap'] += 1
        self.lag.clear()
        self.begin(frame, frame)
        return states

    def store_and_prune(self, update: FrameUpdate, publish: bool) -> None:
        """Store a frame, drop improbable hypotheses, and relinearise if due."""
        s, bank = self.settings, self.bank
        self.relinearisation.add(bank, update.predicted, update.log_likelihood, update.evidence,
                                 update.frame, update.dt)
        self._counts['hypotheses dropped'] += bank.prune(
            -np.log(PRUNE_RATIO),
            s.max_hypotheses if publish else max(s.max_hypotheses, MAX_INITIAL_HYPOTHESES))
        self._counts.update(self.relinearisation.relinearise_leading(self.filter, bank))
        self._whole_track.add(bank, update.frame, update.dt, publish)

    def smoothed(self, best: int, counts: bool = True) -> list[TrackState]:
        """Smoothed states of hypothesis `best` at published frames, if any."""
        states, n_excluded = self._whole_track.smoothed(self.bank, best)
        if counts:
            self._counts['frames left out of smoothing'] += n_excluded
            self._counts[NOT_SMOOTHED] += self._whole_track.is_abandoned
        return states

    def without_target(self, i: int) -> None:
        """Remove target `i` from the hypotheses, the filter and the relinearisation window."""
        self.relinearisation.without_target(self.filter, self.bank, i)
        self.bank = self.bank.without_target(i, self.single_target.n_target)
        self.filter = self.filter_of(self.filter.observation.n_targets - 1)
        self._rejection.clear()
        self.lag.clear()

    def resume(self, joint: JointExplanation) -> None:
        """Continue with another explanation of the latest frames."""
        self.bank, self.filter = joint.bank, joint.bank_filter
        self.relinearisation.resume(joint.window)
        self._whole_track.resume(joint.window, self.filter)
        self._rejection.clear()
        self.lag.clear()

    def hand_over(self, best: int) -> bool:
        """Switch to the sensors near the predicted position; return whether they changed."""
        sensors = self.sensors.ahead_of(self.bank.x[best], min(
            self.settings.max_sensors, max_sensors(self.filter.observation, len(self.bank))))
        if sensors is self.sensors:
            return False
        self._switch_sensors(sensors)
        self._whole_track.abandon()
        self.relinearisation.restart()
        self._counts['tracks handed over to other sensors'] += 1
        return True

    def widen(self, dt: float) -> bool:
        """Add the remaining sensors from the next frame on, in `dt` seconds, if few hypotheses are
        probable, else at a later handover; return whether the sensors have changed."""
        sensors, self.later_sensors = self.later_sensors or self.sensors, None
        n, n_hyp = len(sensors.rows), max_hypotheses(self.filter.observation, len(sensors.rows))
        if n == len(self.sensors.rows) or not self.bank.is_concentrated_in(n_hyp, MIN_WEIGHT):
            return False
        self._counts['hypotheses dropped'] += self.bank.prune(np.inf, n_hyp)
        self._switch_sensors(sensors)
        anchor = self.bank.copy()
        self.filter.move(anchor, dt)
        self._whole_track.begin(anchor, self.filter)
        self.relinearisation.begin(anchor.copy())
        return True

    def _switch_sensors(self, sensors: SensorSubset) -> None:
        """Switch to other sensors: replace the filter and the sensor states of the hypotheses."""
        before, self.sensors = self.sensors.rows, sensors
        self.filter = self.filter_of(1)
        self._rejection = SensorRejection(sensors.network.names)
        sensor_selection.exchange_sensor_states(
            self.bank, before, sensors.rows, self.filter.observation.own_covariance,
            self.settings.background_std)
        self.lag.clear()
