"""True poses from topics of a recording or from a table, for reports and never for tracking."""

from collections import Counter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from mag_tracking.analysis.track_errors import Truth
from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.errors import RecordingError
from mag_tracking.geometry import quaternion_between
from mag_tracking.messages.message_arrays import poses
from mag_tracking.messages.schema import stamp_ns
from mag_tracking.messages.types import ODOMETRY, POSE, POSE_WITH_COVARIANCE
from mag_tracking.recording.message_block import MessageBlock
from mag_tracking.recording.table_text import FilePath, number, read_csv
from mag_tracking.units import LATEST_NS, NS

TRUTH_TYPES = (POSE, POSE_WITH_COVARIANCE, ODOMETRY)
_Rows: TypeAlias = tuple[IntArray, FloatArray]
"""Times (n,) [ns], and positions and quaternions (n, 7)."""
_NS_PER_UNIT = {'stamp_ns': 1, 't': NS, 'time': NS}
"""Nanoseconds per unit, by column."""
_QUATERNION, _MOMENT = ('qx', 'qy', 'qz', 'qw'), ('mx', 'my', 'mz')


class TruthTopics:
    """Collects true poses from `topic`, or all topics below `prefix`.

    Poses in another frame than the world frame of the network are counted in `rejected`, by cause.
    """

    def __init__(self, prefix: str, frame: str, topic: str | None = None) -> None:
        self._prefix, self._frame, self._topic = prefix, frame, topic
        self.rejected: Counter[str] = Counter()
        self._rows: dict[str, list[_Rows]] = {}

    def accepts(self, topic: str, kind: str) -> bool:
        """Whether a topic of a message type carries true poses."""
        is_truth = topic.startswith(self._prefix) if self._topic is None else topic == self._topic
        return is_truth and kind in TRUTH_TYPES

    def add(self, topic: str, content: Any) -> None:
        """Add the pose of a decoded message, or reject it if it is in another frame."""
        frame = content.header.frame_id
        if frame and frame != self._frame:
            self.rejected[f'truth on {topic} is in frame {frame}, not {self._frame}'] += 1
            return
        pose = content.pose if hasattr(content.pose, 'position') else content.pose.pose
        p, q = pose.position, pose.orientation
        self._rows.setdefault(topic, []).append(
            (np.array([stamp_ns(content.header.stamp)]),
             np.array([[p.x, p.y, p.z, q.x, q.y, q.z, q.w]])))

    def add_block(self, block: MessageBlock) -> IntArray:
        """Add the CDR messages of type PoseStamped in a block; return the indices of those read."""
        collected: list[IntArray] = [np.zeros(0, dtype=np.int64)]
        for channel, kind in block.kinds.items():
            rows: IntArray = np.flatnonzero(block.channel == channel)
            if len(rows) and kind.type == POSE and kind.is_cdr and self.accepts(kind.topic, POSE):
                is_decoded, stamps, pose = poses(
                    block.data, block.begin[rows], block.end[rows], self._frame)
                collected.append(rows[is_decoded])
                self._rows.setdefault(kind.topic, []).append((stamps[is_decoded], pose[is_decoded]))
        return np.concatenate(collected)

    def arrays(self) -> dict[str, Truth]:
        """True poses by target, in chronological order."""
        out = {}
        for topic, rows in self._rows.items():
            stamps, pose = (np.concatenate(arrays) for arrays in zip(*rows, strict=True))
            order = np.argsort(stamps, kind='stable')
            if len(order):
                out[topic.removeprefix(self._prefix).removesuffix('/pose')] = (
                    stamps[order], pose[order, :3], _unit(pose[order, 3:]))
        return out


def read_truth_table(path: FilePath, axis: ArrayLike = (0.0, 0.0, 1.0)) -> dict[str, Truth]:
    """Read true poses in the frame of the network from a CSV file, as one target with its name.

    Columns: `stamp_ns` [ns], or `t` or `time` [s], since 1970; `x`, `y` [m]; optionally `z` [m],
    and `qx`, `qy`, `qz`, `qw` or, for a magnet, the direction `mx`, `my`, `mz` of its moment, which
    is `axis` (3,) in the frame of the magnet. Quaternions are NaN without orientations.
    """
    table = read_csv(path)
    time = next((name for name in _NS_PER_UNIT if name in table.header), None)
    if time is None:
        raise RecordingError(f'{path}: column stamp_ns, t or time is missing')
    j = table.header.index(time)
    stamps = np.array([_stamp(path, line, time, row[j]) for line, row in table.rows],
                      dtype=np.int64)
    position = table.numbers('xyz' if 'z' in table.header else 'xy')
    if any(name in table.header for name in _QUATERNION):
        quaternion = _unit(table.numbers(_QUATERNION))
    elif any(name in table.header for name in _MOMENT):
        quaternion = np.array([quaternion_between(axis, m) if m.any() else np.full(4, np.nan)
                               for m in table.numbers(_MOMENT)])
    else:
        quaternion = np.full((len(stamps), 4), np.nan)
    position = np.pad(position, ((0, 0), (0, 3 - position.shape[1])))
    order = np.argsort(stamps, kind='stable')
    return {Path(path).stem: (stamps[order], position[order], quaternion[order])}


def _unit(quaternion: FloatArray) -> FloatArray:
    """Normalise quaternions (n, 4); zeros, which mark an unknown orientation, become NaN."""
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    unit: FloatArray = quaternion / np.where(norm > 0.0, norm, np.nan)
    return unit


def _stamp(path: FilePath, line: int, column: str, text: str) -> int:
    """Convert a cell to ns since 1970, without rounding for integers in `stamp_ns`."""
    try:
        time_ns: float = int(text if column == 'stamp_ns' else '')
    except ValueError:
        time_ns = number(path, line, column, text, True) * _NS_PER_UNIT[column]
    if abs(time_ns) > LATEST_NS:
        raise RecordingError(f'{path}: row {line}: {column} is {text.strip()}, not a valid time')
    return round(time_ns)
