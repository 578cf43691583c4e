"""Offline replay of a recording through all stages, with tables, a summary and figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.analysis import track_errors
from mag_tracking.analysis.correlated_motion import contradicts_delays, correlated_motion
from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.track_log import SmoothedLog, TrackLog
from mag_tracking.arrays import IntArray
from mag_tracking.errors import OutputError
from mag_tracking.event_records import Disturbance
from mag_tracking.geometry import heading_of, speed_of
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, RecordReceiver, Settings
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.truth import read_truth_table
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.results.result_folder import ResultFolder, figure_name
from mag_tracking.results.track_files import write_tum
from mag_tracking.run import (
    Failure,
    RecordingSource,
    RunReport,
    Sink,
    Source,
    output_error,
    run,
)
from mag_tracking.stages.align.stage import frame_period_warning
from mag_tracking.stages.track.plausibility import lane_note
from mag_tracking.stages.track.settings import acceleration_density

SUSPECT_MOUNTING_RATIO = 2.0
"""Mounting error above which a sensor is reported, in prior standard deviations."""
MAX_FIGURES = 6


@dataclass
class Run:
    """Results of a replay."""

    summary: dict[str, Any]
    """Content of `summary.json`."""
    report: RunReport
    logs: dict[int, TrackLog] = field(default_factory=dict)
    smoothed: dict[int, SmoothedLog] = field(default_factory=dict)
    truth: dict[str, track_errors.Truth] = field(default_factory=dict)
    """{target: (timestamps (n,) ns, positions (n, 3) m, quaternions (n, 4) xyzw)}."""


def replay(recording: Recording, network: SensorNetwork, settings: Settings,
           out: str | PathLike[str], progress: Callable[[int], object] | None = None,
           stopped: Callable[[], bool] | None = None,
           report: Callable[[str], object] | None = None, truth: str | None = None,
           more_sinks: Callable[[Pipeline], Sequence[Sink]] = lambda pipeline: ()) -> Run:
    """Track the targets in a recording and write the results to the folder `out`.

    `progress`, `stopped`: see `run`; the summary of a stopped run is marked as interrupted.
    `report` is called if results of an earlier run are replaced. `truth` is a CSV file, or a topic
    of poses or odometry, by default all below /ground_truth. `more_sinks` are created from the
    pipeline.

    Raises RecordingError if the recording has none of the network's topics or the ground truth
    cannot be read, OutputError if `out` is the folder of the recording.
    """
    if recording.lies_in(out):
        raise OutputError(f'{out} is the folder of the recording; choose another output folder')
    table = None
    # Topic names contain no dot: a name with a dot is a file, even if it does not exist.
    if truth is not None and ('.' in truth or Path(truth).is_file()):
        table, truth = read_truth_table(truth, settings.track.magnet.axis), None
    source = RecordingSource(recording, network, truth)
    pipeline, history = Pipeline(network, settings), TrackHistory()
    results, summary = ResultFolder(out, network), None
    if results.replaces_earlier and report is not None:
        report(f'replacing the results of an earlier run in {out}')
    try:
        with results:
            run_report = run(source, pipeline, [results, history, *more_sinks(pipeline)],
                             progress, stopped)
            true_poses = source.truth() if table is None else table
            summary = summarise(source, pipeline, history, true_poses, run_report)
            results.write_summary(summary)
    except OSError as error:
        # The files are written and closed even on a full disk; other sinks have their results.
        if summary is None:
            raise
        run_report = replace(run_report, failures=(
            *run_report.failures, Failure(results, output_error(error, results))))
    return Run(summary, run_report, history.logs, history.smoothed, true_poses)


class TrackHistory(RecordReceiver):
    """Stores the history of each track and smoothed track, and the latest record of each
    disturbance, by their numbers."""

    def __init__(self) -> None:
        # The first frame, which precedes every track, sets this attribute.
        self._frame: FieldFrame
        self.logs: dict[int, TrackLog] = {}
        self.smoothed: dict[int, SmoothedLog] = {}
        self.disturbances: dict[int, Disturbance] = {}

    def add_frame(self, frame: FieldFrame) -> None:
        """Store the frame of the following poses."""
        self._frame = frame

    def add_disturbance(self, disturbance: Disturbance) -> None:
        """Store a disturbance."""
        self.disturbances[disturbance.id] = disturbance

    def add_smoothed(self, pose: SmoothedPose) -> None:
        """Add a pose to the history of a smoothed track."""
        if pose.complete:
            self.smoothed.setdefault(pose.id, SmoothedLog(pose.id)).add(pose)

    def add_track(self, track: Track) -> None:
        """Add a pose to the history of its track."""
        self.logs.setdefault(track.id, TrackLog(track.id)).add(track, self._frame)


def summarise(source: Source, pipeline: Pipeline, history: TrackHistory,
              truth: Mapping[str, track_errors.Truth], report: RunReport) -> dict[str, Any]:
    """Content of `summary.json` after a run; `truth` is {target: (stamps, positions, ...)}."""
    sensors: dict[str, dict[str, Any]] = {}
    for name, background in pipeline.calibrate.backgrounds().items():
        counts = pipeline.calibrate.counts_of(name)
        sensors[name] = {'accepted': counts['accepted'], 'rejected': counts['rejected'],
                         'ready': background.ready, 'stuck': background.stuck,
                         'times_relearnt': background.n_relearnt,
                         'doubtful_ns': [list(segment) for segment in background.doubtful_times],
                         'quiet_stretch_s': report.prescan.segment_of(name)}
        covariance = background.covariance
        if background.ready and covariance is not None and counts['accepted']:
            std = np.sqrt(np.diagonal(covariance))
            sensors[name]['noise_std'] = [None if np.isnan(v) else float(v) for v in std]
            sensors[name]['background'] = [
                None if np.isnan(v) else float(v) for v in pipeline.calibrate.background(name)]
    tracks = [_track_entry(log, history.smoothed.get(log.id), pipeline, truth)
              for log in history.logs.values()]
    return {'recording': source.name, 'target': pipeline.settings.track.target,
            'counts': report.counts, 'rejected': report.rejected, 'lost': report.lost,
            'no_detection_reason': report.no_detection_reason,
            'diagnoses': [
                {'cause': d.finding.cause.value, 'serious': d.serious, 'text': str(d)}
                for d in report.diagnoses],
            'close_network': len(pipeline.network) > 1 and pipeline.network.is_compact,
            'frames_too_long': frame_period_warning(pipeline.settings.align, pipeline.network),
            'lanes': lane_note(pipeline.settings.track.vehicle, pipeline.network),
            'clocks_apart': pipeline.track.clock_warning,
            'missing_topics': list(report.missing_topics), 'sensors': sensors, 'tracks': tracks,
            'disturbances': [asdict(d) for d in history.disturbances.values()],
            'unflagged_poses': track_errors.unflagged_poses(history.logs.values(), truth.values())
            if truth and pipeline.settings.track.target == 'vehicle' else None,
            'interrupted': report.interrupted,
            'not_written': [str(failure.error) for failure in report.failures]}


def _track_entry(log: TrackLog, smoothed: SmoothedLog | None, pipeline: Pipeline,
                 truth: Mapping[str, track_errors.Truth]) -> dict[str, Any]:
    entry: dict[str, Any] = log.summary()
    network, settings = pipeline.network, pipeline.settings
    entry['nis_by_sensor'] = log.nis_of(network.names)
    max_angle = SUSPECT_MOUNTING_RATIO * settings.track.mounting_std_deg
    entry['mounting'] = {
        name: {'angles_deg': angles.tolist(), 'std_deg': std.tolist(),
               'suspicious': bool(np.abs(angles).max() > max_angle)}
        for name, (angles, std) in log.mounting_of(network.names).items()}
    if settings.track.target == 'vehicle':
        entry['delay'] = _delay_entry(log, network)
    if errors := errors_against_truth(log, network, settings, truth):
        entry['truth'] = errors
        entry['truth']['error_over_bound'] = _bound_ratio(log, pipeline, truth[errors['name']])
    if smoothed is not None:
        entry['smoothed'] = smoothed.summary()
        if errors := errors_against_truth(smoothed, network, settings, truth):
            entry['smoothed']['truth'] = errors
    return entry


def _delay_entry(log: TrackLog, network: SensorNetwork) -> dict[str, Any]:
    """Create the entry `delay` of a track: speed and heading, or a reason for their absence."""
    motion = correlated_motion(PassData.from_frames(network, log.stamp_ns, log.measured, log.noise))
    if motion.reason:
        return {'reason': motion.reason}
    k = log.most_certain()
    velocity = log.velocity[k][:2], log.covariance[k][3:5, 3:5]
    return {'speed': motion.speed, 'speed_sd': motion.speed_std,
            'heading_deg': float(np.degrees(motion.heading)),
            'heading_sd_deg': None if np.isnan(motion.heading_std)
            else float(np.degrees(motion.heading_std)),
            'contradicts': contradicts_delays(speed_of(*velocity), heading_of(*velocity), motion)}


def errors_against_truth(log: TrackLog | SmoothedLog, network: SensorNetwork, settings: Settings,
                         truth: Mapping[str, track_errors.Truth]) -> dict[str, Any] | None:
    """Entry `truth` of a track in `summary.json`: errors relative to the best-matching target; None
    if no ground truth covers the track."""
    found: list[tuple[float, dict[str, Any]]] = []
    for name, true in truth.items():
        if settings.track.target == 'magnet':
            if magnet := track_errors.magnet_errors(log, true, settings.track.magnet.axis):
                found.append((magnet['position_mean'], {'name': name, **magnet}))
        elif vehicle := track_errors.pass_errors(log, true, network.centre):
            found.append((vehicle['closest'], {'name': name, **vehicle}))
    return min(found, key=lambda errors: errors[0])[1] if found else None


def _bound_ratio(log: TrackLog, pipeline: Pipeline, truth: track_errors.Truth) -> float | None:
    """Ratio of the error of a track to its Cramér-Rao bound; None if it cannot be computed."""
    network, track = pipeline.network, pipeline.settings.track
    rows: IntArray
    if track.target == 'magnet':
        # Between two poses, the magnet may have rotated arbitrarily.
        rows, drift, n_axes = np.arange(track_errors.MAGNET_SKIP, len(log.stamp_ns)), 1.0, 3
    else:
        rows = track_errors.near_poses(log, truth, network.centre)
        drift, n_axes = track.vehicle.moment_drift, 2
    return track_errors.error_over_bound(network, log, truth, acceleration_density(track), drift,
                            track.field_error, track.background_std, rows, n_axes)


def write_trajectories(run: Run, out: Path) -> list[Path]:
    """Write each track and each smoothed track as a TUM trajectory, and return the files."""
    paths = []
    for logs, suffix in ((run.logs, ''), (run.smoothed, '_smoothed')):
        for log in logs.values():
            paths.append(out / f'track_{log.id}{suffix}.tum')
            write_tum(paths[-1], log.stamp_ns, log.position, log.orientation)
    return paths


def write_figures(run: Run, network: SensorNetwork, out: Path,
                  stopped: Callable[[], bool]) -> None:
    """Draw the figures of the first `MAX_FIGURES` tracks; `stopped` is called before each track."""
    # Imported here because it loads matplotlib.
    from mag_tracking.report.figures import field_figure, map_figure, weights_figure
    from mag_tracking.report.style import save_figure

    for log in list(run.logs.values())[:MAX_FIGURES]:
        if stopped():
            break
        entry = next(t for t in run.summary['tracks'] if t['id'] == log.id)
        truth = None
        if 'truth' in entry:
            truth = track_errors.interpolate_truth(run.truth[entry['truth']['name']], log.stamp_ns)
        smoothed = run.smoothed[log.id].position if log.id in run.smoothed else None
        for name, figure in (('map', map_figure(log, network, truth, smoothed)),
                             ('weights', weights_figure(log)),
                             ('field', field_figure(log, network))):
            save_figure(figure, out / figure_name(name, log.id))
