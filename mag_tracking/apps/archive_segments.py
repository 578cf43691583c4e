"""Segments of a recording in which a target is detected, stored as files for the tracker.

The stages before the tracker process the recording once, from beginning to end, and keep their
backgrounds across segments. The tracker is restarted for each segment, but finds the same tracks
as in the whole recording. A segment therefore begins with all earlier frames that a new track may
use. It ends only after an interval without a target that is longer than the time span of these
frames.
"""

import dataclasses
import pickle
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.doubtful_times import InputDoubts
from mag_tracking.errors import OutputError
from mag_tracking.records import FieldFrame
from mag_tracking.units import NS

MIN_SEGMENT_FRAMES = 300
"""Minimum number of frames in a segment. Shorter segments have too much overhead."""
CHUNK_FRAMES = 2000
"""Number of frames in memory at which a chunk is written to the file."""
MIN_QUIET_S = 1.0
"""Minimum duration without a target that ends a segment [s]."""

Doubts = InputDoubts
"""{reason: {sensor: times at which its readings are doubtful}}."""
NumberedPass = tuple[int, PassData, tuple[str, ...]]
"""Index of a pass in its recording (from 1), measurements of the pass, and notes for the user."""


@dataclasses.dataclass(frozen=True)
class FrameChunk:
    """Consecutive frames as arrays, and the passes that ended during these frames."""

    stamp_ns: IntArray
    """(n,) ns, timestamps of the frames."""
    field: FloatArray
    """(n, n_sensors, 3) T, sensor frame, background removed."""
    covariance: FloatArray
    """(n, n_sensors, 3, 3) T², sensor frame."""
    n_samples: IntArray
    """(n, n_sensors) number of averaged samples; 0 if the sensor is missing."""
    time_offset: FloatArray
    """(n, n_sensors) s, mean time of the samples of a sensor relative to `stamp_ns`."""
    target_present: BoolArray
    """(n,) whether a target is present."""
    statistic: FloatArray
    """(n,) detection statistic."""
    degrees_of_freedom: IntArray
    """(n,) degrees of freedom of the detection statistic."""
    doubts: dict[int, Doubts] = dataclasses.field(default_factory=dict)
    """{index of a frame: doubtful times that apply from this frame on}."""
    passes: tuple[NumberedPass, ...] = ()
    """Passes that ended within the chunk."""

    def frames(self) -> Iterator[tuple[FieldFrame, Doubts | None]]:
        """Iterate over the frames.

        Yields
        ------
        frame : FieldFrame
            Frame with its detection result.
        doubts : Doubts or None
            Doubtful times of each sensor if they change with this frame, otherwise None.
        """
        for k in range(len(self.stamp_ns)):
            yield FieldFrame(
                int(self.stamp_ns[k]), self.field[k], self.covariance[k], self.n_samples[k],
                self.time_offset[k], bool(self.target_present[k]), float(self.statistic[k]),
                int(self.degrees_of_freedom[k])), self.doubts.get(k)


def read_segment(path: Path) -> Iterator[FrameChunk]:
    """Read a segment written by `SegmentWriter`.

    Parameters
    ----------
    path : Path
        File of the segment.

    Yields
    ------
    FrameChunk
    """
    with open(path, 'rb') as stream:
        while stream.peek(1):
            yield pickle.load(stream)


class SegmentWriter:
    """Writes each segment of a recording to a separate file, using bounded memory.

    Parameters
    ----------
    folder : Path
        Folder for the files `segment-0.pickle`, ...
    lookback_s : float, s
        Time span of the earlier frames that a new track uses.

    Attributes
    ----------
    n_segments : int
        Number of completed segments.
    n_frames : int
        Number of frames added.
    """

    def __init__(self, folder: Path, lookback_s: float) -> None:
        self._folder = folder
        self._quiet_ns = int(max(lookback_s, MIN_QUIET_S) * NS)
        self.n_segments = self.n_frames = 0
        # Pairs (frame, doubts): frames without a target that a new track may use, and frames of the
        # open segment.
        self._lookback: deque[tuple[FieldFrame, Doubts]] = deque()
        self._unwritten: list[tuple[FieldFrame, Doubts]] = []
        self._passes: list[NumberedPass] = []
        self._n_written, self._is_open = 0, False
        self._quiet_since_ns = 0
        self._last_frame: FieldFrame | None = None

    def add_frame(self, frame: FieldFrame, doubts: Doubts) -> None:
        """Add the next frame.

        A chunk is written when it has `CHUNK_FRAMES` frames. A segment with at least
        `MIN_SEGMENT_FRAMES` frames ends after an interval without a target that is longer than
        `lookback_s` and `MIN_QUIET_S`. Any segment ends if the time jumps back while no target is
        present.

        Parameters
        ----------
        frame : FieldFrame
            Frame with its detection result.
        doubts : Doubts
            Doubtful times of each sensor, as known at this frame.

        Raises
        ------
        OutputError
            If the segment file cannot be written.
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
        """Add a pass that ended with the latest frame.

        Parameters
        ----------
        number : int
            Index of the pass in the recording, from 1.
        data : PassData
        notes : tuple of str
            Notes for the user.
        """
        self._passes.append((number, data, notes))

    def close(self) -> None:
        """End the current segment, if there is one.

        Raises
        ------
        OutputError
            If the segment file cannot be written.
        """
        if self._unwritten or self._passes:
            self._write()
        self.n_segments += self._is_open
        self._n_written, self._is_open = 0, False

    def _write(self) -> None:
        """Append the buffered frames and passes to the segment file; raises OutputError."""
        frames = [frame for frame, _ in self._unwritten]
        doubts: dict[int, Doubts] = {}
        previous: Doubts | None = None
        for k, (_, current) in enumerate(self._unwritten):
            if current != previous:
                doubts[k] = previous = current

        arrays = {name: np.array([getattr(frame, name) for frame in frames]) for name in (
            'stamp_ns', 'field', 'covariance', 'n_samples', 'time_offset', 'target_present',
            'statistic', 'degrees_of_freedom')}
        chunk = FrameChunk(**arrays, doubts=doubts, passes=tuple(self._passes))
        path = self._folder / f'segment-{self.n_segments}.pickle'
        try:
            with open(path, 'ab' if self._is_open else 'wb') as stream:
                pickle.dump(chunk, stream)
        except OSError as error:
            raise OutputError(f'cannot write {path}: {error.strerror}') from error
        self._n_written += len(frames)
        self._is_open, self._unwritten, self._passes = True, [], []
