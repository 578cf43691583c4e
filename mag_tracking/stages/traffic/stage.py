"""Vehicles that cross counting lines, from their tracks; and summaries of intervals."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.event_records import Disturbance, TrafficSummary, VehiclePassage
from mag_tracking.geometry import heading_of, speed_of
from mag_tracking.inference.log_normal_classes import (
    UNKNOWN,
    ClassPosterior,
    Feature,
    class_posterior,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.network.counting_line import (
    CountingLine,
    Crossing,
    CrossingDetector,
    Pose,
    counting_lines,
)
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.report.traffic_intervals import TrafficIntervals
from mag_tracking.stages.traffic.field_direction import FieldDirection
from mag_tracking.stages.traffic.settings import PER_CLASS, PER_LINE, TrafficSettings
from mag_tracking.units import NS

AMBIGUOUS, CONTRADICTED, EXTRAPOLATED = 'ambiguous', 'direction_contradicted', 'extrapolated'
"""Doubts of a passage: its track is ambiguous at the line; the fields rotate the other way; the
track does not reach the line."""

MAX_ERROR = 0.9
"""A direction that is wrong with this probability by the fields is doubtful."""

ALONE_S = 2.0
"""[s] Another vehicle that is tracked within this time of a crossing has a part in the fields."""

SAME_S, SAME_M = 1.0, 3.0
"""[s], [m] A track that ends before the line and one that begins behind it, closer than this, are
of one vehicle that was lost and found again."""

BEFORE_S = 3.0
"""[s] A smoothed path begins up to this time before the first published pose of its track."""

MAX_WAIT_S = 120.0
"""[s] Passages and summaries do not wait longer than this for a track."""

TrafficRecord: TypeAlias = VehiclePassage | TrafficSummary


class TrackedFrame(NamedTuple):
    """A frame, and the tracker's records of it.

    Without a frame: records of tracks that end together because no frame comes.
    """

    frame: FieldFrame | None
    records: Sequence[Track | SmoothedPose | Disturbance]


@dataclass
class _Seen:
    """A track, running or ended."""

    begin_ns: int
    last_ns: int
    published: list[CrossingDetector]
    smoothed: list[CrossingDetector]
    ended: bool = False

    def overlaps(self, begin_ns: int, end_ns: int) -> bool:
        """Whether it was there in a stretch of time."""
        return self.begin_ns <= end_ns and begin_ns <= self.last_ns


class _Found(NamedTuple):
    """A crossing that waits for earlier ones."""

    crossing: Crossing
    line: CountingLine
    track_id: int
    track: _Seen
    direction_error: float


class Traffic:
    """`TrackedFrame`s to passages and summaries.

    A track is counted when it has ended, by its smoothed poses where there are any. Passages come
    in order of time, unless a track lasts longer than others wait for it.
    """

    def __init__(self, network: SensorNetwork, settings: TrafficSettings,
                 is_of_vehicles: bool = True) -> None:
        """Without vehicles nothing is counted. Raises SettingsError for settings that do not fit
        together.
        """
        _check(settings)
        self.counts: Counter[str] = Counter()
        self._settings = settings
        self._lines = counting_lines(settings.line_names, settings.line_headings_deg,
                               settings.line_offsets, settings.line_half_widths,
                               network.centre) if is_of_vehicles else []
        self._direction = FieldDirection(network)
        self._intervals = TrafficIntervals(settings.line_names, settings.interval_s, self.counts)
        self._open: dict[int, _Seen] = {}
        self._past: list[_Seen] = []
        self._waiting: list[_Found] = []
        # {(line, forward): the latest crossing}
        self._latest: dict[tuple[str, bool], _Found] = {}
        self._last_ns: int | None = None

    def feed(self, item: TrackedFrame) -> list[TrafficRecord]:
        """What the tracker made of a frame; passages and summaries that follow."""
        if not self._lines:
            return []
        out: list[TrafficRecord] = []
        frame, records = item
        if frame is not None and self._last_ns is not None and frame.stamp_ns < self._last_ns:
            self.counts['time jumped back'] += 1
            self._take(r for r in records if not _is_running(r))
            out += self.flush()
            records = [r for r in records if _is_running(r)]
        self._take(records)
        if frame is None:
            return [*out, *self._count_ended(None)]
        self._last_ns = frame.stamp_ns
        self._direction.remember(frame, self._complete_before(frame.stamp_ns))
        out += self._count_ended(frame.stamp_ns)
        return [*out, *self._intervals.due(self._complete_before(frame.stamp_ns), frame.stamp_ns)]

    def idle(self) -> None:
        """Nothing waits."""

    def flush(self) -> list[TrafficRecord]:
        """The input has ended: the passages of all tracks, and the interval that has begun."""
        for one in self._open.values():
            one.ended = True
        out: list[TrafficRecord] = [*self._count_ended(None), *self._intervals.flush()]
        self._past, self._last_ns = [], None
        self._latest.clear()
        return out

    def _complete_before(self, now_ns: int) -> int:
        """[ns] No crossing before this time can still be found."""
        oldest = now_ns - round(MAX_WAIT_S * NS)
        begins = [max(one.begin_ns, oldest) for one in self._open.values()]
        return min([now_ns, *begins]) - round(BEFORE_S * NS)

    def _take(self, records: Iterable[Track | SmoothedPose | Disturbance]) -> None:
        """The poses of tracks, and their ends."""
        for record in records:
            if isinstance(record, Track):
                self._take_pose(record)
            elif isinstance(record, SmoothedPose) and record.complete and record.id in self._open:
                one = self._open[record.id]
                one.begin_ns = min(one.begin_ns, record.stamp_ns)
                for path in one.smoothed:
                    path.add(record)

    def _take_pose(self, track: Track) -> None:
        """A pose of a running track, or its end."""
        if track.ended:
            if track.id in self._open:
                self._open[track.id].ended = True
            return
        if track.id not in self._open:
            self._open[track.id] = _Seen(track.stamp_ns, track.stamp_ns,
                                         [CrossingDetector(line) for line in self._lines],
                                         [CrossingDetector(line) for line in self._lines])
        one = self._open[track.id]
        one.last_ns = track.stamp_ns
        for path in one.published:
            path.add(track)

    def _count_ended(self, now_ns: int | None) -> list[VehiclePassage]:
        """The passages of tracks that have ended, as far as no earlier one can come; at None, when
        no frame comes, of all.
        """
        ended = {id: one for id, one in self._open.items() if one.ended}
        self._past += ended.values()
        for id, one in ended.items():
            del self._open[id]
            crossings = [(path.line, path.crossing()) for path in (
                smoothed if smoothed.has_pose else published
                for smoothed, published in zip(one.smoothed, one.published, strict=True))]
            self.counts['tracks that crossed no line'] += all(c is None for _, c in crossings)
            self._waiting += [_Found(c, line, id, one, self._error_of(c, one))
                              for line, c in crossings if c is not None]
        self._waiting.sort(key=lambda f: f.crossing.stamp_ns)
        n = len(self._waiting)
        if now_ns is not None:
            before = self._complete_before(now_ns)
            n = sum(f.crossing.stamp_ns < before for f in self._waiting)
            self._past = [one for one in self._past
                          if now_ns - one.last_ns < MAX_WAIT_S * NS]
        due, self._waiting = self._waiting[:n], self._waiting[n:]
        return [p for p in map(self._passage, due) if p is not None]

    def _error_of(self, crossing: Crossing, mine: _Seen) -> float:
        """Error probability of a direction by the fields; NaN where others have a part in them."""
        near = round(ALONE_S * NS)
        if any(one is not mine and one.overlaps(crossing.stamp_ns - near, crossing.stamp_ns + near)
               for one in (*self._open.values(), *self._past)):
            return float('nan')
        return self._direction.error_probability(crossing)

    def _passage(self, found: _Found) -> VehiclePassage | None:
        """The passage of a crossing; None where it has been counted."""
        crossing, pose, line = found.crossing, found.crossing.pose, found.line
        way = line.name, crossing.forward
        latest = self._latest.get(way)
        if latest is not None and _are_the_same(latest, found):
            self.counts['crossings of lost tracks, counted once'] += 1
            return None
        self._latest[way] = found
        headway = float('nan') if latest is None else \
            (crossing.stamp_ns - latest.crossing.stamp_ns) / NS
        self.counts['passages'] += 1
        doubts = tuple(name for name, is_so in (
            (AMBIGUOUS, pose.ambiguous), (CONTRADICTED, found.direction_error > MAX_ERROR),
            (EXTRAPOLATED, crossing.is_extrapolated)) if is_so)
        moving = pose.velocity[:2], pose.covariance[3:5, 3:5]
        speed, speed_std = speed_of(*moving)
        posterior = _class_of(pose, self._settings)
        passage = VehiclePassage(
            crossing.stamp_ns, self.counts['passages'], line.name, found.track_id,
            crossing.forward, found.direction_error, crossing.position,
            line.lateral(crossing.position), pose.velocity, speed, speed_std,
            heading_of(*moving)[1], pose.length, pose.length_std, pose.moment,
            pose.moment_covariance, posterior.name, posterior.probabilities,
            headway if headway >= 0.0 else float('nan'), bool(doubts), doubts)
        self._intervals.add(passage)
        return passage


def _are_the_same(one: _Found, other: _Found) -> bool:
    """Whether two crossings are of one vehicle whose track was lost near the line."""
    apart_s = abs(other.crossing.stamp_ns - one.crossing.stamp_ns) / NS
    apart_m = abs(one.line.lateral(one.crossing.position) - one.line.lateral(
        other.crossing.position))
    return ((one.crossing.is_extrapolated or other.crossing.is_extrapolated)
            and apart_s < SAME_S and apart_m < SAME_M
            and not one.track.overlaps(other.track.begin_ns, other.track.last_ns))


def _check(settings: TrafficSettings) -> None:
    """Raise SettingsError for lists that differ in length, and for names that are not usable."""
    for names, lists in (('line_names', PER_LINE), ('class_names', PER_CLASS)):
        values = getattr(settings, names)
        for name in lists:
            if len(getattr(settings, name)) != len(values):
                raise SettingsError(f'traffic.{name}: expected {len(values)} values (one per '
                                    f'{names}), got {len(getattr(settings, name))}')
        if len(set(values)) < len(values):
            raise SettingsError(f'traffic.{names}: duplicate names in {values}')
        if '' in values or UNKNOWN in values:
            raise SettingsError(f'traffic.{names}: {"" if "" in values else UNKNOWN!r} is not a '
                                'usable name')


def _is_running(record: Track | SmoothedPose | Disturbance) -> bool:
    """Whether a record is a pose of a track that goes on."""
    return isinstance(record, Track) and not record.ended


def _class_of(pose: Pose, settings: TrafficSettings) -> ClassPosterior:
    """The class of a vehicle by the size of its moment, and by its length where it has one."""
    size = float(np.linalg.norm(pose.moment))
    if not size > 0.0:
        shares = np.array(settings.class_shares)
        return ClassPosterior(UNKNOWN, shares / shares.sum())
    along = pose.moment / size
    features = [Feature(size, float(np.sqrt(along @ pose.moment_covariance @ along)),
                        settings.class_moments, settings.class_moment_spreads)]
    if pose.length > 0.0:
        features.append(Feature(pose.length, pose.length_std, settings.class_lengths,
                                settings.class_length_spreads))
    return class_posterior(settings.class_names, settings.class_shares, features)
