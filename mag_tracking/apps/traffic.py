"""Traffic in a recording: passages across counting lines, the recognition of enrolled vehicles, and
passes at each sensor."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from mag_tracking.analysis.correlated_motion import (
    CorrelatedMotion,
    contradicts_delays,
    correlated_motion,
)
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.apps.readings import UserSource, network_of, source_of
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import LabelsError, NetworkError, SettingsError
from mag_tracking.event_records import PassEvent, TrafficSummary, VehiclePassage
from mag_tracking.inference import identification
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import MU0
from mag_tracking.pipeline import Pipeline, RecordReceiver, Settings, Step, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.records import FieldFrame, Readings, Track
from mag_tracking.results.columns import EVENTS, row_of, traffic_tables
from mag_tracking.results.dataframes import rows_dataframe
from mag_tracking.results.traffic_tables import FleetPass, passage_row
from mag_tracking.run import DisplayedResult, RunReport, progress_bar, run
from mag_tracking.stages.events.stage import Events
from mag_tracking.units import NS

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

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
    def delays(self) -> dict[str, float | bool]:
        """Columns of the speed from the delays in the table `passages`."""
        return {'delay_speed': self.delay.speed, 'sd_delay_speed': self.delay.speed_std,
                'speeds_contradict': self.speeds_contradict}

    @property
    def speeds_contradict(self) -> bool:
        """Whether the speed or direction of the track contradicts the delays."""
        p = self.passage
        return contradicts_delays((p.speed, p.speed_std), (_heading(p), p.heading_std), self.delay)


def _heading(passage: VehiclePassage) -> float:
    """Heading of a passage, anticlockwise from x [rad]."""
    return float(np.arctan2(passage.velocity[1], passage.velocity[0]))


@dataclass(frozen=True)
class TrafficResult(DisplayedResult):
    """Counted vehicles and traffic summaries of a recording."""

    class_names: tuple[str, ...]
    """Classes, in the order of `VehiclePassage.class_probabilities`."""
    vehicles: tuple[CountedVehicle, ...]
    """Counted vehicles in chronological order."""
    summaries: tuple[TrafficSummary, ...]
    """One summary per line and interval."""
    report: RunReport
    """Losses, rejections and missing topics, with their causes; `report.counts['traffic']` counts
    passages, tracks that crossed no line, and other events."""

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the counted vehicles to a table, which requires pandas.

        Returns
        -------
        pandas.DataFrame
            Columns of the table `passages`, indexed by time (UTC).
        """
        columns = [c for c in traffic_tables(self.class_names, False)['passages']
                   if c.name != 'recording']
        return rows_dataframe(columns, [passage_row('', v.passage, self.class_names, v.delays, {})
                                        for v in self.vehicles], 'stamp_ns')

    def figure(self) -> 'Figure':
        """Draw the speed of each vehicle over time, by class.

        Returns
        -------
        matplotlib.figure.Figure
        """
        # Imported here because it loads matplotlib.
        from mag_tracking.report.figures import time_figure

        passages = [v.passage for v in self.vehicles]
        return time_figure(np.array([p.stamp_ns for p in passages], dtype=np.int64),
                           np.array([p.speed for p in passages]),
                           np.array([p.speed_std for p in passages]),
                           [p.vehicle_class for p in passages], 'speed [m/s]')

    def __repr__(self) -> str:
        lines = dict(Counter(v.passage.line for v in self.vehicles))
        return (f'TrafficResult({quantity(len(self.vehicles), "vehicle")}, '
                f'{lines or "no line was crossed"})')


def traffic(source: UserSource, network: SensorNetwork | str | PathLike[str],
            settings: Mapping[str, Any] | None = None,
            time_unit: str | None = None) -> TrafficResult:
    """Count the vehicles that cross the counting lines of a network.

    Parameters
    ----------
    source : path, Readings, RecordedReadings, DataFrame or mapping
        As for `track`.
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        Settings that differ from the defaults for a vehicle; `traffic.lines` is the table of the
        counting lines.
    time_unit : 's', 'ms', 'us' or 'ns', optional
        As for `track`.

    Returns
    -------
    TrafficResult

    Raises
    ------
    ReadingsError
        If a table or arrays are incomplete, not in order, or of a wrong type.
    RecordingError, NetworkError
        As for `track`.
    SettingsError
        If a setting is invalid, or the target is not a vehicle.
    """
    network = network_of(network)
    opened = source_of(source, network, time_unit)
    pipeline = Pipeline(network, settings_for('vehicle', settings))
    sink = TrafficSink(pipeline)
    with progress_bar(opened, leave=False) as bar:
        return sink.result(run(opened, pipeline, [sink], bar.update))


def check_vehicles(settings: Settings) -> None:
    """Raise SettingsError if the target is not a vehicle."""
    if settings.track.target != 'vehicle':
        raise SettingsError('only vehicles are counted and fitted; set the target to vehicle '
                            f'instead of {settings.track.target}')


class TrafficSink(RecordReceiver):
    """Collects passages and summaries, and the frames of tracks for the delays; raises
    SettingsError if the target is not a vehicle."""

    def __init__(self, pipeline: Pipeline) -> None:
        check_vehicles(pipeline.settings)
        self._network = pipeline.network
        self._class_names = tuple(c.name for c in pipeline.settings.traffic.classes)
        self._frame: FieldFrame | None = None
        self._tracks_before_jump: set[int] = set()
        self._frames: dict[int, list[FieldFrame]] = {}
        self._vehicles: list[CountedVehicle] = []
        self._summaries: list[TrafficSummary] = []
        self.add_traffic = self._summaries.append

    def add_frame(self, frame: FieldFrame) -> None:
        """Store the frame of the following poses."""
        self._drop_old(frame.stamp_ns)
        self._frame = frame

    def add_track(self, track: Track) -> None:
        """Store the latest frame for a track."""
        if not track.ended:
            assert self._frame is not None, 'a pose without a frame'
            self._frames.setdefault(track.id, []).append(self._frame)

    def add_passage(self, passage: VehiclePassage) -> None:
        """Add a passage with the velocity from the delays."""
        self._vehicles.append(CountedVehicle(passage, self._delay_motion(passage.track_id)))

    def result(self, report: RunReport) -> TrafficResult:
        """Return the counted vehicles after a run."""
        return TrafficResult(self._class_names, tuple(self._vehicles), tuple(self._summaries),
                             report)

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


def earth_field_strength(network: SensorNetwork) -> FloatArray:
    """Field strength (3,) of the Earth [A/m], world frame; raises NetworkError if unknown."""
    if network.earth_field is None or not network.earth_field.any():
        raise NetworkError('hard and soft iron cannot be separated without the field of the Earth: '
                           'add earth_field to the network file')
    return network.earth_field / MU0


def pass_of(recording: str, passages: Sequence[VehiclePassage]) -> FleetPass:
    """Convert the only passage in a recording to a pass for the enrolment of a vehicle; raises
    LabelsError if there is not exactly one passage, or it is ambiguous."""
    if len(passages) != 1:
        raise LabelsError(f'{recording}: expected exactly one vehicle to enrol, but '
                          f'{len(passages)} crossed a line')
    (p,) = passages
    if p.ambiguous:
        raise LabelsError(f'{recording}: the passage is ambiguous ({", ".join(p.doubts)}); record '
                          'another passage')
    return FleetPass(p.moment, p.moment_covariance, _heading(p), f'{recording} {p.number}')


class Fleet:
    """Enrolled vehicles of one site, from the passes of each; raises LabelsError if a vehicle
    cannot be enrolled, NetworkError if the Earth's field is unknown."""

    def __init__(self, passes: dict[str, list[FleetPass]], network: SensorNetwork) -> None:
        self._field_strength = earth_field_strength(network)
        self.vehicles: list[identification.EnrolledVehicle] = []
        for name, vehicle_passes in passes.items():
            try:
                self.vehicles.append(identification.enrol(
                    name, np.array([p.moment for p in vehicle_passes]).reshape(-1, 3),
                    np.array([p.covariance for p in vehicle_passes]).reshape(-1, 3, 3),
                    np.array([p.heading for p in vehicle_passes]), self._field_strength))
            except ValueError as error:
                raise LabelsError(str(error)) from error

    def identify(self, passage: VehiclePassage) -> identification.Identification:
        """Identify the vehicle of a passage."""
        return identification.identify(self.vehicles, passage.moment, passage.moment_covariance,
                        _heading(passage), passage.heading_std, self._field_strength)


@dataclass(frozen=True, eq=False)
class EventsResult(DisplayedResult):
    """Pass events in a recording."""

    events: tuple[PassEvent, ...]
    """Events in the order in which they ended."""
    report: RunReport
    """Losses, rejections and missing topics, with their causes."""

    def counts(self) -> dict[str, int]:
        """Count the events of each sensor.

        Returns
        -------
        dict of str to int
            {sensor: number of events}.
        """
        return dict(Counter(event.sensor for event in self.events))

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the events to a table, which requires pandas.

        Returns
        -------
        pandas.DataFrame
            Columns of `events.csv`, indexed by the time of the closest point (UTC).
        """
        return rows_dataframe(EVENTS, [row_of(EVENTS, event) for event in self.events],
                              'closest_ns')

    def figure(self) -> 'Figure':
        """Draw the largest field of each event over time.

        Returns
        -------
        matplotlib.figure.Figure
        """
        # Imported here because it loads matplotlib.
        from mag_tracking.report.figures import time_figure

        return time_figure(np.array([e.closest_ns for e in self.events], dtype=np.int64),
                           np.array([1e9 * np.sqrt(np.nansum(e.peak**2)) for e in self.events]),
                           None, [e.sensor for e in self.events], 'largest field [nT]')

    def __repr__(self) -> str:
        counts = ', '.join(f'{n} of {name}' for name, n in self.counts().items())
        return f'EventsResult({quantity(len(self.events), "event")}: {counts or "none"})'


def events(source: UserSource, network: SensorNetwork | str | PathLike[str],
           settings: Mapping[str, Any] | None = None,
           time_unit: str | None = None) -> EventsResult:
    """Describe the passes that each sensor of a network detects.

    Parameters
    ----------
    source : path, Readings, RecordedReadings, DataFrame or mapping
        As for `track`.
    network : SensorNetwork or path of a network file
    settings : {name: value}, optional
        Settings that differ from the defaults for a vehicle.
    time_unit : 's', 'ms', 'us' or 'ns', optional
        As for `track`.

    Returns
    -------
    EventsResult

    Raises
    ------
    ReadingsError
        If a table or arrays are incomplete, not in order, or of a wrong type.
    RecordingError, NetworkError
        As for `track`.
    SettingsError
        If a setting is invalid.
    """
    network = network_of(network)
    opened = source_of(source, network, time_unit)
    pipeline = Pipeline(network, settings_for('vehicle', settings), 'calibrate')
    sink = EventSink(pipeline)
    with progress_bar(opened, leave=False) as bar:
        return sink.result(run(opened, pipeline, [sink], bar.update))


class EventSink(RecordReceiver):
    """Collects the events in calibrated readings."""

    def __init__(self, pipeline: Pipeline) -> None:
        settings = pipeline.settings
        self._calibrate = pipeline.calibrate
        self._stage = Events(pipeline.network, settings.align, settings.detect, settings.track)
        self._events: list[PassEvent] = []

    def add(self, step: Step) -> None:
        """Find the events in the calibrated readings of a step."""
        self.receive(step.records)
        if step.is_last:
            self._events += self._stage.flush()

    def add_calibrated(self, readings: Readings) -> None:
        """Find the events in calibrated readings."""
        self._stage.set_relearnt(self._calibrate.backgrounds())
        self._events += self._stage.feed(readings)

    def result(self, report: RunReport) -> EventsResult:
        """Return the events after a run."""
        events = []
        for event in self._events:
            # `closest_std` includes the error of the timestamps.
            fault = self._calibrate.timestamps.worst_fault(event.sensor)
            events.append(event if fault is None else replace(
                event, closest_std=float(np.hypot(event.closest_std, fault.error_s))))
        return EventsResult(tuple(events), report)
