"""Tracking of the targets in a recording or in arrays of readings, with results as arrays."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

from mag_tracking.analysis.track_errors import Truth, interpolate_truth
from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.apps.readings import UserSource, network_of, source_of
from mag_tracking.apps.replay import TrackHistory, errors_against_truth
from mag_tracking.arrays import FloatArray, StructArray
from mag_tracking.errors import UnknownTrackError
from mag_tracking.event_records import Disturbance
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, Settings, settings_for
from mag_tracking.quantities import quantity
from mag_tracking.records import Detection, SmoothedPose, Track
from mag_tracking.results import dataframes
from mag_tracking.results.columns import COMPLETE, DETECTIONS, POSES, SMOOTHED
from mag_tracking.run import DisplayedResult, RunReport, progress_bar, run

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class TrackingResult(DisplayedResult):
    """Tracks, poses and detections of a recording or of readings.

    Arrays are structured, in SI units and in chronological order; they are empty without targets.
    Tables raise MissingDependencyError if pandas is not installed. Figures and errors are those of
    one track, by default the first one, and raise UnknownTrackError if there is no such track.
    """

    network: SensorNetwork
    """Sensor network."""
    settings: Settings
    """Settings of all stages."""
    poses: StructArray
    """(n,) published poses, one per frame and track, with the fields of `Track`."""
    smoothed: StructArray
    """(k,) smoothed poses with the fields of `SmoothedPose`. If `complete` is false, the pose is
    smoothed with the fixed lag `track.smoothing_lag_s`, otherwise over the whole track."""
    detections: StructArray
    """(m,) onsets and releases with the fields of `Detection`."""
    tracks: dict[int, TrackLog]
    """{track id: history with hypotheses, measured and predicted fields}."""
    truth: dict[str, Truth]
    """{target: (timestamps (n,) ns, positions (n, 3) m, quaternions (n, 4) xyzw)}; empty without
    ground truth."""
    report: RunReport
    """Losses, rejections and missing topics, with their causes."""
    disturbances: tuple[Disturbance, ...]
    """Field changes that are explained better by a disturbance than by a target."""

    def __repr__(self) -> str:
        notes = self.report.warnings()
        if self.disturbances:
            notes.append(quantity(len(self.disturbances), 'disturbance'))
        numbers = (quantity(len(self.tracks), 'track'), quantity(len(self.poses), 'pose'),
                   quantity(len(self.smoothed), 'smoothed pose'),
                   quantity(int(self.detections['onset'].sum()), 'detection'))
        return (f'TrackingResult({", ".join(numbers)}'
                + (f'; {"; ".join(notes)}' if notes else '') + ')')

    def to_dataframe(self) -> 'pd.DataFrame':
        """Convert the published poses to a table.

        Returns
        -------
        pandas.DataFrame
            Columns of `poses.csv`, indexed by time (UTC).
        """
        return dataframes.with_time_index(self.poses_dataframe(), 'stamp_ns')

    def figure(self) -> 'Figure':
        """Draw the pass of the first vehicle, or the map of the first magnet.

        Returns
        -------
        matplotlib.figure.Figure
        """
        is_vehicle = self.settings.track.target == 'vehicle'
        return self.pass_figure() if is_vehicle else self.map_figure()

    def poses_dataframe(self) -> 'pd.DataFrame':
        """Convert `poses` to a table.

        Returns
        -------
        pandas.DataFrame
            Columns of `poses.csv`.
        """
        return dataframes.array_dataframe(POSES, self.poses)

    def smoothed_dataframe(self) -> 'pd.DataFrame':
        """Convert `smoothed` to a table.

        Returns
        -------
        pandas.DataFrame
            Table with the columns of `poses_smoothed.csv`, and `complete`.
        """
        return dataframes.array_dataframe((*SMOOTHED, *COMPLETE), self.smoothed)

    def detections_dataframe(self) -> 'pd.DataFrame':
        """Convert `detections` to a table.

        Returns
        -------
        pandas.DataFrame
            Table with the columns of `detections.csv`.
        """
        return dataframes.array_dataframe(DETECTIONS, self.detections)

    def errors(self, track_id: int | None = None) -> dict[str, Any] | None:
        """Compute the errors of a track relative to the best-matching target of the ground truth.

        Parameters
        ----------
        track_id : int, optional

        Returns
        -------
        dict or None
            Entry `truth` of a track in `summary.json`; None if no ground truth covers the track.
        """
        return errors_against_truth(self._track_log(track_id), self.network, self.settings,
                                    self.truth)

    def map_figure(self, track_id: int | None = None) -> 'Figure':
        """Draw a map: hypotheses with 90% ellipses, smoothed track, sensors and ground truth.

        Parameters
        ----------
        track_id : int, optional

        Returns
        -------
        matplotlib.figure.Figure
        """
        # Imported here, as in the other figures, because it loads matplotlib.
        from mag_tracking.report.figures import map_figure

        log, errors = self._track_log(track_id), self.errors(track_id)
        truth = None if errors is None else interpolate_truth(
            self.truth[errors['name']], log.stamp_ns)
        return map_figure(log, self.network, truth, self._smoothed_path(log.id))

    def pass_figure(self, track_id: int | None = None, max_std: float = float('inf')) -> 'Figure':
        """Draw the pass of a vehicle: road, sensors, vehicle to scale, published and smoothed path.

        Parameters
        ----------
        track_id : int, optional
        max_std : float, m, optional
            Poses with a larger standard deviation of the horizontal position are omitted.

        Returns
        -------
        matplotlib.figure.Figure
        """
        from mag_tracking.report.figures import pass_figure

        log = self._track_log(track_id)
        return pass_figure(log, self.network, self._smoothed_path(log.id), max_std)

    def _smoothed_path(self, track_id: int) -> FloatArray | None:
        """Smoothed positions (n, 3) [m] of a track; None if the track is not smoothed."""
        smoothed = self.smoothed[(self.smoothed['track_id'] == track_id)
                                 & self.smoothed['complete']]
        return smoothed['position'] if len(smoothed) else None

    def weights_figure(self, track_id: int | None = None) -> 'Figure':
        """Draw the weight of each arrival direction over time.

        Parameters
        ----------
        track_id : int, optional

        Returns
        -------
        matplotlib.figure.Figure
        """
        from mag_tracking.report.figures import weights_figure

        return weights_figure(self._track_log(track_id))

    def field_figure(self, track_id: int | None = None) -> 'Figure':
        """Draw the measured and predicted field of each sensor.

        Parameters
        ----------
        track_id : int, optional

        Returns
        -------
        matplotlib.figure.Figure
        """
        from mag_tracking.report.figures import field_figure

        return field_figure(self._track_log(track_id), self.network)

    def _track_log(self, track_id: int | None) -> TrackLog:
        """Return the history of a track; None selects the first track."""
        if not self.tracks:
            raise UnknownTrackError('the result contains no tracks')
        if track_id is None:
            return next(iter(self.tracks.values()))
        if track_id not in self.tracks:
            raise UnknownTrackError(f'track {track_id!r} is not in the result; tracks in the '
                                    f'result: {", ".join(map(str, self.tracks))}')
        return self.tracks[track_id]


def track(source: UserSource,
          network: SensorNetwork | str | PathLike[str], target: str = 'vehicle',
          settings: Mapping[str, Any] | None = None,
          time_unit: str | None = None) -> TrackingResult:
    """Track the targets in readings or in a recording.

    The stages are the same as in `mag-tracking replay` and the ROS nodes. No files are written.

    Parameters
    ----------
    source : path, Readings, RecordedReadings, DataFrame or mapping
        A recording is read in batches and need not fit into memory. A DataFrame, in tesla, has one
        row per reading (columns `sensor`, x, y, z) or per time (columns such as `mag_1_x`), and the
        times in a column `time` or `stamp_ns` or in the index. A mapping is {sensor: (times (n,),
        fields (n, 3), T)}.
    network : SensorNetwork or path of a network file
    target : 'vehicle', 'magnet' (in a hand) or 'bench' (a magnet on a bench)
    settings : {name: value}, optional
        Settings that differ from the defaults of the target, such as {'track.iterations': 5};
        config/default.yaml lists those of users, the reference all.
    time_unit : 's', 'ms', 'us' or 'ns', optional
        Unit of the times of a DataFrame or mapping; required for floats. The default for integers
        is 'ns'.

    Returns
    -------
    TrackingResult

    Raises
    ------
    ReadingsError
        If the arrays have a wrong shape or type, or are not in chronological order.
    RecordingError
        If the recording cannot be read, or has none of the network's topics.
    NetworkError
        If the network file is invalid.
    SettingsError
        If a setting has an unknown name, a wrong type, or a value out of range.
    """
    network = network_of(network)
    pipeline, found = Pipeline(network, settings_for(target, settings)), _Poses()
    opened = source_of(source, network, time_unit)
    with progress_bar(opened, leave=False) as bar:
        report = run(opened, pipeline, [found], bar.update)
    return TrackingResult(
        network, pipeline.settings, dataframes.pose_array(found.poses),
        dataframes.smoothed_array(found.smoothed_poses),
        dataframes.detection_array(found.detections), found.logs, opened.truth(), report,
        tuple(found.disturbances.values()))


class _Poses(TrackHistory):
    def __init__(self) -> None:
        super().__init__()
        self.poses: list[Track] = []
        self.smoothed_poses: list[SmoothedPose] = []
        self.detections: list[Detection] = []
        self.add_detection = self.detections.append

    def add_smoothed(self, pose: SmoothedPose) -> None:
        super().add_smoothed(pose)
        self.smoothed_poses.append(pose)

    def add_track(self, track: Track) -> None:
        """Add a pose; omit its hypotheses, which are stored in the history of the track."""
        super().add_track(track)
        self.poses.append(replace(track, hypotheses=()))
