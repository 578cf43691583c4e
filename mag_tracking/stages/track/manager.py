"""Track management: tracks begin with a detection, and end with it or if the target is lost."""

from collections import Counter, deque

import numpy as np

from mag_tracking.arrays import BoolArray
from mag_tracking.calibration.doubtful_times import DoubtfulTimes, InputDoubts, are_doubtful
from mag_tracking.errors import NetworkError
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.cross_check import ClockComparison
from mag_tracking.stages.track.disturbances import Disturbances
from mag_tracking.stages.track.observation import MAX_ROTATION
from mag_tracking.stages.track.plausibility import SampleRates
from mag_tracking.stages.track.running_track import RunningTrack, TrackRecord
from mag_tracking.stages.track.sensor_selection import SensorSubset
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.target import sensors_at_start, target_of
from mag_tracking.stages.track.track_bank import TrackBank
from mag_tracking.units import NS

NO_SCALE = 'detections not tracked (scale not observable with one sensor)'
NO_SCALE_FRAMES = 'frames in which no track could start (scale not observable with one sensor)'
TOO_SLOW = 'detections not tracked (the rate of the sensors is too low)'
UNCERTAIN_ORIENTATIONS = ('sensors with an orientation uncertainty above '
                          f'{np.degrees(MAX_ROTATION):g} degrees')
"""Keys of event counts that others use."""
RESTART_ENERGY_RATIO = 4.0
"""Minimum energy of the first frame after a lost track, relative to its maximum."""


class TrackManager:
    """Turns frames with a detection verdict into tracks, and continues a clock comparison.

    It returns one `Track` per frame and target, smoothed poses with a fixed lag, and at the end
    those of the whole track. Vehicles that appear during a track become its members. Raises
    SettingsError if the settings contradict each other.
    """

    def __init__(self, network: SensorNetwork, settings: TrackSettings,
                 clocks: ClockComparison | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self._clocks = clocks or ClockComparison(len(network))
        self._network, self._settings = network, settings
        self._target = target_of(settings, network)
        self._track: RunningTrack | None = None
        self._next_id = 1
        self._recent: deque[FieldFrame] = deque()
        self._last_ns: int | None = None
        # [T^2] Maximum energy of the field since the start of the latest track.
        self._max_energy = 0.0
        # [T^2] Energy above which a track starts; None if no target was lost in the detection.
        self._restart_energy: float | None = None
        self._next_network: SensorNetwork | None = None
        self._disturbances = Disturbances(network.names)
        self._rates = SampleRates(network, settings)
        self._input_doubts: InputDoubts = {}
        self._doubtful_rows: dict[str, dict[int, DoubtfulTimes]] = {}
        if n_uncertain := sum(bool(s is not None and s.max() > MAX_ROTATION)
                              for s in network.orientation_std):
            self.counts[UNCERTAIN_ORIENTATIONS] = n_uncertain

    def use_network(self, network: SensorNetwork) -> None:
        """Apply another calibration when no track runs; raises NetworkError for other sensors."""
        if network.names != self._network.names:
            raise NetworkError(f'the calibration is for other sensors: {", ".join(network.names)}; '
                               f'the tracker uses {", ".join(self._network.names)}')
        self._next_network = network

    def configure(self, settings: TrackSettings) -> None:
        """Apply new values of the live settings, also to a running track."""
        self._settings = settings
        if self._track is not None:
            self._track.configure(settings)

    def set_input_doubts(self, doubts: InputDoubts) -> None:
        """Replace {reason: {sensor: times}}, with which tracks become doubtful."""
        if doubts != self._input_doubts:
            self._input_doubts = doubts
            self._doubtful_rows = {reason: {self._network.index(name): t for name, t in
                                            by_sensor.items()}
                                   for reason, by_sensor in doubts.items()}

    def _doubtful_sensors(self, *frames: FieldFrame) -> dict[str, list[int]]:
        """Indices of the sensors with doubtful readings in any of the frames, by reason."""
        return {reason: [j for j, times in by_row.items()
                         if any(f.n_samples[j] and are_doubtful(times, f.stamp_ns) for f in frames)]
                for reason, by_row in self._doubtful_rows.items()}

    @property
    def clock_warning(self) -> str:
        """Message about a significant clock offset; empty if none, or without `cross_check`."""
        offset = self._clocks.largest_offset if self._settings.cross_check else None
        return '' if offset is None else offset.text(self._network.names)

    @property
    def bank(self) -> FilterBank | None:
        """Hypotheses of the running track; None if no track is running."""
        return None if self._track is None else self._track.bank

    def feed(self, frame: FieldFrame) -> list[TrackRecord]:
        """Start, update or end tracks with a frame, and return the resulting records."""
        self.idle()
        if self._next_network is not None and self._track is None:
            if not np.array_equal(self._next_network.clock_offset, self._network.clock_offset):
                self._clocks = ClockComparison(len(self._network))
            self._network, self._next_network = self._next_network, None
        out, previous = self._end_at_gap(frame), self._last_ns
        self._last_ns = frame.stamp_ns
        self.counts['frames'] += 1
        self._rates.add(frame)
        if self._track is None:
            self._disturbances.feed(frame)
        if not frame.target_present:
            out += self._end_all('released', frame.stamp_ns)
            self._restart_energy = None
            self._store_frame(frame)
        elif self._track is not None and previous is not None:
            self._max_energy = max(self._max_energy, _energy(frame))
            self._track.flag_doubtful_sensors(self._doubtful_sensors(frame))
            out += self._track.step(frame, (frame.stamp_ns - previous) / NS)
            out += self._delete_ended(frame.stamp_ns)
        elif self._restart_energy is None or _energy(frame) > self._restart_energy:
            out += self._initiate(frame)
        return out

    def idle(self) -> None:
        """Complete the deferred work: handovers and searches for new targets."""
        if self._track is None:
            return
        self._track.hand_over()
        joint = self._track.new_target()
        if joint is not None:
            self._track.admit(joint, self._next_id)
            self.counts['tracks'] += joint.adds
            self.counts['tracks of new targets' if joint.adds else 'tracks found again'] += 1
            self._next_id += joint.adds

    def end_tracks(self, reason: str) -> list[TrackRecord]:
        """End the track and discard the recent frames, after an interruption of the frames."""
        self._recent.clear()
        self._restart_energy = None
        return self._end_all(reason, self._last_ns)

    def flush(self) -> list[TrackRecord]:
        """End the track at the end of the input."""
        return self._end_all('input ended', self._last_ns)

    def _end_at_gap(self, frame: FieldFrame) -> list[TrackRecord]:
        """End the track after a backward time jump or a long gap, and return its records."""
        if self._last_ns is None:
            return []
        dt = (frame.stamp_ns - self._last_ns) / NS
        if dt <= 0.0:
            self.counts['time jumped back'] += 1
            return self.end_tracks('time jumped back')
        return self.end_tracks('gap in the frames') if dt > self._settings.end_gap_s else []

    def _end_all(self, reason: str, stamp_ns: int | None) -> list[TrackRecord]:
        """End the track and the current disturbance, and return their closing records."""
        out: list[TrackRecord] = [] if self._track is None else self._track.end(reason)
        if stamp_ns is not None:
            out += [*self._delete_ended(stamp_ns), *self._disturbances.end(stamp_ns)]
        return out

    def _delete_ended(self, stamp_ns: int) -> list[TrackRecord]:
        """Delete an ended track; return records of a disturbance that explains it."""
        track = self._track
        if track is None or track.ended is None:
            return []
        self._track = None
        # A track that restarts while the vehicle departs would be placed on the wrong line.
        if track.is_lost and not self._target.starts_anywhere:
            self._restart_energy = RESTART_ENERGY_RATIO * self._max_energy
        out: list[TrackRecord] = []
        for found in track.unexplained:
            self.counts['tracks explained by a disturbance'] += 1
            out += self._disturbances.begin(found, stamp_ns)
        return out

    def _store_frame(self, frame: FieldFrame) -> None:
        """Store a frame for the lookback of a later track, and drop frames that are too old."""
        self._recent.append(frame)
        oldest = frame.stamp_ns - self._settings.lookback_s * NS
        while self._recent and self._recent[0].stamp_ns < oldest:
            self._recent.popleft()

    def _initiate(self, frame: FieldFrame) -> list[TrackRecord]:
        """Start a track, if possible, with the frames before the detection; return its records."""
        s = self._settings
        recent = [f for f in self._recent if frame.stamp_ns - f.stamp_ns <= s.lookback_s * NS]
        obstacle = self._obstacle(frame, *recent)
        if obstacle is not None:
            self.counts[obstacle] += 1
            if obstacle == NO_SCALE_FRAMES:
                self._store_frame(frame)
            else:
                self._restart_energy = np.inf
            return []
        later_sensors = self._sensors_at(frame, s.max_sensors)
        n_at_start = sensors_at_start(s, self._network, self._target.model)
        sensors = later_sensors if n_at_start >= len(later_sensors.rows) \
            else self._sensors_at(frame, n_at_start)
        bank_filter = BankFilter(sensors.network, self._target.model, s)
        bank = self._target.start(s, sensors.network, sensors.part_of(frame),
                                  bank_filter.observation.own_covariance)
        self._recent.clear()
        if bank is None:
            self.counts['frames in which no track could start'] += 1
            return []
        self.counts['tracks'] += 1
        is_in_tail = self._restart_energy is not None
        if is_in_tail:
            self.counts['tracks started in a larger field after the target of a detection was '
                        'lost'] += 1
        self._restart_energy, self._max_energy = None, _energy(frame)
        track = self._track = RunningTrack(self._next_id, TrackBank(
            self._target, s, sensors, bank_filter, bank, self.counts, later_sensors), self.counts,
            self._clocks)
        self._next_id += 1
        track.flag_doubtful_sensors(self._doubtful_sensors(*recent, frame))
        out = track.begin(
            frame, recent,
            approach_unobserved=is_in_tail or bool(recent) and _n_sensors(*recent) < 2)
        return out + self._delete_ended(frame.stamp_ns)

    def _obstacle(self, *frames: FieldFrame) -> str | None:
        """Reason why no track can start with these frames, or None."""
        has_prior = self._settings.single_sensor_prior
        if len(self._network) == 1 and not has_prior:
            return NO_SCALE
        n_required = 1 if has_prior or self._target.starts_anywhere else 2
        is_slow = self._rates.are_slow()
        if is_slow.any() and _n_sensors(*frames, without=is_slow) < n_required:
            return TOO_SLOW
        return NO_SCALE_FRAMES if _n_sensors(*frames) < n_required else None

    def _sensors_at(self, frame: FieldFrame, n: int) -> SensorSubset:
        """Up to `n` sensors for a new track, nearest to the sensor with the strongest field."""
        if len(self._network) <= n:
            return SensorSubset(self._network)
        strongest = int(np.argmax(whitened_energy(frame.field, frame.covariance)[0]))
        return SensorSubset.near(self._network, self._network.positions[strongest, :2], n)


def _energy(frame: FieldFrame) -> float:
    """Squared norm of the field, summed over all sensors [T²], without the varying weights."""
    return float(np.nansum(np.square(frame.field)))


def _n_sensors(*frames: FieldFrame, without: BoolArray | bool = False) -> int:
    """Number of sensors, `without` some (n_sensors,), that measured in at least one frame."""
    have_measured = np.any([~np.isnan(f.field) for f in frames], axis=(0, 2))
    return int(np.count_nonzero(have_measured & ~np.asarray(without)))
