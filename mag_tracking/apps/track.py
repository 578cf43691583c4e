"""Targets tracked in a recording or in arrays of readings; results as arrays."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

from mag_tracking.apps.no_detection import no_detection_reason
from mag_tracking.apps.prescan import prescan, prescan_of
from mag_tracking.apps.readings import (
    RecordedReadings,
    check_order,
    checked_readings,
    network_of,
    recorded,
)
from mag_tracking.apps.replay import RunCollector, errors_against_truth
from mag_tracking.arrays import StructArray
from mag_tracking.errors import UnknownTrackError
from mag_tracking.event_records import Disturbance
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, Settings, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Detection, FieldFrame, Readings, SmoothedPose, Track
from mag_tracking.report.dataframes import (
    detections_dataframe,
    poses_dataframe,
    smoothed_dataframe,
)
from mag_tracking.report.metrics import Truth, interpolate_truth
from mag_tracking.report.result_arrays import detection_array, pose_array, smoothed_array
from mag_tracking.report.track_log import TrackLog

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


_BATCH = 4096
"""Readings of arrays that are tracked at once: the outputs of all would not fit into memory."""


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """Tracks, poses and detections. Arrays are structured, in SI units and in order of time; they
    are empty if there was no target.
    """

    network: SensorNetwork
    settings: Settings
    poses: StructArray
    """(n,) the published pose of every frame and track: the fields of `Track`."""
    smoothed: StructArray
    """(k,) the same by what came before and after: the fields of `SmoothedPose`. Where `complete`
    is false, by what came within `track.smoothing_lag_s`."""
    detections: StructArray
    """(m,) onsets and releases: the fields of `Detection`."""
    tracks: dict[int, TrackLog]
    """{track id: its history with hypotheses, measured and predicted fields}."""
    truth: dict[str, Truth]
    """{target: (stamps (n,) [ns], positions (n, 3) [m], quaternions (n, 4) xyzw)}; empty without
    ground truth."""
    rejections: dict[str, int]
    """{cause: number} of readings that were not used."""
    counts: dict[str, dict[str, int]]
    """{stage: {event: number}}."""
    lost: dict[str, int]
    """{damage: number} of what could not be read from the recording."""
    missing_topics: tuple[str, ...]
    """Topics of the network that are not in the recording."""
    no_detection_reason: str | None
    """One sentence where nothing was detected; else None."""
    sensors_without_background: tuple[str, ...]
    """Sensors that were not used because their background was never learnt: the readings need a
    quiet stretch, or the network file a `background` and a `noise_std`."""
    disturbances: tuple[Disturbance, ...]
    """Fields that something else than a target explains better."""

    def __repr__(self) -> str:
        unused = {**self.rejections, **self.lost}
        notes = [*(f'not used: {n} {cause}' for cause, n in unused.items()),
                 *(f'nothing on {topic}' for topic in self.missing_topics),
                 *([f'{len(self.disturbances)} disturbances'] if self.disturbances else []),
                 *(f'no background of {name}' for name in self.sensors_without_background)]
        if self.no_detection_reason:
            notes.append(f'nothing was detected: {self.no_detection_reason}')
        return (f'TrackingResult({len(self.tracks)} tracks, {len(self.poses)} poses, '
                f'{len(self.smoothed)} smoothed poses, {len(self.detections)} detections'
                + (f'; {"; ".join(notes)}' if notes else '') + ')')

    def poses_dataframe(self) -> 'pd.DataFrame':
        """`poses` with the columns of `poses.csv`; raises MissingDependencyError."""
        return poses_dataframe(self.poses)

    def smoothed_dataframe(self) -> 'pd.DataFrame':
        """`smoothed` with the columns of `poses_smoothed.csv` and `complete`; raises
        MissingDependencyError.
        """
        return smoothed_dataframe(self.smoothed)

    def detections_dataframe(self) -> 'pd.DataFrame':
        """`detections` with the columns of `detections.csv`; raises MissingDependencyError."""
        return detections_dataframe(self.detections)

    def errors(self, track_id: int | None = None) -> dict[str, Any] | None:
        """Errors of a track against the ground truth that fits best.

        Parameters
        ----------
        track_id : int, optional
            The first track if left out.

        Returns
        -------
        dict or None
            The entry `truth` of a track in `summary.json`; None without ground truth.

        Raises
        ------
        UnknownTrackError
        """
        return errors_against_truth(self._log(track_id), self, self.truth)

    def map_figure(self, track_id: int | None = None) -> 'Figure':
        """Trajectories of the hypotheses with 90 % ellipses, smoothed track, sensors, truth.

        Parameters
        ----------
        track_id : int, optional
            The first track if left out.

        Returns
        -------
        matplotlib Figure

        Raises
        ------
        UnknownTrackError
        """
        # Tracking alone should not wait for matplotlib; so in the other figures.
        from mag_tracking.report.figures import map_figure

        log, errors = self._log(track_id), self.errors(track_id)
        truth = None if errors is None else interpolate_truth(self.truth[errors['name']],
                                                              log.stamp_ns)
        mine = self.smoothed[(self.smoothed['track_id'] == log.id) & self.smoothed['complete']]
        return map_figure(log, self.network, truth, mine['position'] if len(mine) else None)

    def weights_figure(self, track_id: int | None = None) -> 'Figure':
        """Weight of each arrival direction over time; parameters as for `map_figure`."""
        from mag_tracking.report.figures import weights_figure

        return weights_figure(self._log(track_id))

    def field_figure(self, track_id: int | None = None) -> 'Figure':
        """Measured and predicted field of each sensor; parameters as for `map_figure`."""
        from mag_tracking.report.figures import field_figure

        return field_figure(self._log(track_id), self.network)

    def _log(self, track_id: int | None) -> TrackLog:
        """The history of a track, of the first one for None."""
        if track_id is None and self.tracks:
            return next(iter(self.tracks.values()))
        if track_id is None or track_id not in self.tracks:
            known = ', '.join(map(str, self.tracks)) or 'none'
            raise UnknownTrackError(f'track {track_id or ""}: the result has {known}')
        return self.tracks[track_id]


def track(source: Readings | RecordedReadings | str | PathLike[str],
          network: SensorNetwork | str | PathLike[str], target: str = 'vehicle',
          settings: Mapping[str, Any] | None = None) -> TrackingResult:
    """Track the targets in readings or in a recording.

    The stages are those of `mag-tracking replay` and of the ROS nodes; nothing is written.

    Parameters
    ----------
    source : Readings, RecordedReadings, or path of a recording
        A path is read piece by piece: a long recording need not fit into memory.
    network : SensorNetwork or path of a network file
    target : 'vehicle' or 'magnet'
    settings : {name: value}, optional
        What differs from the defaults of the target, such as {'track.iterations': 5};
        config/default.yaml lists all names.

    Returns
    -------
    TrackingResult

    Raises
    ------
    ReadingsError
        If the arrays have a wrong shape or type, or are not in order of time.
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is not valid.
    SettingsError
        If a setting has an unknown name, a wrong type, or a value out of range.
    """
    network = network_of(network)
    pipeline = Pipeline(network, settings_for(target, settings))
    results = _Results()
    collector = RunCollector(results)
    if isinstance(source, Readings):
        check_order(source)
        source = RecordedReadings(source, {}, {}, {}, ())
    if isinstance(source, RecordedReadings):
        source = replace(source, readings=checked_readings(source.readings, network))
        prescan(_parts(source.readings), network,
                   pipeline.settings.calibrate).apply(pipeline.calibrate)
        for readings in _parts(source.readings):
            collector.take(pipeline.feed(readings))
        info = source
    else:
        recording = Recording(source)
        reader = SampleReader(recording, network)
        prescan_of(recording, network, pipeline.settings.calibrate).apply(pipeline.calibrate)
        for readings in reader.readings():
            collector.take(pipeline.feed(readings))
        info = recorded(recording, reader, Readings.joined([]))
    collector.take(pipeline.flush())
    return _result(pipeline, results, collector.logs, info)


def _parts(readings: Readings) -> Iterator[Readings]:
    """The readings in batches of at most `_BATCH`."""
    return (readings.part(slice(i, i + _BATCH)) for i in range(0, len(readings), _BATCH))


class _Results:
    """Keeps detections and poses in lists."""

    def __init__(self) -> None:
        self.poses: list[Track] = []
        self.smoothed: list[SmoothedPose] = []
        self.detections: list[Detection] = []
        self.disturbances: dict[int, Disturbance] = {}

    def add_detection(self, detection: Detection) -> None:
        """Take an onset or a release."""
        self.detections.append(detection)

    def add_disturbance(self, disturbance: Disturbance) -> None:
        """Take a disturbance; its last record takes the place of those before."""
        self.disturbances[disturbance.id] = disturbance

    def add_frame(self, frame: FieldFrame) -> None:
        """Frames with a target are in the history of its track."""

    def add_smoothed(self, pose: SmoothedPose) -> None:
        """Take a smoothed pose."""
        self.smoothed.append(pose)

    def add_track(self, track: Track) -> None:
        """Take a pose; its hypotheses are in the history of the track, and together are large."""
        self.poses.append(replace(track, hypotheses=()))


def _result(pipeline: Pipeline, results: _Results, tracks: dict[int, TrackLog],
            recording: RecordedReadings) -> TrackingResult:
    """The results as arrays; the readings of `recording` are not used."""
    rejections = dict(Counter(recording.rejected) + Counter(pipeline.rejections()))
    why = no_detection_reason(pipeline.network, pipeline.settings, pipeline.calibrate,
                           pipeline.detect, recording.missing_topics, rejections)
    return TrackingResult(
        pipeline.network, pipeline.settings, pose_array(results.poses),
        smoothed_array(results.smoothed), detection_array(results.detections), tracks,
        recording.truth, rejections, pipeline.counts(), recording.lost,
        recording.missing_topics, why, tuple(pipeline.calibrate.unready()),
        tuple(results.disturbances.values()))
