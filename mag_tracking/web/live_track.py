"""Track of a live page, with a record of the part that has been sent to viewers."""

from typing import Any

from mag_tracking.records import FieldFrame, Track
from mag_tracking.report.page_scene import facts_of, strongest_sensors, track_entry
from mag_tracking.report.track_log import TrackLog
from mag_tracking.units import NS

MAX_TRACK_POSES, N_REMOVED = 8_000, 1_000
"""Maximum number of poses of one track, and number of poses that are removed if it is exceeded.
`scene.js` uses the same numbers."""
MAX_GAP_S = 60.0
"""[s] A pose after a longer gap belongs to another track with the same id."""
N_RECENT = 100
"""Minimum number of latest poses from which the sensors with the strongest fields are selected.
Only the fields of these sensors are sent."""


class LiveTrack:
    """Track of a live page, which stores the poses and counts the poses that have been sent.

    `key` is unique on the page; track ids are not, because a restarted tracker begins at 1.
    """

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
        """JSON object with all unsent poses, which are then marked as sent.

        `begin_ns` is the start of the scene.
        """
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
        entry = track_entry(self.log, begin_ns, strongest_sensors(self.log, recent), rows)
        entry['key'], entry['smoothed'] = self.key, self.smoothed
        if self.log.ended:
            entry['facts'] = facts_of(self.log.summary())
        return entry
