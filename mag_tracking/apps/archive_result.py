"""Result of a tracked segment that the task `join` needs, stored as JSON."""

import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mag_tracking.apps.archive_segments import work_file_errors
from mag_tracking.arrays import IntArray
from mag_tracking.files import replace_text
from mag_tracking.stages.track.cross_check import ClockComparison
from mag_tracking.stages.track.pass_samples import RigidPass

TRACKED_FILE = 'tracked.json'
"""Name of the file in the folder of a tracked segment."""


class ClockComparisonHistory(ClockComparison):
    """Clock comparison with the history of the passes added to it.

    Attributes
    ----------
    passes : passes, each with the indices of its sensors in the network
    clocks_differed : whether a clock offset was ever significant, so that tracks depend on earlier
        passes
    """

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
    """Numbers of tracks and passes in a tracked segment, and its comparison of clocks."""

    n_tracks: int
    """Number of tracks."""
    n_passes: int
    """Number of fitted passes, one per vehicle."""
    clocks_differed: bool
    """Whether a clock offset was ever significant within the segment."""
    clock_passes: list[tuple[RigidPass, IntArray]]
    """Passes that compared the clocks, each with the indices of its sensors in the network."""


def write_result(folder: Path, result: SegmentResult) -> None:
    """Store the result of a segment in its folder."""
    passes = [(dataclasses.asdict(found), rows) for found, rows in result.clock_passes]
    replace_text(folder / TRACKED_FILE, json.dumps(
        result._asdict() | {'clock_passes': passes}, default=np.ndarray.tolist))


def read_result(folder: Path) -> SegmentResult:
    """Read the result of a segment; raises RecordingError if the file is damaged."""
    with work_file_errors(folder / TRACKED_FILE):
        values: dict[str, Any] = json.loads((folder / TRACKED_FILE).read_text())
        passes = [(_rigid_pass(found), np.array(rows, dtype=np.int64))
                  for found, rows in values.pop('clock_passes')]
        return SegmentResult(**values, clock_passes=passes)


def _rigid_pass(values: dict[str, Any]) -> RigidPass:
    """Create a pass from its JSON values."""
    arrays = {name: np.array(value, dtype=np.float64) for name, value in values.items()
              if isinstance(value, list)}
    # The shape of an empty array is not stored.
    arrays['straight_paths'] = arrays['straight_paths'].reshape(-1, 6)
    return RigidPass(**{**values, **arrays})
