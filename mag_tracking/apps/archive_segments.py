"""Segments of a recording in which a target is detected, stored as files for the tracker.

The stages before the tracker process the recording once, from beginning to end. The tracker is
restarted for each segment, but finds the same tracks as in the whole recording: a segment begins
with all earlier frames that a new track may use, and ends only after an interval without a target
that is longer than the time span of these frames.
"""

import dataclasses
import json
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.doubtful_times import InputDoubts
from mag_tracking.errors import RecordingError
from mag_tracking.files import output_errors, replace_text
from mag_tracking.network import SensorNetwork
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.cross_check import ClockComparison
from mag_tracking.stages.track.pass_samples import RigidPass
from mag_tracking.units import NS

MIN_SEGMENT_FRAMES = 300
"""Minimum number of frames in a segment. Shorter segments have too much overhead."""
CHUNK_FRAMES = 2000
"""Number of frames in memory at which a chunk is written to the file."""
MIN_QUIET_S = 1.0
"""Minimum duration without a target that ends a segment [s]."""
TRACKED_FILE = 'tracked.json'
Doubts = InputDoubts
"""{reason: {sensor: times at which its readings are doubtful}}."""
NumberedPass = tuple[int, PassData, tuple[str, ...]]
"""Index of a pass in its recording (from 1), measurements of the pass, and notes for the user."""
_FRAME_ARRAYS = tuple(f.name for f in dataclasses.fields(FieldFrame))
_PASS_ARRAYS = ('t', 'sensor', 'field', 'covariance')


@dataclasses.dataclass(frozen=True)
class FrameChunk:
    """Attributes of n frames, stacked; passes that ended then; {index: doubts from a frame on}."""

    stamp_ns: IntArray
    field: FloatArray
    covariance: FloatArray
    n_samples: IntArray
    time_offset: FloatArray
    target_present: BoolArray
    statistic: FloatArray
    degrees_of_freedom: IntArray
    doubts: dict[int, Doubts]
    passes: tuple[NumberedPass, ...]

    def frames(self) -> Iterator[tuple[FieldFrame, Doubts | None]]:
        """Iterate over the frames, each with the doubtful times, or None if they are unchanged."""
        for k in range(len(self.stamp_ns)):
            yield FieldFrame(
                int(self.stamp_ns[k]), self.field[k], self.covariance[k], self.n_samples[k],
                self.time_offset[k], bool(self.target_present[k]), float(self.statistic[k]),
                int(self.degrees_of_freedom[k])), self.doubts.get(k)


@contextmanager
def work_file_errors(path: Path) -> Iterator[None]:
    """Convert the errors of reading a file of intermediate results to a RecordingError."""
    try:
        yield
    except (OSError, ValueError, TypeError, LookupError, EOFError, RecursionError,
            BadZipFile) as error:
        raise RecordingError(f'{path} is damaged ({error}); delete the folder "unfinished" of the '
                             'archive and run the same command again') from error


def read_segment(folder: Path, network: SensorNetwork) -> Iterator[FrameChunk]:
    """Read the segment that `SegmentWriter` wrote to a folder; raises RecordingError."""
    with work_file_errors(folder):
        paths = sorted(folder.iterdir(), key=lambda path: int(path.stem))
    for path in paths:
        with work_file_errors(path), np.load(path) as arrays:
            text = json.loads(str(arrays['text']))
            doubts: dict[int, Doubts] = {
                int(k): {reason: {sensor: tuple((begin, end) for begin, end in times)
                                  for sensor, times in by_sensor.items()}
                         for reason, by_sensor in by_reason.items()}
                for k, by_reason in text['doubts'].items()}
            passes = tuple(
                (number, PassData(network, stamp_ns, doubt=doubt, **{
                    name: arrays[f'pass_{number}_{name}'] for name in _PASS_ARRAYS}),
                 tuple(notes)) for number, stamp_ns, doubt, notes in text['passes'])
            chunk = FrameChunk(**{name: arrays[name] for name in _FRAME_ARRAYS}, doubts=doubts,
                               passes=passes)
        yield chunk


class SegmentWriter:
    """Writes segments to the folders `segment-0`, ..., each with the chunks `0.npz`, ...;
    `lookback_s` is the time span of the earlier frames that a new track uses."""

    def __init__(self, folder: Path, lookback_s: float) -> None:
        self._folder = folder
        self._quiet_ns = int(max(lookback_s, MIN_QUIET_S) * NS)
        self.n_segments = self.n_frames = 0
        # Pairs (frame, doubts): frames without a target that a new track may use, and frames of the
        # open segment.
        self._lookback: deque[tuple[FieldFrame, Doubts]] = deque()
        self._unwritten: list[tuple[FieldFrame, Doubts]] = []
        self._passes: list[NumberedPass] = []
        self._n_written = self._n_chunks = 0
        self._quiet_since_ns = 0
        self._last_frame: FieldFrame | None = None

    def add_frame(self, frame: FieldFrame, doubts: Doubts) -> None:
        """Add the next frame, with the doubtful times of each sensor as known then.

        A segment with `MIN_SEGMENT_FRAMES` ends after an interval without a target longer than
        `lookback_s` and `MIN_QUIET_S`, any segment if the time jumps back without a target.
        """
        last, self._last_frame = self._last_frame, frame
        self.n_frames += 1
        if last is not None and frame.stamp_ns <= last.stamp_ns:
            # The time jumped back: a new track does not use earlier frames. After frames without a
            # target, which are not stored, the tracker could not detect the jump. The segment ends.
            if not last.target_present:
                self.close()
            self._lookback.clear()
            self._quiet_since_ns = frame.stamp_ns
        if frame.target_present:
            self._unwritten += self._lookback
            self._lookback.clear()
            self._unwritten.append((frame, doubts))
        elif last is not None and last.target_present:
            # This frame ends the tracks.
            self._unwritten.append((frame, doubts))
            self._quiet_since_ns = frame.stamp_ns
        else:
            if self._n_written + len(self._unwritten) >= MIN_SEGMENT_FRAMES \
                    and frame.stamp_ns - self._quiet_since_ns > self._quiet_ns:
                self.close()
            self._lookback.append((frame, doubts))
            while self._lookback[0][0].stamp_ns < frame.stamp_ns - self._quiet_ns:
                self._lookback.popleft()
        if len(self._unwritten) >= CHUNK_FRAMES:
            self._write()

    def add_pass(self, number: int, data: PassData, notes: tuple[str, ...]) -> None:
        """Add pass `number` (from 1 in the recording), which ended with the latest frame."""
        self._passes.append((number, data, notes))

    def close(self) -> None:
        """End the current segment, if there is one."""
        if self._unwritten or self._passes:
            self._write()
        self.n_segments += self._n_chunks > 0
        self._n_written = self._n_chunks = 0

    def _write(self) -> None:
        """Write the buffered frames and passes to the next file: arrays, and one JSON text."""
        arrays: dict[str, Any] = {
            name: np.array([getattr(frame, name) for frame, _ in self._unwritten])
            for name in _FRAME_ARRAYS}
        doubts: dict[int, Doubts] = {}
        previous: Doubts | None = None
        for k, (_, current) in enumerate(self._unwritten):
            if current != previous:
                doubts[k] = previous = current
        for number, data, _ in self._passes:
            arrays |= {f'pass_{number}_{name}': getattr(data, name) for name in _PASS_ARRAYS}
        text = json.dumps({'doubts': doubts, 'passes': [
            (number, data.stamp_ns, data.doubt, notes) for number, data, notes in self._passes]})
        path = self._folder / f'segment-{self.n_segments}' / f'{self._n_chunks}.npz'
        with output_errors(path):
            path.parent.mkdir(exist_ok=True)
            with open(path, 'xb') as stream:
                np.savez(stream, text=np.array(text), **arrays)
        self._n_written += len(self._unwritten)
        self._n_chunks += 1
        self._unwritten, self._passes = [], []


class ClockComparisonHistory(ClockComparison):
    """Clock comparison with the passes added to it, and whether a clock offset was ever
    significant, so that tracks depend on earlier passes."""

    def __init__(self, n_sensors: int) -> None:
        super().__init__(n_sensors)
        self.passes: list[tuple[RigidPass, IntArray]] = []
        self.clocks_differed = False

    def add(self, found: RigidPass, rows: IntArray) -> None:
        """Add a pass; `rows` are the indices of its sensors in the network."""
        super().add(found, rows)
        self.passes.append((found, rows))
        self.clocks_differed |= self.largest_offset is not None


class SegmentResult(NamedTuple):
    """Counts of a segment and its passes that compared clocks, for the task `join`; JSON."""

    n_tracks: int
    n_passes: int
    clocks_differed: bool
    clock_passes: list[tuple[RigidPass, IntArray]]

    def write(self, folder: Path) -> None:
        """Store the result in the folder of the segment."""
        passes = [(dataclasses.asdict(found), rows) for found, rows in self.clock_passes]
        replace_text(folder / TRACKED_FILE, json.dumps(
            self._asdict() | {'clock_passes': passes}, default=np.ndarray.tolist))

    @classmethod
    def read(cls, folder: Path) -> 'SegmentResult':
        """Read the result of a segment; raises RecordingError if the file is damaged."""
        with work_file_errors(folder / TRACKED_FILE):
            values: dict[str, Any] = json.loads((folder / TRACKED_FILE).read_text())
            passes = []
            for found, rows in values.pop('clock_passes'):
                arrays = {name: np.array(value, dtype=np.float64) for name, value in found.items()
                          if isinstance(value, list)}
                # The shape of an empty array is not stored.
                arrays['straight_paths'] = arrays['straight_paths'].reshape(-1, 6)
                passes.append((RigidPass(**{**found, **arrays}), np.array(rows, dtype=np.int64)))
            return cls(**values, clock_passes=passes)
