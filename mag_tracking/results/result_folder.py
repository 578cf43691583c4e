"""Results of an offline run: CSV tables and a recording, written continuously, and a summary."""

import csv
import json
import re
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from os import PathLike
from typing import Any, TextIO

import numpy as np

from mag_tracking.errors import OutputError
from mag_tracking.event_records import Disturbance
from mag_tracking.files import new_text_file, output_folder
from mag_tracking.network import SensorNetwork
from mag_tracking.record_receiver import RecordReceiver
from mag_tracking.recording import core
from mag_tracking.recording.writer import check_no_other_recording
from mag_tracking.records import Detection, FieldFrame, Hypotheses, SmoothedPose, Track
from mag_tracking.report.json_text import without_nan
from mag_tracking.report.page import REPORT
from mag_tracking.results.rerun_file import RERUN_FILE
from mag_tracking.results.track_recording import TrackRecording

POSE_COLUMNS = ('stamp_ns', 'track_id', 'x', 'y', 'z', 'vx', 'vy', 'vz', 'sd_x', 'sd_y', 'sd_z',
                'sd_vx', 'sd_vy', 'sd_vz', 'mx', 'my', 'mz', 'weight', 'ambiguous',
                'kind', 'kind_weight', 'length', 'sd_length', 'doubts')
SMOOTHED_COLUMNS = (*POSE_COLUMNS[:17], 'ambiguous', 'kind', 'length', 'sd_length')
DETECTION_COLUMNS = ('stamp_ns', 'id', 'event', 'statistic', 'degrees_of_freedom', 'threshold',
                     'false_alarm_probability', 'strongest_sensor')
DISTURBANCE_COLUMNS = ('stamp_ns', 'id', 'ended', 'begin_ns', 'largest', 'sensors', 'uniform',
                       'track_id')
HYPOTHESIS_COLUMNS = ('stamp_ns', 'track_id', 'arrival', 'kind', 'weight', 'x', 'y', 'z', 'vx',
                      'vy', 'vz', 'sd_x', 'sd_y', 'sd_z', 'sd_vx', 'sd_vy', 'sd_vz', 'mx', 'my',
                      'mz')


_TABLES = {'poses.csv': POSE_COLUMNS, 'poses_smoothed.csv': SMOOTHED_COLUMNS,
           'detections.csv': DETECTION_COLUMNS, 'disturbances.csv': DISTURBANCE_COLUMNS,
           'hypotheses.csv': HYPOTHESIS_COLUMNS}
_QUOTE, _SPECIAL = '"', {'"', ',', '\r', '\n'}
_SUMMARY, _RECORDING = 'summary.json', 'tracks.mcap'
_RESULTS = (*_TABLES, _SUMMARY, _RECORDING, 'metadata.yaml', REPORT, RERUN_FILE)
_TRACK_FILE = re.compile(r'(map|weights|field)_track_[0-9]+\.png|track_[0-9]+(_smoothed)?\.tum')


def figure_name(kind: str, track_id: int) -> str:
    """File name of a track's figure of kind `map`, `weights` or `field`."""
    return f'{kind}_track_{track_id}.png'


class ResultFolder(RecordReceiver):
    """Writes the tables and the recording of one run; a context manager.

    Rows are written immediately, so that an interrupted run does not lose them. Results of an
    earlier run, including figures and trajectories, are removed (`replaces_earlier`); other files
    remain. Raises OutputError if the folder contains another recording.
    """

    def __init__(self, folder: str | PathLike[str], network: SensorNetwork) -> None:
        self.folder = output_folder(folder)
        check_no_other_recording(self.folder / _RECORDING)
        self._files = ExitStack()
        try:
            self.replaces_earlier = self._remove_earlier_results()
            *streams, self._hypotheses = (
                self._stream(name, columns) for name, columns in _TABLES.items())
            self._poses, self._smoothed, self._detections, self._disturbances = (
                csv.writer(stream) for stream in streams)
            self._recording = TrackRecording(self.folder / _RECORDING, network)
        except OutputError:
            self._files.close()
            raise
        except OSError as error:
            self._files.close()
            raise OutputError(f'cannot write to {self.folder}: {error.strerror}') from error

    def _remove_earlier_results(self) -> bool:
        """Remove the results of an earlier run; return whether there were any."""
        # The summary and figures of an earlier run could be mistaken for results of this run.
        earlier_files = [path for path in self.folder.iterdir()
                         if (path.name in _RESULTS or _TRACK_FILE.fullmatch(path.name))
                         and (path.is_symlink() or not path.is_dir())]
        for path in earlier_files:
            path.unlink()
        return bool(earlier_files)

    def _stream(self, name: str, columns: tuple[str, ...]) -> TextIO:
        """Create a CSV file and write its header; return the open file."""
        stream = self._files.enter_context(new_text_file(self.folder / name, newline=''))
        csv.writer(stream).writerow(columns)
        return stream

    def __enter__(self) -> 'ResultFolder':
        return self

    def __exit__(self, *_: object) -> None:
        # Closing a file fails on a full disk. All other files must still be closed.
        try:
            self._files.close()
        finally:
            self._recording.close()

    def add_detection(self, detection: Detection) -> None:
        """Write a row for the onset or the release of a target.

        Parameters
        ----------
        detection : Detection
        """
        d = detection
        self._detections.writerow([
            d.stamp_ns, d.id, 'onset' if d.onset else 'release', repr(d.statistic),
            d.degrees_of_freedom, repr(d.threshold), repr(d.false_alarm_probability),
            d.strongest_sensor])

    def add_frame(self, frame: FieldFrame) -> None:
        """Write the fields of a frame with a target to the recording, not to a table.

        Parameters
        ----------
        frame : FieldFrame
        """
        if frame.target_present:
            self._recording.add_frame(frame)

    def add_track(self, track: Track) -> None:
        """Write a track record to the recording, and rows for its pose and each hypothesis.

        The last record of a track has no new pose and adds no rows.
        """
        self._recording.add_track(track)
        if track.ended:
            return
        sd = np.sqrt(np.diagonal(track.covariance))
        self._poses.writerow([track.stamp_ns, track.id, *_floats(
            track.position, track.velocity, sd, track.moment, [track.weight]),
            int(track.ambiguous), track.kind, *_floats(
                [track.kind_weight, track.length, track.length_std]), ' '.join(track.doubts)])
        self._add_hypotheses(track)

    def _add_hypotheses(self, track: Track) -> None:
        """Write one row per hypothesis."""
        h = track.hypotheses
        if not isinstance(h, Hypotheses):
            assert not h, 'expected the hypotheses as arrays'
            return
        sd = np.sqrt(np.diagonal(h.covariances, axis1=1, axis2=2))
        rows = core.number_rows(np.column_stack([h.weights, h.states, sd, h.moments]))
        row_prefix = f'{track.stamp_ns},{track.id},'
        pairs = [*zip(h.arrivals, h.kinds, strict=True)]
        names = {pair: ','.join(map(_csv_cell, pair)) for pair in {*pairs}}
        self._hypotheses.write(''.join(
            f'{row_prefix}{names[pair]},{row}\r\n' for pair, row in zip(pairs, rows, strict=True)))

    def add_disturbance(self, disturbance: Disturbance) -> None:
        """Write a disturbance to the recording and the table, at its detection and at its end.

        Parameters
        ----------
        disturbance : Disturbance
        """
        d = disturbance
        self._recording.add_disturbance(d)
        self._disturbances.writerow([
            d.stamp_ns, d.id, int(d.ended), d.begin_ns, repr(d.largest), ' '.join(d.sensors),
            repr(d.uniform), d.track_id])

    def add_smoothed(self, pose: SmoothedPose) -> None:
        """Write a pose smoothed over the whole track; ignore poses from fixed-lag smoothing."""
        if pose.complete:
            self._recording.add_smoothed(pose)
            sd = np.sqrt(np.diagonal(pose.covariance))
            self._smoothed.writerow([
                pose.stamp_ns, pose.id, *_floats(pose.position, pose.velocity, sd, pose.moment),
                int(pose.ambiguous), pose.kind, *_floats([pose.length, pose.length_std])])

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write `summary.json`; NaN is written as null."""
        with new_text_file(self.folder / _SUMMARY) as stream:
            json.dump(without_nan(summary), stream, indent=1, allow_nan=False)
            stream.write('\n')


def _csv_cell(text: str) -> str:
    """Quote a string for a CSV file, if necessary."""
    return f'"{text.replace(_QUOTE, 2 * _QUOTE)}"' if _SPECIAL & {*text} else text


def _floats(*groups: Iterable[float]) -> list[str]:
    """Format numbers as the shortest strings that are parsed to the same numbers."""
    return [repr(float(v)) for group in groups for v in group]
