"""Traffic in a recording: passages of vehicles across counting lines, and summaries."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.analysis.correlated_motion import (
    CorrelatedMotion,
    contradicts_delays,
    correlated_motion,
)
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.apps.no_detection import no_detection_reason
from mag_tracking.apps.prescan import prescan_of
from mag_tracking.apps.readings import network_of
from mag_tracking.apps.replay_notes import no_track_reason, replay_findings
from mag_tracking.errors import SettingsError
from mag_tracking.event_records import TrafficSummary, VehiclePassage
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Output, Pipeline, Settings, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.recording.interruptible import ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import FieldFrame, Track
from mag_tracking.stages.health.diagnosis import Diagnosis, ranked
from mag_tracking.units import NS

RETENTION_S = 300.0
"""Time for which frames of an ended track are kept, because its passage is reported later [s]."""


@dataclass(frozen=True)
class CountedVehicle:
    """Passage of a vehicle, with the velocity estimated from the delays between the sensors."""

    passage: VehiclePassage
    """Passage across a line."""
    delay: CorrelatedMotion
    """Velocity from the delays, independent of the tracker; `reason` explains a missing value."""

    @property
    def speeds_contradict(self) -> bool:
        """Whether the speed or direction of the track contradicts the delays."""
        p = self.passage
        heading = float(np.arctan2(p.velocity[1], p.velocity[0]))
        return contradicts_delays((p.speed, p.speed_std), (heading, p.heading_std), self.delay)


@dataclass(frozen=True)
class TrafficResult:
    """Counted vehicles and traffic summaries of a recording."""

    class_names: tuple[str, ...]
    """Classes, in the order of `VehiclePassage.class_probabilities`."""
    vehicles: tuple[CountedVehicle, ...]
    """Counted vehicles in chronological order."""
    summaries: tuple[TrafficSummary, ...]
    """One summary per line and interval."""
    counts: dict[str, int]
    """{event: number}, for events such as passages, or tracks that crossed no line."""
    rejections: dict[str, int]
    """Readings that were not used: {cause: number}."""
    missing_topics: tuple[str, ...]
    """Topics of the network that are not in the recording."""
    sensors_without_background: tuple[str, ...]
    """Sensors whose background was not learnt."""
    no_detection_reason: str | None
    """Explanation, in one sentence, of why nothing was detected; None if a target was detected."""
    no_track_reason: str | None
    """Explanation if nothing was tracked because only one sensor measured the target, else None."""
    diagnoses: tuple[Diagnosis, ...]
    """Diagnoses of the recording, the sensors and the stages."""

    def __repr__(self) -> str:
        lines = dict(Counter(v.passage.line for v in self.vehicles))
        return (f'TrafficResult({quantity(len(self.vehicles), "vehicle")}, '
                f'{lines or "no line was crossed"})')


def traffic(recording: str | PathLike[str], network: SensorNetwork | str | PathLike[str],
            settings: Mapping[str, Any] | None = None) -> TrafficResult:
    """Count the vehicles that cross the counting lines of a network.

    Parameters
    ----------
    recording : path
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        Settings that differ from the defaults for a vehicle; `traffic.line_*` define the counting
        lines.

    Returns
    -------
    TrafficResult

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is invalid.
    SettingsError
        If a setting is invalid, or the target is not a vehicle.
    """
    return count_traffic(Recording(recording), network_of(network),
                         settings_for('vehicle', settings))


def count_traffic(recording: Recording, network: SensorNetwork, settings: Settings,
                  progress: Callable[[int], object] | None = None,
                  stopped: Callable[[], bool] | None = None) -> TrafficResult:
    """Count the vehicles in an open recording; raises SettingsError if the target is not a
    vehicle."""
    if settings.track.target != 'vehicle':
        raise SettingsError('traffic counts only vehicles; set the target to vehicle instead of '
                            f'{settings.track.target}')
    pipeline = Pipeline(network, settings)
    reader = SampleReader(recording, network)
    prescan_of(recording, network, settings.calibrate, stopped).apply(pipeline.calibrate)
    collector = _TrafficCollector(network)
    try:
        for readings in until_stopped(reader.readings, progress, stopped):
            collector.add(pipeline.feed(readings))
    except ReadingStopped:
        pass
    collector.add(pipeline.flush())
    rejections = dict(reader.rejected + Counter(pipeline.rejections()))
    reason = no_detection_reason(network, settings, pipeline.calibrate, pipeline.detect,
                                 reader.missing_topics(), rejections)
    return TrafficResult(tuple(c.name for c in settings.traffic.classes), tuple(collector.vehicles),
                         tuple(collector.summaries), dict(pipeline.traffic.counts), rejections,
                         tuple(reader.missing_topics()), tuple(pipeline.calibrate.unready()),
                         reason, no_track_reason(pipeline.counts()['track']),
                         tuple(ranked(replay_findings(recording, reader, pipeline, reason))))


class _TrafficCollector:
    """Collects passages and summaries; stores the frames of tracks to compute the delays."""

    def __init__(self, network: SensorNetwork) -> None:
        self._network = network
        self._frame: FieldFrame | None = None
        self._tracks_before_jump: set[int] = set()
        self._frames: dict[int, list[FieldFrame]] = {}
        self.vehicles: list[CountedVehicle] = []
        self.summaries: list[TrafficSummary] = []

    def add(self, records: Iterable[Output]) -> None:
        """Add the outputs of a batch of readings."""
        for record in records:
            if isinstance(record, FieldFrame):
                self._drop_old(record.stamp_ns)
                self._frame = record
            elif isinstance(record, Track) and not record.ended:
                assert self._frame is not None, 'a pose without a frame'
                self._frames.setdefault(record.id, []).append(self._frame)
            elif isinstance(record, VehiclePassage):
                self.vehicles.append(CountedVehicle(record, self._delay_motion(record.track_id)))
            elif isinstance(record, TrafficSummary):
                self.summaries.append(record)

    def _drop_old(self, now_ns: int) -> None:
        """Drop frames of tracks that ended before a time jump, or more than `RETENTION_S` ago."""
        old_ids = self._tracks_before_jump or {track_id for track_id, frames in self._frames.items()
                                               if now_ns - frames[-1].stamp_ns > RETENTION_S * NS}
        for track_id in old_ids:
            del self._frames[track_id]
        # Passages of tracks from before the jump arrive with the frame that jumped back.
        jumped_back = self._frame is not None and now_ns < self._frame.stamp_ns
        self._tracks_before_jump = set(self._frames) if jumped_back else set()

    def _delay_motion(self, track_id: int) -> CorrelatedMotion:
        """Compute the velocity of a track from sensor delays; `reason` explains a missing value."""
        frames = self._frames.get(track_id)
        if not frames:
            return CorrelatedMotion('the fields of the track are no longer stored')
        begin, end = frames[0].stamp_ns, frames[-1].stamp_ns
        if any(other[0].stamp_ns <= end and begin <= other[-1].stamp_ns
               for other_id, other in self._frames.items() if other_id != track_id):
            return CorrelatedMotion('another vehicle was near')
        return correlated_motion(PassData.from_frames(
            self._network, [f.stamp_ns for f in frames], [f.field for f in frames],
            [f.covariance for f in frames], [f.time_offset for f in frames]))
