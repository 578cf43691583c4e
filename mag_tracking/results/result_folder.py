"""Results of an offline run: CSV tables and a recording, written continuously, and a summary."""

import csv
import re
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.errors import OutputError
from mag_tracking.event_records import Disturbance
from mag_tracking.files import new_text_file, output_folder, write_json
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import RecordReceiver
from mag_tracking.recording import core
from mag_tracking.recording.writer import check_no_other_recording
from mag_tracking.records import Detection, FieldFrame, Hypotheses, SmoothedPose, Track
from mag_tracking.results.columns import RESULT_TABLES, names_of, row_of
from mag_tracking.results.track_files import RERUN_FILE, TrackRecording

REPORT = 'report.html'
_QUOTE, _SPECIAL = '"', {'"', ',', '\r', '\n'}
_SUMMARY, _RECORDING = 'summary.json', 'tracks.mcap'
_RESULTS = (*RESULT_TABLES, _SUMMARY, _RECORDING, 'metadata.yaml', REPORT, RERUN_FILE)
_TRACK_FILE = re.compile(r'(map|weights|field)_track_[0-9]+\.png|track_[0-9]+(_smoothed)?\.tum')


def figure_name(kind: str, track_id: int) -> str:
    """File name of a track's figure of kind `map`, `weights` or `field`."""
    return f'{kind}_track_{track_id}.png'


class ResultFolder(RecordReceiver, AbstractContextManager['ResultFolder']):
    """Writes the tables and the recording of one run; a context manager.

    Rows are written immediately, so that an interrupted run does not lose them. Results of an
    earlier run, including figures and trajectories, are removed (`replaces_earlier`); other files
    remain. Raises OutputError if the folder contains another recording.
    """

    def __init__(self, folder: str | PathLike[str], network: SensorNetwork) -> None:
        self.folder = output_folder(folder)
        check_no_other_recording(self.folder / _RECORDING)
        with ExitStack() as files:
            try:
                self.replaces_earlier = self._remove_earlier_results()
                self._streams = {name: files.enter_context(
                    new_text_file(self.folder / name, newline='')) for name in RESULT_TABLES}
                for name, columns in RESULT_TABLES.items():
                    csv.writer(self._streams[name]).writerow(names_of(columns))
                self._recording = TrackRecording(self.folder / _RECORDING, network)
            except OSError as error:
                raise OutputError(f'cannot write to {self.folder}: {error.strerror}') from error
            self._files = files.pop_all()

    def _remove_earlier_results(self) -> bool:
        """Remove the results of an earlier run; return whether there were any."""
        # The summary and figures of an earlier run could be mistaken for results of this run.
        earlier_files = [path for path in self.folder.iterdir()
                         if (path.name in _RESULTS or _TRACK_FILE.fullmatch(path.name))
                         and (path.is_symlink() or not path.is_dir())]
        for path in earlier_files:
            path.unlink()
        return bool(earlier_files)

    def _write(self, name: str, record: object) -> None:
        """Write a record to a table; numbers are read back exactly."""
        csv.writer(self._streams[name]).writerow([
            int(v) if isinstance(v, bool) else v
            for v in row_of(RESULT_TABLES[name], record).values()])

    def __exit__(self, *_: object) -> None:
        # Closing a file fails on a full disk. All other files must still be closed.
        try:
            self._files.close()
        finally:
            self._recording.close()

    def add_detection(self, detection: Detection) -> None:
        """Write a row for the onset or the release of a target."""
        self._write('detections.csv', detection)

    def add_frame(self, frame: FieldFrame) -> None:
        """Write the fields of a frame with a target to the recording, not to a table."""
        if frame.target_present:
            self._recording.add_frame(frame)

    def add_track(self, track: Track) -> None:
        """Write a track record to the recording, and, unless it is the last one without a new pose,
        rows for its pose and each hypothesis."""
        self._recording.add_track(track)
        if not track.ended:
            self._write('poses.csv', track)
            self._add_hypotheses(track)

    def _add_hypotheses(self, track: Track) -> None:
        h = track.hypotheses
        if not isinstance(h, Hypotheses):
            assert not h, 'expected the hypotheses as arrays'
            return
        sd = np.sqrt(np.diagonal(h.covariances, axis1=1, axis2=2))
        rows = core.number_rows(np.column_stack([h.weights, h.states, sd, h.moments]))
        row_prefix = f'{track.stamp_ns},{track.id},'
        pairs = [*zip(h.arrivals, h.kinds, strict=True)]
        names = {pair: ','.join(map(_csv_cell, pair)) for pair in {*pairs}}
        self._streams['hypotheses.csv'].write(''.join(
            f'{row_prefix}{names[pair]},{row}\r\n' for pair, row in zip(pairs, rows, strict=True)))

    def add_disturbance(self, disturbance: Disturbance) -> None:
        """Write a disturbance to the recording and the table, at its detection and at its end."""
        self._recording.add_disturbance(disturbance)
        self._write('disturbances.csv', disturbance)

    def add_smoothed(self, pose: SmoothedPose) -> None:
        """Write a pose smoothed over the whole track; ignore poses from fixed-lag smoothing."""
        if pose.complete:
            self._recording.add_smoothed(pose)
            self._write('poses_smoothed.csv', pose)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write `summary.json`; NaN is written as null."""
        write_json(self.folder / _SUMMARY, summary)


def _csv_cell(text: str) -> str:
    return f'"{text.replace(_QUOTE, 2 * _QUOTE)}"' if _SPECIAL & {*text} else text
