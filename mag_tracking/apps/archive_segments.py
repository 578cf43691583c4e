"""Cut a long recording into the stretches in which a target is near, for the tracker.

A recording is read once, from its beginning to its end, by all stages before the tracker, which
keep their backgrounds from stretch to stretch. The tracker starts without memory in each, and finds
the same as in the whole recording: a stretch begins with the frames that a track looks back to, and
ends where it is quiet for longer than that.
"""

import dataclasses
import pickle
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import BoolArray, FloatArray, IntArray
from mag_tracking.calibration.doubtful_times import DoubtfulTimes
from mag_tracking.errors import OutputError
from mag_tracking.records import FieldFrame
from mag_tracking.units import NS

FEWEST = 300
"""Frames of a stretch: shorter ones would cost more than they hold."""
PIECE = 2000
"""Frames that are kept in memory at once."""
QUIET_S = 1.0
"""[s] At least so long no target was near where a stretch ends."""

Doubts = Mapping[str, DoubtfulTimes]
CutPass = tuple[int, PassData, tuple[str, ...]]
"""The number of a pass in its recording, its measurements, and notes."""


@dataclasses.dataclass(frozen=True)
class FrameChunk:
    """Frames that follow each other, as arrays (n, ...), and the passes that ended with them."""

    stamp_ns: IntArray
    field: FloatArray
    covariance: FloatArray
    n_samples: IntArray
    time_offset: FloatArray
    target_present: BoolArray
    statistic: FloatArray
    degrees_of_freedom: IntArray
    doubts: dict[int, Doubts] = dataclasses.field(default_factory=dict)
    """{index of a frame: the doubtful times from it on}."""
    passes: tuple[CutPass, ...] = ()

    def frames(self) -> Iterator[tuple[FieldFrame, Doubts | None]]:
        """Each frame with its verdict, and the doubtful times where they are new."""
        for k in range(len(self.stamp_ns)):
            yield FieldFrame(
                int(self.stamp_ns[k]), self.field[k], self.covariance[k], self.n_samples[k],
                self.time_offset[k], bool(self.target_present[k]), float(self.statistic[k]),
                int(self.degrees_of_freedom[k])), self.doubts.get(k)


def read_segment(path: Path) -> Iterator[FrameChunk]:
    """The pieces of a stretch that `SegmentWriter` has written."""
    with open(path, 'rb') as stream:
        while stream.peek(1):
            yield pickle.load(stream)


class SegmentWriter:
    """Writes each stretch of a recording into a file of its own; memory stays bounded."""

    def __init__(self, folder: Path, lookback_s: float) -> None:
        """Files are `stretch-0.pickle`, ... in `folder`; a track looks `lookback_s` back."""
        self._folder = folder
        self._quiet_ns = int(max(lookback_s, QUIET_S) * NS)
        self.n_segments = self.n_frames = 0
        # Frames and doubts: quiet ones that a track may look back to, and those of the stretch.
        self._recent: deque[tuple[FieldFrame, Doubts]] = deque()
        self._kept: list[tuple[FieldFrame, Doubts]] = []
        self._passes: list[CutPass] = []
        self._n_written, self._is_open = 0, False
        self._quiet_since_ns = 0
        self._last: FieldFrame | None = None

    def add_frame(self, frame: FieldFrame, doubts: Doubts) -> None:
        """Take the next frame, with its verdict, and the doubtful times that are known by now."""
        last, self._last = self._last, frame
        self.n_frames += 1
        if last is not None and frame.stamp_ns <= last.stamp_ns:
            # The time jumped back: a track looks back to nothing of before. Where frames were left
            # out, the tracker of the stretch would not see it.
            if not last.target_present:
                self.close()
            self._recent.clear()
            self._quiet_since_ns = frame.stamp_ns
        if frame.target_present:
            self._kept += self._recent
            self._recent.clear()
            self._kept.append((frame, doubts))
        elif last is not None and last.target_present:
            # The frame that ends the tracks.
            self._kept.append((frame, doubts))
            self._quiet_since_ns = frame.stamp_ns
        else:
            if self._n_written + len(self._kept) >= FEWEST \
                    and frame.stamp_ns - self._quiet_since_ns > self._quiet_ns:
                self.close()
            self._recent.append((frame, doubts))
            while self._recent[0][0].stamp_ns < frame.stamp_ns - self._quiet_ns:
                self._recent.popleft()
        if len(self._kept) >= PIECE:
            self._write()

    def add_pass(self, number: int, data: PassData, notes: tuple[str, ...]) -> None:
        """Take a pass that has ended with the latest frame."""
        self._passes.append((number, data, notes))

    def close(self) -> None:
        """End the stretch, where there is one: the recording has ended, or it is quiet."""
        if self._kept or self._passes:
            self._write()
        self.n_segments += self._is_open
        self._n_written, self._is_open = 0, False

    def _write(self) -> None:
        """Append what is kept to the file of the stretch; raises OutputError."""
        frames = [frame for frame, _ in self._kept]
        doubts: dict[int, Doubts] = {}
        known: Doubts | None = None
        for k, (_, now) in enumerate(self._kept):
            if now != known:
                doubts[k] = known = now

        arrays = {name: np.array([getattr(frame, name) for frame in frames]) for name in (
            'stamp_ns', 'field', 'covariance', 'n_samples', 'time_offset', 'target_present',
            'statistic', 'degrees_of_freedom')}
        piece = FrameChunk(**arrays, doubts=doubts, passes=tuple(self._passes))
        path = self._folder / f'stretch-{self.n_segments}.pickle'
        try:
            with open(path, 'ab' if self._is_open else 'wb') as stream:
                pickle.dump(piece, stream)
        except OSError as error:
            raise OutputError(f'cannot write {path}: {error.strerror}') from error
        self._n_written += len(frames)
        self._is_open, self._kept, self._passes = True, [], []
