"""Whether a running track is to be believed, and whether it is still there."""

import numpy as np
from scipy.special import chdtri

from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.doubtful_times import DoubtfulTimes, are_doubtful, noted
from mag_tracking.inference.axes import whitened_energy
from mag_tracking.inference.bayes_factor import TargetBayesFactor
from mag_tracking.inference.innovation_consistency import InnovationConsistency
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.track import doubts
from mag_tracking.stages.track.approach import Approach
from mag_tracking.stages.track.disturbances import size_of
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NS

MAX_SINGLE_SENSOR_S = 0.5
"""[s] A track that one sensor of several has supported alone for longer stays ambiguous."""

LOST = 'lost its target'
OUT_OF_REACH = 'out of reach'
UNEXPLAINED = 'unexplained'
"""Reasons for the end of a track."""

UNEXPLAINED_S = 3.0
"""[s] A track that something else has explained better for so long ends, if a target never did."""

CONTRADICTION = 1e-5
"""A field that is less probable than this contradicts the track of a vehicle. The filter takes it
in, and may afterwards be wrong and agree with all that comes."""

OVERFIT_NATS = float(np.log(1e4))
"""An extended filter linearises each frame elsewhere, and may fit frames better than one path can.
Where the path of the same hypothesis makes them less probable by this, the filter is doubted."""

MIN_WATCHED = 0.5
"""A track that begins with less than this share of its lookback is ambiguous."""

FELT = 4.0
"""Standard deviations of the noise's energy by which that of a sensor's fields must exceed it for
the sensor to have felt the target."""

PASSING_DOUBTS = (doubts.OVERFIT, doubts.SOMETHING_ELSE, doubts.INNOVATIONS, doubts.MISFIT,
                  doubts.HEIGHT, doubts.OFF_THE_ROAD, doubts.NO_STEADY_PATH)
"""Doubts about the filter at one time, which smoothing removes only in part."""

LASTS_S = 0.1
"""[s] Time for which a passing doubt outlasts the frame that it was found in: one that is missing
in a single frame may be back in the next."""

MAX_SEGMENTS = 5000
"""Stretches of doubtful poses that are remembered: more than a track has that is smoothed."""


class TrackEvidence:
    """Evidence for a target, and what speaks against its track.

    Attributes
    ----------
    explanation : TargetBayesFactor
        Against something else than a target.
    innovations : InnovationConsistency
    largest : (n_sensors,) array, T
        Size of the largest field that each sensor measured.
    """

    def __init__(self, n_sensors: int) -> None:
        self.bayes_factor = TargetBayesFactor()
        self.innovations = InnovationConsistency(n_sensors)
        self._approach = Approach()
        # For the whole track.
        self._doubts: set[str] = set()
        self._log_odds = 0.0
        self._single_sensor_s = 0.0
        self._n_misfits = 0
        self._doubts_filter_until_ns = -1
        self._doubtful_times: DoubtfulTimes = ()
        # The latest timestamp of each passing doubt.
        self._found_ns: dict[str, int] = {}
        # Until when other doubts last.
        self._until_ns: dict[str, int] = {}
        # Stretches that also smoothed poses are doubted in.
        self._segments: list[tuple[int, int]] = []
        self._best_spread = np.inf
        # Per sensor: whitened energy of its fields above that of noise, and number of axes.
        self._energy, self._n_axes = np.zeros(n_sensors), np.zeros(n_sensors)
        self.largest: FloatArray = np.zeros(n_sensors)

    @property
    def doubted(self) -> bool:
        """Whether all of the track may be wrong."""
        return bool(self._doubts)

    @property
    def doubts(self) -> set[str]:
        """Doubts about the whole track; a copy."""
        return set(self._doubts)

    def add(self, log_likelihood_ratio: float) -> None:
        """Count a frame: its log-likelihood with a target less that without one."""
        self._log_odds += log_likelihood_ratio

    def doubt(self, reason: str) -> None:
        """From now on all of the track may be wrong."""
        self._doubts.add(reason)

    def forgive(self) -> None:
        """Drop the doubts that another vehicle explains."""
        self._doubts -= {doubts.CONTRADICTION, doubts.INNOVATIONS, doubts.SENSORS_CONTRADICT,
                         *doubts.FOR_GOOD}
        self.innovations = InnovationConsistency(len(self.largest))
        self._n_misfits, self._doubts_filter_until_ns = 0, -1
        self._found_ns.clear()

    def doubt_start(self, approach_unobserved: bool, network: SensorNetwork, starts_anywhere: bool
                    ) -> None:
        """Doubt a track whose target was not seen approaching, or whose range nothing tells.

        `starts_anywhere` is that of the target.
        """
        # One that was not seen approaching may already have passed.
        if approach_unobserved and not starts_anywhere:
            self.doubt(doubts.NOT_SEEN_APPROACHING)
        # The range of a single sensor's target is what the settings say, and that of a vehicle near
        # a few sensors at one place what the model leaves out of its field.
        if len(network) == 1 or network.is_close and not starts_anywhere:
            self.doubt(doubts.SENSORS_AT_ONE_PLACE)

    def doubt_for(self, reason: str, stamp_ns: int, seconds: float,
                  since_ns: int | None = None) -> None:
        """The poses of so many seconds may be wrong; those since an earlier time were, perhaps."""
        self._until_ns[reason] = until_ns = stamp_ns + round(seconds * NS)
        if since_ns is not None:
            self._segments.append((since_ns, until_ns))

    def watch(self, frame: FieldFrame) -> None:
        """Doubt the track where the field has grown unlike that of a target from afar."""
        if self._approach.add(frame):
            self.doubt(doubts.NOT_SEEN_APPROACHING)

    def take(self, frame: FieldFrame, rows: IntArray, nis: FloatArray) -> None:
        """Count what the sensors felt in a frame, and how it fits.

        Parameters
        ----------
        frame : FieldFrame
            Of the sensors that the track uses.
        rows : (n,) int array
            Those, in the network.
        nis : (n,) array
            Normalised innovation squared of the published hypothesis, of each of them.
        """
        energy, n_axes = whitened_energy(frame.field, frame.covariance)
        self._energy[rows] += energy - n_axes
        self._n_axes[rows] += n_axes
        self.largest[rows] = np.maximum(self.largest[rows], size_of(frame))
        of_all, axes_of_all = np.full(len(self.largest), np.nan), np.zeros(len(self.largest))
        of_all[rows], axes_of_all[rows] = nis, n_axes
        self.innovations.add(of_all, axes_of_all, frame.stamp_ns)

    @property
    def felt(self) -> BoolArray:
        """(n_sensors,) whether they have felt the target."""
        felt: BoolArray = self._energy > FELT * np.sqrt(2.0 * np.maximum(self._n_axes, 1.0))
        return felt

    @property
    def is_felt_by_one(self) -> bool:
        """Whether fewer than two sensors have felt the target."""
        return int(np.count_nonzero(self.felt)) < 2

    def note(self, found: set[str], stamp_ns: int) -> set[str]:
        """Record the doubts about the pose of a frame; return them and those that last."""
        passing = found.intersection(PASSING_DOUBTS)
        self._doubtful_times = noted(self._doubtful_times, stamp_ns, bool(passing), MAX_SEGMENTS)
        self._found_ns |= dict.fromkeys(passing, stamp_ns)
        return found | {reason for reason, when in self._found_ns.items()
                        if (stamp_ns - when) / NS <= LASTS_S} \
            | {reason for reason, until in self._until_ns.items() if stamp_ns <= until}

    def contradicts(self, nis: FloatArray, degrees_of_freedom: int) -> bool:
        """Whether a normalised innovation is one that no target of ours makes.

        `nis` (n_sensors,) of each sensor, NaN where it is missing. Two sensors agree with many
        paths: all of the track is then doubted. More of them correct it.
        """
        contradicted = bool(np.nansum(nis) > chdtri(degrees_of_freedom, CONTRADICTION))
        if contradicted and len(nis) <= 2:
            self.doubt(doubts.CONTRADICTION)
        return contradicted

    def vehicle_doubts(self, nis: FloatArray, degrees_of_freedom: int, ratio: float) -> set[str]:
        """Doubts about the pose of a vehicle by what was measured so far.

        `nis` and `degrees_of_freedom` of the frame as for `contradicts`; `ratio` is that by which
        a target has to explain the frames better.
        """
        found = set()
        if self.bayes_factor.fell_behind(ratio):
            found.add(doubts.SOMETHING_ELSE)
        if self.contradicts(nis, degrees_of_freedom):
            found.add(doubts.CONTRADICTION)
        if self.is_felt_by_one:
            found.add(doubts.FELT_BY_ONE_SENSOR)
        if self.innovations.excess > 1.0:
            found.add(doubts.INNOVATIONS)
        if self.innovations.fails:
            self.doubt(doubts.INNOVATIONS)
        return found

    def doubts_filter(self, gain: float, stamp_ns: int, window_s: float) -> bool:
        """Whether the filter fits the frames much better than the path of its hypothesis does.

        Once it did, it is doubted for `window_s`: the frames of the comparison are as old as that.

        Parameters
        ----------
        gain : float [nats]
            Log-likelihood of the latest frames along the path, minus that in the filter.
        stamp_ns : int
            Of the latest frame.
        window_s : float
        """
        if gain < -OVERFIT_NATS:
            self._doubts_filter_until_ns = stamp_ns + round(window_s * NS)
        return stamp_ns <= self._doubts_filter_until_ns

    def doubted_filter(self, stamp_ns: int) -> bool:
        """Whether the filter was doubted at an earlier time."""
        return are_doubtful((*self._doubtful_times, *self._segments), stamp_ns)

    def support(self, by_one_sensor: bool, dt: float) -> None:
        """Count `dt` [s] for which one sensor of several supported the track, or more did.

        A single sensor tells neither the scale nor the mirror image, and the other sensors do not
        always correct the error when they are back.
        """
        self._single_sensor_s += dt if by_one_sensor else 0.0
        if self._single_sensor_s > MAX_SINGLE_SENSOR_S:
            self.doubt(doubts.ONE_SENSOR)

    @property
    def existence(self) -> float:
        """Probability that there is a target."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self._log_odds, -700.0, 700.0))))

    @property
    def ends_in_misfit(self) -> bool:
        """Whether the latest field contradicted the track."""
        return self._n_misfits > 0

    def reason_to_end(self, track: Track, spread: float, is_coming: bool,
                      settings: TrackSettings) -> str | None:
        """Why the track is over after its pose `track`; None while it goes on.

        `spread` [m] is the deviation of the horizontal position of its hypothesis alone: while
        several explain the field, what they differ by says nothing about how far away it is. A
        target that `is_coming` nearer to the sensors is not out of reach, however uncertain.
        """
        if self.bayes_factor.unexplained_s(track.stamp_ns) > UNEXPLAINED_S:
            return UNEXPLAINED
        misfit = track.nis > settings.end_nis * track.degrees_of_freedom
        self._n_misfits = self._n_misfits + 1 if misfit else 0
        if self._n_misfits > 1:
            return LOST
        if spread > settings.end_std > self._best_spread and not is_coming:
            return LOST if misfit else OUT_OF_REACH
        self._best_spread = min(self._best_spread, spread)
        return None
