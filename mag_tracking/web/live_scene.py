"""State of a live page: recent tracks, latest frame and health."""

import threading
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np

from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.arrays import FloatArray
from mag_tracking.files import json_text
from mag_tracking.records import FieldFrame, Track
from mag_tracking.report import page_scene
from mag_tracking.report.page import Note, Table
from mag_tracking.report.page_scene import Sensors, packed
from mag_tracking.units import NS

MAX_TRACK_POSES, N_REMOVED = 8_000, 1_000
"""Maximum number of poses of one track, and number of poses that are removed if it is exceeded.
`scene.js` uses the same numbers."""
MAX_GAP_S = 60.0
"""[s] A pose after a longer gap belongs to another track with the same id."""
N_RECENT = 100
"""Minimum number of latest poses from which the sensors with the strongest fields are selected.
Only the fields of these sensors are sent."""
HISTORY_S = 600.0
"""[s] Time from the latest pose of a track to its removal."""
MAX_POSES = 30_000
"""Maximum number of poses over all tracks; the oldest tracks are removed first."""
MAX_FRAMES = 64
"""Number of recent frames that are stored for matching with tracks."""
JUMP_BACK_S = 1.0
"""[s] Maximum backward jump of the timestamps of frames. A larger jump starts a new scene; a
looped bag causes such a jump."""


class LiveTrack:
    """Track of a live page; `key` is unique, whereas a restarted tracker numbers from 1 again."""

    def __init__(self, key: int, track_id: int) -> None:
        self.key, self.log = key, TrackLog(track_id)
        self.smoothed: dict[str, Any] | None = None
        self.is_smoothed_new = False
        self._n_sent, self._is_end_sent = 0, False

    @property
    def end_ns(self) -> int:
        """Time of the latest pose [ns]."""
        return self.log.stamp_ns[-1]

    @property
    def has_unsent(self) -> bool:
        """Whether poses or the end of the track have not been sent yet."""
        return self._n_sent < len(self.log.stamp_ns) or self.log.ended and not self._is_end_sent

    def continues(self, track: Track) -> bool:
        """Whether a record with the same track id belongs to this track."""
        return not self.log.ended and abs(track.stamp_ns - self.end_ns) <= MAX_GAP_S * NS

    def add(self, track: Track, frame: FieldFrame) -> None:
        """Add a pose and its frame, and remove the oldest poses of a very long track."""
        self.log.add(track, frame)
        if len(self.log.stamp_ns) > MAX_TRACK_POSES:
            self.log.forget(N_REMOVED)
            self._n_sent = max(0, self._n_sent - N_REMOVED)

    def unsent_entry(self, begin_ns: int) -> dict[str, Any]:
        """JSON object with all unsent poses of a scene from `begin_ns`, which count as sent now."""
        first, self._n_sent = self._n_sent, len(self.log.stamp_ns)
        self._is_end_sent = self.log.ended
        return self._entry(begin_ns, range(first, self._n_sent))

    def sent_entry(self, begin_ns: int) -> dict[str, Any] | None:
        """JSON object with all poses that have already been sent; None if there are none."""
        return self._entry(begin_ns, range(self._n_sent)) if self._n_sent else None

    def _entry(self, begin_ns: int, rows: range) -> dict[str, Any]:
        """JSON object with the poses of `rows`, and the fields at the sensors with the strongest
        fields at the latest poses."""
        recent = range(max(0, rows.stop - max(N_RECENT, len(rows))), rows.stop)
        sensors = page_scene.strongest_sensors(self.log, recent)
        entry = page_scene.track_entry(self.log, begin_ns, sensors, rows)
        entry['key'], entry['smoothed'] = self.key, self.smoothed
        if self.log.ended:
            entry['facts'] = page_scene.facts_of(self.log.summary())
        return entry


class LiveScene:
    """Thread-safe state of a live page; titles are sent with the next complete scene."""

    def __init__(self, title: str, network: Sensors) -> None:
        self.title, self.subtitle = title, ''
        self._network = network
        self._lock = threading.Lock()
        self._notes: list[Note] = []
        self._tables: list[Table] = []
        self._is_health_new = False
        self._n_tracks = 0
        self._clear()

    def use_network(self, network: Sensors) -> None:
        """Start a new scene with another network."""
        with self._lock:
            self._network = network
            self._clear()

    def _clear(self) -> None:
        self._begin_ns: int | None = None
        self._end_ns = self._frame_ns = 0
        self._frames: OrderedDict[int, FieldFrame] = OrderedDict()
        self._n_new_frames = 0
        self._tracks: dict[int, LiveTrack] = {}
        # {track id: latest track with this id}
        self._latest_by_id: dict[int, LiveTrack] = {}
        self._is_scene_new = True

    def add_frame(self, frame: FieldFrame) -> None:
        """Add a frame; it must be added before the tracks with the same timestamp."""
        with self._lock:
            # Only frames are checked: the record of a track may be late or repeat its last pose.
            if self._frame_ns - frame.stamp_ns > JUMP_BACK_S * NS:
                self._clear()
            self._frame_ns = frame.stamp_ns
            self._extend_time(frame.stamp_ns)
            self._frames[frame.stamp_ns] = frame
            self._n_new_frames = min(self._n_new_frames + 1, MAX_FRAMES)
            while len(self._frames) > MAX_FRAMES:
                self._frames.popitem(last=False)

    def add_track(self, track: Track) -> None:
        """Add a pose or the closing record of a track."""
        with self._lock:
            live = self._latest_by_id.get(track.id)
            if live is None or not live.continues(track):
                if track.ended:
                    return
                self._n_tracks += 1
                live = LiveTrack(self._n_tracks, track.id)
                self._tracks[live.key] = self._latest_by_id[track.id] = live
            self._extend_time(track.stamp_ns)
            live.add(track, self._frames.get(track.stamp_ns) or self._empty_frame(track))
            self._remove_old_tracks()

    def _empty_frame(self, track: Track) -> FieldFrame:
        """Frame without data, at the time of a track pose whose frame is missing."""
        n = len(self._network)
        return FieldFrame(track.stamp_ns, np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan),
                          np.zeros(n, dtype=int), np.zeros(n))

    def add_smoothed(self, track_id: int, points: FloatArray) -> None:
        """Add the smoothed positions (n, 3) [m] of an ended track."""
        with self._lock:
            live = self._latest_by_id.get(track_id)
            if live is not None:
                live.smoothed = {**page_scene.path_entry(points), 'key': live.key}
                live.is_smoothed_new = True

    def set_health(self, notes: Iterable[Note], tables: Iterable[Table]) -> None:
        """Replace the notes and tables of the page."""
        notes, tables = list(notes), list(tables)
        with self._lock:
            if (notes, tables) != (self._notes, self._tables):
                self._notes, self._tables, self._is_health_new = notes, tables, True

    def snapshot(self) -> list[str]:
        """JSON messages that give a new viewer the state that all other viewers have received."""
        with self._lock:
            begin_ns = self._begin_ns or 0
            tracks = [live.sent_entry(begin_ns) for live in self._tracks.values()]
            frames = list(self._frames.values())[:self._n_sent_frames()]
            return [*self._scene_messages([t for t in tracks if t is not None]),
                    self._rows_message([], [], frames), self._health_message()]

    def updates(self) -> list[str]:
        """JSON messages with all changes since the last call."""
        with self._lock:
            if self._is_scene_new:
                self._is_scene_new = False
                return self._scene_messages([])
            out = [self._health_message()] if self._is_health_new else []
            self._is_health_new = False
            begin_ns = self._begin_ns or 0
            tracks = [live.unsent_entry(begin_ns) for live in self._tracks.values()
                      if live.has_unsent]
            smoothed = [live.smoothed for live in self._tracks.values() if live.is_smoothed_new]
            for live in self._tracks.values():
                live.is_smoothed_new = False
            frames = list(self._frames.values())[self._n_sent_frames():]
            self._n_new_frames = 0
            if tracks or smoothed or frames:
                out.append(self._rows_message(tracks, smoothed, frames))
            return out

    def _n_sent_frames(self) -> int:
        return max(0, len(self._frames) - self._n_new_frames)

    def _rows_message(self, tracks: list[dict[str, Any]], smoothed: list[dict[str, Any] | None],
                      frames: list[FieldFrame]) -> str:
        begin_ns = self._begin_ns or 0
        return json_text({
            'type': 'rows', 'tracks': tracks, 'smoothed': smoothed,
            'frames': [{'t': (frame.stamp_ns - begin_ns) / NS,
                        'field': packed(frame.field.ravel(), 'f4')} for frame in frames],
            'end': (self._end_ns - begin_ns) / NS, 'latest_ns': str(self._end_ns)})

    def _scene_messages(self, tracks: list[dict[str, Any]]) -> list[str]:
        """List with the message that replaces the scene; empty if the network has no sensors."""
        if not len(self._network):
            return []
        begin_ns = self._begin_ns or 0
        scene = page_scene.scene_of(self._network, begin_ns, max(self._end_ns, begin_ns), tracks)
        return [json_text({'type': 'scene', 'title': self.title, 'subtitle': self.subtitle,
                           'scene': scene})]

    def _health_message(self) -> str:
        return json_text({'type': 'health', 'notes': [asdict(note) for note in self._notes],
                          'tables': [asdict(table) for table in self._tables]})

    def _extend_time(self, stamp_ns: int) -> None:
        if self._begin_ns is None:
            self._begin_ns = stamp_ns
            # An empty scene that may have been sent earlier had no start time.
            self._is_scene_new = True
        self._end_ns = max(self._end_ns, stamp_ns)

    def _remove_old_tracks(self) -> None:
        """Remove tracks older than `HISTORY_S`, and the oldest while `MAX_POSES` is exceeded."""
        n = sum(len(live.log.stamp_ns) for live in self._tracks.values())
        for key, live in list(self._tracks.items())[:-1]:
            is_old = (self._end_ns - live.end_ns) / NS > HISTORY_S
            if is_old or n > MAX_POSES:
                n -= len(live.log.stamp_ns)
                del self._tracks[key]
                if self._latest_by_id.get(live.log.id) is live:
                    del self._latest_by_id[live.log.id]
