"""Evidence for the target of a running track, doubts about the track, and the reasons to end it."""

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.doubtful_times import DoubtfulTimes, are_doubtful, updated
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.inference.sequential_tests import InnovationConsistency, TargetBayesFactor
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.disturbances import field_magnitudes
from mag_tracking.stages.track.plausibility import Approach
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NS

MAX_SINGLE_SENSOR_S = 0.5
"""[s] Maximum total time in which only one of several sensors measures."""
LOST, OUT_OF_REACH, UNEXPLAINED = 'target lost', 'out of reach', 'unexplained'
"""Reasons to end a track."""
UNEXPLAINED_S = 3.0
"""[s] Time after which a track ends that a disturbance has always explained better."""
CONTRADICTION = 1e-5
"""Probability below which a field contradicts a track, which may then follow a wrong path."""
OVERFIT_NATS = float(np.log(1e4))
"""[nats] Maximum excess of the log-likelihood in the filter, which linearises each frame at a
different state, over that along the path of the same hypothesis."""
MIN_OBSERVED_FRACTION = 0.5
"""Fraction of the lookback that the frames before the detection of an unambiguous track cover."""
SENSED_LEVEL = 4.0
"""Excess energy of a sensor that has sensed the target, in stds of the energy of noise."""
TRANSIENT_DOUBTS = (doubts.OVERFIT, doubts.DISTURBANCE_MODEL, doubts.INNOVATIONS, doubts.MISFIT,
                    doubts.HEIGHT, doubts.BELOW_SENSORS, doubts.OFF_THE_ROAD,
                    doubts.NO_STEADY_PATH)
"""Doubts about the state of the filter in single frames, which smoothing resolves only in part."""
TRANSIENT_S = 0.1
"""[s] Time for which a transient doubt persists, as it may reappear in the next frame."""
MAX_INTERVALS = 5000
"""Maximum number of stored intervals with doubtful poses; a track that is smoothed has fewer."""


class TrackEvidence:
    """Evidence for a target, and doubts about its whole track; `largest` (n_sensors,) [T] is the
    largest magnitude at each sensor."""

    def __init__(self, n_sensors: int) -> None:
        self.doubts: set[str] = set()
        self.bayes_factor = TargetBayesFactor()
        self.innovations = InnovationConsistency(n_sensors)
        self._approach = Approach()
        self._log_odds = 0.0
        self._single_sensor_s = 0.0
        self.n_consecutive_misfits = 0
        self._overfit_expiry_ns = -1
        # Expiry of each transient doubt, and of each doubt that was flagged for a limited time.
        self._expiry_ns: dict[str, int] = {}
        # Times with transient doubts, and intervals in which smoothed poses are also doubtful.
        self._doubtful_times: DoubtfulTimes = ()
        self._smoothed_intervals: list[tuple[int, int]] = []
        self._min_spread = np.inf
        # Per sensor: whitened energy of its fields in excess of noise, and number of axes.
        self._energy, self._n_axes = np.zeros(n_sensors), np.zeros(n_sensors)
        self.largest: FloatArray = np.zeros(n_sensors)

    @property
    def is_doubtful(self) -> bool:
        """Whether the whole track is doubtful."""
        return bool(self.doubts)

    def add(self, log_likelihood_ratio: float) -> None:
        """Add the log-likelihood ratio of a frame with versus without a target, nats."""
        self._log_odds += log_likelihood_ratio

    def drop_explained_doubts(self) -> None:
        """Drop the doubts that the field of another vehicle explains."""
        self.doubts -= {doubts.CONTRADICTION, doubts.INNOVATIONS, doubts.SENSORS_CONTRADICT,
                        *doubts.PERMANENT}
        self.innovations = InnovationConsistency(len(self.largest))
        self.n_consecutive_misfits, self._overfit_expiry_ns = 0, -1
        for reason in TRANSIENT_DOUBTS:
            self._expiry_ns.pop(reason, None)

    def flag_start(self, approach_unobserved: bool, network: SensorNetwork, starts_anywhere: bool
                   ) -> None:
        """Flag an unobserved start, unless it `starts_anywhere`, or an unknown range."""
        # A target that was not seen approaching may already have passed.
        if approach_unobserved and not starts_anywhere:
            self.doubts.add(doubts.NOT_SEEN_APPROACHING)
        # With a single sensor, the settings determine the range. With a few sensors at one place,
        # errors of the field model determine the range of a vehicle.
        if len(network) == 1 or network.is_compact and not starts_anywhere:
            self.doubts.add(doubts.SENSORS_AT_ONE_PLACE)

    def flag_interval(self, reason: str, stamp_ns: int, seconds: float,
                      since_ns: int | None = None) -> None:
        """Flag the poses within `seconds`, and smoothed ones from `since_ns` on."""
        self._expiry_ns[reason] = until_ns = stamp_ns + round(seconds * NS)
        if since_ns is not None:
            self._smoothed_intervals.append((since_ns, until_ns))

    def check_approach(self, frame: FieldFrame) -> None:
        """Mark the track as doubtful if a frame makes the approach test fail."""
        if self._approach.add(frame):
            self.doubts.add(doubts.NOT_SEEN_APPROACHING)

    def add_frame(self, frame: FieldFrame, rows: IntArray, nis: FloatArray) -> None:
        """Add the fields of sensors `rows`, and their innovations squared `nis` (n,)."""
        energy, n_axes = whitened_energy(frame.field, frame.covariance)
        self._energy[rows] += energy - n_axes
        self._n_axes[rows] += n_axes
        self.largest[rows] = np.maximum(self.largest[rows], field_magnitudes(frame))
        network_nis, network_axes = np.full(len(self.largest), np.nan), np.zeros(len(self.largest))
        network_nis[rows], network_axes[rows] = nis, n_axes
        self.innovations.add(network_nis, network_axes, frame.stamp_ns)

    @property
    def sensed(self) -> BoolArray:
        """Whether each sensor has sensed the target, (n_sensors,)."""
        sensed: BoolArray = self._energy > SENSED_LEVEL * np.sqrt(
            2.0 * np.maximum(self._n_axes, 1.0))
        return sensed

    @property
    def is_sensed_by_one(self) -> bool:
        """Whether fewer than two sensors have sensed the target."""
        return int(np.count_nonzero(self.sensed)) < 2

    def update_doubts(self, found: set[str], stamp_ns: int) -> set[str]:
        """Store the doubts found in a frame; return them with persisting ones."""
        transient = found.intersection(TRANSIENT_DOUBTS)
        self._doubtful_times = updated(
            self._doubtful_times, stamp_ns, bool(transient), MAX_INTERVALS)
        self._expiry_ns |= dict.fromkeys(transient, stamp_ns + round(TRANSIENT_S * NS))
        return found | {reason for reason, expiry_ns in self._expiry_ns.items()
                        if stamp_ns <= expiry_ns}

    def contradicts(self, nis: FloatArray, degrees_of_freedom: int) -> bool:
        """Whether the innovations `nis` (n_sensors,) of a frame, NaN if missing, are too large;
        with at most two sensors, for which many paths fit, this flags the whole track."""
        is_contradiction = bool(np.nansum(nis) > chdtri(degrees_of_freedom, CONTRADICTION))
        if is_contradiction and len(nis) <= 2:
            self.doubts.add(doubts.CONTRADICTION)
        return is_contradiction

    def vehicle_doubts(self, nis: FloatArray, degrees_of_freedom: int,
                       min_bayes_factor: float) -> set[str]:
        """Update and return the doubts from the measurements of a vehicle, with the normalised
        innovation squared `nis` (n_sensors,) of each sensor; NaN if missing."""
        if self.innovations.fails:
            self.doubts.add(doubts.INNOVATIONS)
        return doubts.applying({
            doubts.DISTURBANCE_MODEL: self.bayes_factor.is_recently_disfavoured(min_bayes_factor),
            doubts.CONTRADICTION: self.contradicts(nis, degrees_of_freedom),
            doubts.FELT_BY_ONE_SENSOR: self.is_sensed_by_one,
            doubts.INNOVATIONS: self.innovations.excess > 1.0})

    def update_filter_doubt(self, gain: float, stamp_ns: int, window_s: float) -> bool:
        """Update and return the doubt about the filter, for `window_s` after a frame with a `gain`
        [nats] of the path over the filter below `-OVERFIT_NATS`."""
        if gain < -OVERFIT_NATS:
            self._overfit_expiry_ns = stamp_ns + round(window_s * NS)
        return stamp_ns <= self._overfit_expiry_ns

    def was_filter_doubtful(self, stamp_ns: int) -> bool:
        """Whether a transient doubt or a flagged interval affects the smoothed pose at a time."""
        return are_doubtful((*self._doubtful_times, *self._smoothed_intervals), stamp_ns)

    def count_single_sensor_time(self, is_single_sensor: bool, dt: float) -> None:
        """Update the total time in which only one of several sensors measured; flag the track if it
        is too long for the others to correct its scale, or its choice between mirror images."""
        self._single_sensor_s += dt if is_single_sensor else 0.0
        if self._single_sensor_s > MAX_SINGLE_SENSOR_S:
            self.doubts.add(doubts.ONE_SENSOR)

    @property
    def existence(self) -> float:
        """Probability that there is a target."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self._log_odds, -700.0, 700.0))))

    def reason_to_end(self, track: Track, spread: float, is_approaching: bool,
                      settings: TrackSettings) -> str | None:
        """Update the end conditions with the latest pose; return the reason, if any.

        `spread` [m] is the std of the horizontal position of the published hypothesis alone,
        because differences between hypotheses do not depend on the distance to the target.
        """
        if self.bayes_factor.disfavoured_s(track.stamp_ns) > UNEXPLAINED_S:
            return UNEXPLAINED
        misfit = track.nis > settings.end_nis * track.degrees_of_freedom
        self.n_consecutive_misfits = self.n_consecutive_misfits + 1 if misfit else 0
        if self.n_consecutive_misfits > 1:
            return LOST
        if spread > settings.end_std > self._min_spread and not is_approaching:
            return LOST if misfit else OUT_OF_REACH
        self._min_spread = min(self._min_spread, spread)
        return None
