"""Vehicles that cross the counting lines of a network: passages and summaries of a recording."""

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
from mag_tracking.apps.replay_notes import no_track_reason
from mag_tracking.errors import SettingsError
from mag_tracking.event_records import TrafficSummary, VehiclePassage
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Output, Pipeline, Settings, settings_for
from mag_tracking.recording.interruptible import ReadingStopped, until_stopped
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import FieldFrame, Track
from mag_tracking.units import NS

FORGOTTEN_S = 300.0
"""[s] The fields of a track that has ended are kept for its passage for this time."""


@dataclass(frozen=True)
class CountedVehicle:
    """A passage, and its speed by the delay between sensors."""

    passage: VehiclePassage
    delay: CorrelatedMotion
    """Independent of the model of the track; its `reason` says why it is missing."""

    @property
    def speeds_contradict(self) -> bool:
        """Whether speed or direction contradict the delays."""
        p = self.passage
        heading = float(np.arctan2(p.velocity[1], p.velocity[0]))
        return contradicts_delays((p.speed, p.speed_std), (heading, p.heading_std), self.delay)


@dataclass(frozen=True)
class TrafficResult:
    """The traffic in a recording."""

    class_names: tuple[str, ...]
    """In the order of `VehiclePassage.class_probabilities`."""
    vehicles: tuple[CountedVehicle, ...]
    """In order of time."""
    summaries: tuple[TrafficSummary, ...]
    """One for each line and interval."""
    counts: dict[str, int]
    """{what: number}: tracks that crossed no line, and others that were not counted."""
    rejections: dict[str, int]
    """{cause: number} of readings that were not used."""
    missing_topics: tuple[str, ...]
    sensors_without_background: tuple[str, ...]
    no_detection_reason: str | None
    """One sentence where nothing was detected; else None."""
    no_track_reason: str | None
    """One sentence where one sensor alone measured, so that nothing was tracked; else None."""

    def __repr__(self) -> str:
        lines = dict(Counter(v.passage.line for v in self.vehicles))
        return f'TrafficResult({len(self.vehicles)} vehicles, {lines or "no line was crossed"})'


def traffic(recording: str | PathLike[str], network: SensorNetwork | str | PathLike[str],
            settings: Mapping[str, Any] | None = None) -> TrafficResult:
    """Count the vehicles that cross the counting lines of a network.

    Parameters
    ----------
    recording : path
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        What differs from the defaults for a vehicle; `traffic.line_names` and the settings after
        it are the counting lines.

    Returns
    -------
    TrafficResult

    Raises
    ------
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is not valid.
    SettingsError
        If a setting is not valid, or the target is not a vehicle.
    """
    return count_traffic(Recording(recording), network_of(network),
                         settings_for('vehicle', settings))


def count_traffic(recording: Recording, network: SensorNetwork, settings: Settings,
                  progress: Callable[[int], object] | None = None,
                  stopped: Callable[[], bool] | None = None) -> TrafficResult:
    """The traffic in a recording; `progress` and `stopped` are as for `apps.replay.replay`.

    Raises
    ------
    RecordingError
    SettingsError
    """
    if settings.track.target != 'vehicle':
        raise SettingsError(f'traffic counts vehicles; the target is a {settings.track.target}')
    pipeline = Pipeline(network, settings)
    reader = SampleReader(recording, network)
    prescan_of(recording, network, settings.calibrate, stopped).apply(pipeline.calibrate)
    counter = _Counter(network)
    try:
        for readings in until_stopped(reader.readings, progress, stopped):
            counter.take(pipeline.feed(readings))
    except ReadingStopped:
        pass
    counter.take(pipeline.flush())
    rejections = dict(reader.rejected + Counter(pipeline.rejections()))
    why = no_detection_reason(network, settings, pipeline.calibrate, pipeline.detect,
                           reader.missing_topics(), rejections)
    return TrafficResult(settings.traffic.class_names, tuple(counter.vehicles),
                         tuple(counter.summaries), dict(pipeline.traffic.counts), rejections,
                         tuple(reader.missing_topics()), tuple(pipeline.calibrate.unready()), why,
                         no_track_reason(pipeline.counts()['track']))


class _Counter:
    """Collects passages and summaries, and the fields of running tracks for the delays."""

    def __init__(self, network: SensorNetwork) -> None:
        self._network = network
        self._frame: FieldFrame | None = None
        self._before_jump: set[int] = set()
        self._frames: dict[int, list[FieldFrame]] = {}
        self.vehicles: list[CountedVehicle] = []
        self.summaries: list[TrafficSummary] = []

    def take(self, records: Iterable[Output]) -> None:
        """Take the outputs of a batch of readings."""
        for record in records:
            if isinstance(record, FieldFrame):
                self._forget(record.stamp_ns)
                self._frame = record
            elif isinstance(record, Track) and not record.ended:
                assert self._frame is not None, 'a pose without a frame'
                self._frames.setdefault(record.id, []).append(self._frame)
            elif isinstance(record, VehiclePassage):
                self.vehicles.append(CountedVehicle(record, self._delay(record.track_id)))
            elif isinstance(record, TrafficSummary):
                self.summaries.append(record)

    def _forget(self, now_ns: int) -> None:
        """Drop the fields of tracks that ended long ago, or before time jumped back."""
        old = self._before_jump or {id for id, frames in self._frames.items()
                                    if now_ns - frames[-1].stamp_ns > FORGOTTEN_S * NS}
        for id in old:
            del self._frames[id]
        # Their passages come with the frame that jumped back.
        jumped = self._frame is not None and now_ns < self._frame.stamp_ns
        self._before_jump = set(self._frames) if jumped else set()

    def _delay(self, id: int) -> CorrelatedMotion:
        """The motion of a track by the delays between the sensors."""
        frames = self._frames.get(id)
        if not frames:
            return CorrelatedMotion('its fields were no longer kept')
        begin, end = frames[0].stamp_ns, frames[-1].stamp_ns
        if any(other[0].stamp_ns <= end and begin <= other[-1].stamp_ns
               for name, other in self._frames.items() if name != id):
            return CorrelatedMotion('another vehicle was near')
        return correlated_motion(PassData.of_frames(
            self._network, [f.stamp_ns for f in frames], [f.field for f in frames],
            [f.covariance for f in frames], [f.time_offset for f in frames]))
