"""Tasks of an archive: cut a recording into segments, track each segment, join the tables.

Each task may be repeated: `cut` and `track_segment` do nothing if their folder exists.
"""

import copy
import json
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.apps import archive_segments as segments
from mag_tracking.apps.fit import PassCollector, PassTracks, fitted_vehicles, ground_prior
from mag_tracking.apps.replay import TrackHistory
from mag_tracking.files import output_errors, replace_text
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, RecordReceiver, Settings, Step
from mag_tracking.recording.reader import Recording
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.results.archive_folder import TABLES, common_columns, join_tables, recording_key
from mag_tracking.results.columns import MOMENT, names_of, row_of
from mag_tracking.results.fit_folder import pass_rows
from mag_tracking.results.parquet_table import TableWriter, check_row
from mag_tracking.run import RecordingSource, run
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.units import NS

N_DIPOLES = 3
"""Number of dipoles in the row that models a vehicle; a joint fit of several vehicles also tries
one fewer."""
CUT_FILE = 'columns.json'
HEALTH_INTERVAL_S = 600.0
"""Interval between the rows of a sensor in the table `health` [s]."""
SEGMENT_TABLES = ('tracks', 'poses', 'smoothed', 'passes')
_COLUMNS_OF_JOIN = ('tracks', 'passes', 'error')


@dataclass(frozen=True)
class Job:
    """Parameters of the tasks of one recording: `work_folder` is that of intermediate results."""

    recording: Path
    work_folder: Path
    archive_folder: Path
    network: SensorNetwork
    settings: Settings

    @property
    def cut_folder(self) -> Path:
        """Folder written by `cut`: segments, health table, and columns of the recording."""
        return self.work_folder / 'cut'

    def segment_folder(self, k: int) -> Path:
        """Folder that `track_segment` writes for a segment."""
        return self.work_folder / f'segment-{k}'


def cut(job: Job) -> dict[str, Any]:
    """Write the segments and the table of sensor health of a recording; return its columns in the
    table `recordings`, except tracks, passes and error."""
    if not job.cut_folder.exists():
        with _atomic_folder(job.cut_folder) as folder:
            with TableWriter(folder / 'health.parquet', TABLES['health']) as table:
                columns = _Segmenter(job, folder, table).read()
            replace_text(folder / CUT_FILE, json.dumps(columns))
    with segments.work_file_errors(job.cut_folder / CUT_FILE):
        stored: dict[str, Any] = json.loads((job.cut_folder / CUT_FILE).read_text())
        check_row(stored, [c for c in TABLES['recordings'] if c.name not in _COLUMNS_OF_JOIN])
    return stored


@contextmanager
def _atomic_folder(final: Path) -> Iterator[Path]:
    """Yield a temporary folder, then rename it to `final`; raises OutputError.

    Another process may run the same task: a worker considered lost, or a worker of a killed run.
    The first result is kept; all results are equal.
    """
    temporary = final.with_name(f'.{secrets.token_hex(8)}.{final.name}')
    with output_errors(final):
        temporary.mkdir()
    try:
        yield temporary
        if not final.exists():
            with output_errors(final):
                try:
                    temporary.rename(final)
                except OSError:
                    if not final.exists():
                        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


class _Segmenter:
    """Sink of the stages before the tracker that writes segments, passes and sensor health."""

    def __init__(self, job: Job, folder: Path, health: TableWriter) -> None:
        self._source = RecordingSource(Recording(job.recording), job.network)
        self._path, self._pipeline = job.recording, Pipeline(job.network, job.settings, 'detect')
        self._passes = PassCollector(self._pipeline)
        self._writer = segments.SegmentWriter(folder, job.settings.track.lookback_s)
        self._health = health
        self._previous_counts = dict.fromkeys(job.network.names, (0, 0))
        self._next_health_ns: int | None = None
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._n_passes = 0

    def read(self) -> dict[str, Any]:
        report = run(self._source, self._pipeline, [self])
        self._writer.close()
        if self._last_ns is not None:
            self._add_health(self._last_ns)
        return {
            **common_columns(self._path, self._first_ns), 'end_ns': self._last_ns,
            'frames': self._writer.n_frames, 'segments': self._writer.n_segments,
            'size': self._source.recording.size, 'lost': _format_counts(report.lost),
            'rejected': _format_counts(report.rejected),
            'missing_topics': ' '.join(report.missing_topics),
            'no_detection_reason': report.no_detection_reason or ''}

    def add(self, step: Step) -> None:
        passes = self._passes.passes(step)
        for frame in step.records:
            if isinstance(frame, FieldFrame):
                self._first_ns = frame.stamp_ns if self._first_ns is None else self._first_ns
                self._last_ns = frame.stamp_ns
                self._writer.add_frame(frame, self._pipeline.calibrate.input_doubts())
                self._add_due_health(frame.stamp_ns)
        for data, notes in passes:
            self._n_passes += 1
            self._writer.add_pass(self._n_passes, data, notes)

    def _add_due_health(self, stamp_ns: int) -> None:
        """Write the health rows that are due after a frame, also after a time jump."""
        interval_ns = int(HEALTH_INTERVAL_S * NS)
        if self._next_health_ns is None or stamp_ns < self._next_health_ns - interval_ns:
            self._next_health_ns = stamp_ns + interval_ns
        if stamp_ns >= self._next_health_ns:
            self._next_health_ns = stamp_ns + interval_ns
            self._add_health(stamp_ns)

    def _add_health(self, stamp_ns: int) -> None:
        """Write one row per sensor, with its accepted and rejected readings since the last row."""
        calibrate, unknown = self._pipeline.calibrate, np.full(3, np.nan)
        for name, background in calibrate.backgrounds().items():
            counts = calibrate.counts_of(name)
            previous, total = self._previous_counts[name], (counts['accepted'], counts['rejected'])
            self._previous_counts[name] = total
            is_known, covariance = background.ready and total[0] > 0, background.covariance
            vectors = {
                'background': calibrate.background(name) if is_known else unknown,
                'drift': background.drift,
                'noise': unknown if covariance is None else np.sqrt(np.diagonal(covariance))}
            self._health.add({
                **common_columns(self._path, stamp_ns), 'sensor': name,
                'accepted': total[0] - previous[0], 'rejected': total[1] - previous[1],
                'times_relearnt': background.n_relearnt, 'ready': background.ready,
                'stuck': background.stuck, 'doubtful': background.doubtful,
                **{f'{vector}_{axis}': float(v) for vector, values in vectors.items()
                   for axis, v in zip('xyz', values, strict=True)}})


def track_segment(job: Job, k: int) -> None:
    """Track segment `k` and write its tables; raises RecordingError if it is damaged."""
    if not job.segment_folder(k).exists():
        with _atomic_folder(job.segment_folder(k)) as folder:
            _SegmentTracker(folder, job, segments.ClockComparisonHistory(len(job.network))).run(
                k).write(folder)


class _SegmentTracker(RecordReceiver):
    """Tracks a segment with the clock `evidence` of earlier segments, and writes its tables."""

    def __init__(self, folder: Path, job: Job, evidence: segments.ClockComparisonHistory) -> None:
        self._folder, self._job, self._evidence = folder, job, evidence
        track = job.settings.track
        self._tracker = TrackManager(job.network, track, evidence)
        self._targets, self._ground = PassTracks(track), ground_prior(track)
        self._history = TrackHistory()
        self._tables: dict[str, TableWriter] = {}
        self._n_tracks = self._n_passes = 0

    def run(self, k: int) -> segments.SegmentResult:
        with ExitStack() as files:
            self._tables = {name: files.enter_context(TableWriter(
                self._folder / f'{name}.parquet', TABLES[name])) for name in SEGMENT_TABLES}
            for chunk in segments.read_segment(self._job.cut_folder / f'segment-{k}',
                                               self._job.network):
                for frame, doubts in chunk.frames():
                    if doubts is not None:
                        self._tracker.set_input_doubts(doubts)
                    records = self._tracker.feed(frame)
                    self._targets.add(records)
                    self._add_records([frame, *records])
                for log in [log for log in self._history.logs.values() if log.ended]:
                    self._add_track_row(log)
                for numbered_pass in chunk.passes:
                    self._add_pass(*numbered_pass)
            self._add_records(self._tracker.flush())
            for log in list(self._history.logs.values()):
                self._add_track_row(log)
        return segments.SegmentResult(self._n_tracks, self._n_passes,
                                      self._evidence.clocks_differed, self._evidence.passes)

    def _add_records(self, records: list[Any]) -> None:
        """Write the rows of poses, and store the poses for the rows of their tracks."""
        self.receive(records)
        self._history.receive(records)

    def add_track(self, track: Track) -> None:
        if not track.ended:
            self._add_pose('poses', track)

    def add_smoothed(self, pose: SmoothedPose) -> None:
        if pose.complete:
            self._add_pose('smoothed', pose)

    def _add_pose(self, table: str, pose: Track | SmoothedPose) -> None:
        self._tables[table].add(row_of(TABLES[table], pose, common_columns(
            self._job.recording, pose.stamp_ns)))

    def _add_track_row(self, log: TrackLog) -> None:
        """Write the row of a track that has ended, and discard the history of the track."""
        del self._history.logs[log.id]
        smoothed, summary = self._history.smoothed.pop(log.id, None), log.summary()
        self._n_tracks += 1
        columns = {
            **common_columns(self._job.recording, log.stamp_ns[0]), 'track_id': log.id, **summary,
            **dict(zip(names_of(MOMENT), summary['moment'], strict=True)),
            'doubts': ' '.join(summary['doubts']),
            'arrival_weight': summary['arrival_weights'][summary['arrival']]}
        if smoothed is not None:
            values = smoothed.summary()
            columns |= {'smoothed_speed': values['speed'],
                        'smoothed_moment_size': values['moment_size']}
        self._tables['tracks'].add(columns)

    def _add_pass(self, number: int, data: PassData, notes: tuple[str, ...]) -> None:
        recording = self._job.recording
        for vehicle in fitted_vehicles(
                recording.stem, number, data, (fit_pass(data, N_DIPOLES),),
                self._targets.paths(data), self._ground, (N_DIPOLES - 1, N_DIPOLES), notes):
            rows = pass_rows(vehicle)
            row = next((row for row in rows if row['chosen']), rows[-1])
            self._n_passes += 1
            self._tables['passes'].add(row | common_columns(recording, row['stamp_ns']) | {
                'number': number, 'notes': '; '.join(vehicle.notes)})


def join(job: Job) -> dict[str, Any]:
    """Join the tables of the segments, write them to the archive, and return the columns in the
    table `recordings`.

    If the clocks of sensors differ, the tracks of a segment depend on the passes in earlier
    segments, and it is tracked again. Raises RecordingError if intermediate results are damaged.
    """
    columns = cut(job)
    name, evidence = recording_key(job.recording), segments.ClockComparisonHistory(len(job.network))
    folders, id_offsets, n_tracks, n_passes = [], [], 0, 0
    with tempfile.TemporaryDirectory(dir=job.work_folder, prefix='.again.') as repeat_folder:
        for k in range(columns['segments']):
            folder = job.segment_folder(k)
            result = segments.SegmentResult.read(folder)
            evidence.passes = []
            combined_evidence = copy.deepcopy(evidence)
            for rigid_pass in result.clock_passes:
                combined_evidence.add(*rigid_pass)
            if k and (combined_evidence.clocks_differed or result.clocks_differed):
                folder = Path(repeat_folder) / f'segment-{k}'
                folder.mkdir()
                result = _SegmentTracker(folder, job, evidence).run(k)
            else:
                evidence = combined_evidence
            folders.append(folder)
            id_offsets.append(n_tracks)
            n_tracks += result.n_tracks
            n_passes += result.n_passes
        for table in SEGMENT_TABLES:
            join_tables([folder / f'{table}.parquet' for folder in folders],
                        id_offsets if table != 'passes' else [0] * len(id_offsets), table,
                        job.archive_folder, name)
    join_tables([job.cut_folder / 'health.parquet'], [0], 'health', job.archive_folder, name)
    return {**columns, 'tracks': n_tracks, 'passes': n_passes, 'error': ''}


def _format_counts(counts: Mapping[str, int]) -> str:
    """Format counts {cause: number} as `number cause; number cause`."""
    return '; '.join(f'{n} {cause}' for cause, n in counts.items())
