"""Tracks and passes of one segment of a recording, as rows of archive tables."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.analysis.pass_fit import fit_pass
from mag_tracking.analysis.track_log import SmoothedLog, TrackLog
from mag_tracking.apps.archive_segments import FrameChunk
from mag_tracking.apps.passes import PassTracks, fitted_vehicles, ground_prior
from mag_tracking.apps.replay import TrackHistory
from mag_tracking.pipeline import RecordReceiver
from mag_tracking.records import SmoothedPose, Track
from mag_tracking.results.archive_folder import TABLES, common_columns
from mag_tracking.results.columns import MOMENT, names_of, row_of
from mag_tracking.results.fit_folder import pass_rows
from mag_tracking.results.parquet_table import TableWriter
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.stages.track.settings import TrackSettings

SEGMENT_TABLES = ('tracks', 'poses', 'smoothed', 'passes')
"""Tables that are filled from the segments."""


class SegmentTables(RecordReceiver):
    """Writes the tracks and passes of a segment to tables; a context manager.

    `paths` are the files of `SEGMENT_TABLES`. `n_dipoles` in the row model a vehicle; a joint fit
    of several vehicles also tries one fewer. `n_passes` counts a pass of several vehicles once per
    vehicle.
    """

    def __init__(self, recording: Path, paths: dict[str, Path], n_dipoles: int,
                 settings: TrackSettings) -> None:
        self._recording, self._n_dipoles = recording, n_dipoles
        self._tracks, self._ground = PassTracks(settings), ground_prior(settings)
        self._files = ExitStack()
        self._tables = {name: self._files.enter_context(TableWriter(paths[name], TABLES[name]))
                        for name in SEGMENT_TABLES}
        self._history = TrackHistory()
        self.n_tracks = self.n_passes = 0

    def __enter__(self) -> 'SegmentTables':
        return self

    def __exit__(self, *error: Any) -> None:
        self._files.__exit__(*error)

    def track(self, chunk: FrameChunk, tracker: TrackManager) -> None:
        """Track the targets in a chunk of the segment, fit its passes, and write the rows."""
        for frame, doubts in chunk.frames():
            if doubts is not None:
                tracker.set_input_doubts(doubts)
            records = tracker.feed(frame)
            self._tracks.add(records)
            for receiver in (self, self._history):
                receiver.receive([frame, *records])
        for log in [log for log in self._history.logs.values() if log.ended]:
            self._add_track_row(log)
        for numbered_pass in chunk.passes:
            self._add_pass(*numbered_pass)

    def finish(self, tracker: TrackManager) -> None:
        """End the segment and write the remaining tracks."""
        records = tracker.flush()
        for receiver in (self, self._history):
            receiver.receive(records)
        for log in list(self._history.logs.values()):
            self._add_track_row(log)

    def add_track(self, track: Track) -> None:
        """Write the row of a pose; the closing record of a track has no row."""
        if not track.ended:
            self._add_pose('poses', track)

    def add_smoothed(self, pose: SmoothedPose) -> None:
        """Write the row of a pose smoothed over a whole track; fixed-lag poses have no row."""
        if pose.complete:
            self._add_pose('smoothed', pose)

    def _add_pose(self, table: str, pose: Track | SmoothedPose) -> None:
        """Write the row of a published or smoothed pose."""
        self._tables[table].add(row_of(TABLES[table], pose, common_columns(
            self._recording, pose.stamp_ns)))

    def _add_track_row(self, log: TrackLog) -> None:
        """Write the row of a track that has ended, and discard the history of the track."""
        del self._history.logs[log.id]
        smoothed = self._history.smoothed.pop(log.id, None)
        self.n_tracks += 1
        self._tables['tracks'].add(
            common_columns(self._recording, log.stamp_ns[0]) | {'track_id': log.id}
            | _track_columns(log, smoothed))

    def _add_pass(self, number: int, data: PassData, notes: tuple[str, ...]) -> None:
        """Fit a pass as a whole and write one row per vehicle."""
        single_fits = (fit_pass(data, self._n_dipoles),)
        for vehicle in fitted_vehicles(self._recording.stem, number, data, single_fits,
                                       self._tracks.paths(data), self._ground,
                                       (self._n_dipoles - 1, self._n_dipoles), notes):
            rows = pass_rows(vehicle)
            row = next((row for row in rows if row['chosen']), rows[-1])
            self.n_passes += 1
            self._tables['passes'].add(
                row | common_columns(self._recording, row['stamp_ns']) | {
                    'number': number, 'notes': '; '.join(vehicle.notes)})


def _track_columns(log: TrackLog, smoothed: SmoothedLog | None) -> dict[str, Any]:
    """Columns of a track in the table `tracks`."""
    summary = log.summary()
    columns = summary | dict(zip(names_of(MOMENT), summary['moment'], strict=True)) | {
        'doubts': ' '.join(summary['doubts']),
        'arrival_weight': summary['arrival_weights'][summary['arrival']]}
    if smoothed is not None:
        values = smoothed.summary()
        columns |= {'smoothed_speed': values['speed'],
                    'smoothed_moment_size': values['moment_size']}
    return columns
