"""Vehicles that cross counting lines, from their tracks; and summaries of intervals."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.event_records import Disturbance, TrafficSummary, VehiclePassage
from mag_tracking.geometry import heading_of, speed_of
from mag_tracking.inference.log_normal_classes import ClassPosterior, Feature, class_posterior
from mag_tracking.network import SensorNetwork
from mag_tracking.network.counting_line import Crossing, Line, LinePath, Pose, lines_of
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.report.traffic_intervals import Intervals
from mag_tracking.stages.traffic.field_direction import FieldDirection
from mag_tracking.stages.traffic.settings import PER_CLASS, PER_LINE, TrafficSettings
from mag_tracking.units import NS

AMBIGUOUS, CONTRADICTED, EXTRAPOLATED = 'ambiguous', 'direction_contradicted', 'extrapolated'
"""Doubts of a passage: its track is ambiguous at the line; the fields rotate the other way; the
track does not reach the line."""

MOST_ERROR = 0.9
"""A direction that is wrong with this probability by the fields is doubtful."""

ALONE_S = 2.0
"""[s] Another vehicle that is tracked within this time of a crossing has a part in the fields."""

SAME_S = 1.0
"""[s] An extrapolated crossing this close to another one in the same direction is the same one:
its track was lost and begun again."""

TrafficRecord: TypeAlias = VehiclePassage | TrafficSummary


class TrackedFrame(NamedTuple):
    """A frame, and the tracker's records of it; without one: of tracks that end together."""

    frame: FieldFrame | None
    records: Sequence[Track | SmoothedPose | Disturbance]


@dataclass
class _Open:
    """A track whose passages are not complete."""

    begin_ns: int
    last_ns: int
    published: list[LinePath]
    smoothed: list[LinePath]
    ended: bool = False


@dataclass(frozen=True)
class _Found:
    """A crossing that waits for earlier ones."""

    crossing: Crossing
    line: Line
    track_id: int
    direction_error: float


class Traffic:
    """`TrackedFrame`s to passages and summaries.

    A track is counted when it has ended, by its smoothed poses where there are any. Passages come
    in order of time.
    """

    def __init__(self, network: SensorNetwork, settings: TrafficSettings,
                 is_of_vehicles: bool = True) -> None:
        """Without vehicles nothing is counted.

        Raises SettingsError where lists that belong together differ in length.
        """
        for names, lists in (('line_names', PER_LINE), ('class_names', PER_CLASS)):
            n = len(getattr(settings, names))
            for name in lists:
                if len(getattr(settings, name)) != n:
                    raise SettingsError(f'traffic.{name}: expected {n} values (one per {names}), '
                                        f'got {len(getattr(settings, name))}')
            if len(set(getattr(settings, names))) < n:
                raise SettingsError(f'traffic.{names}: a name is there twice in '
                                    f'{getattr(settings, names)}')
        self.counts: Counter[str] = Counter()
        self._settings = settings
        self._lines = lines_of(settings.line_names, settings.line_headings_deg,
                               settings.line_offsets, settings.line_half_widths,
                               network.centre) if is_of_vehicles else []
        self._direction = FieldDirection(network)
        self._intervals = Intervals(settings.line_names, settings.interval_s)
        self._open: dict[int, _Open] = {}
        self._found: list[_Found] = []
        # {(line, forward): when the latest vehicle crossed}
        self._latest: dict[tuple[str, bool], int] = {}
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
            self._latest.clear()
            records = [r for r in records if _is_running(r)]
        self._take(records)
        if frame is None:
            return [*out, *self._count_ended()]
        self._direction.remember(frame)
        self._last_ns = frame.stamp_ns
        out += self._count_ended()
        before_ns = min([frame.stamp_ns, *(one.begin_ns for one in self._open.values())])
        return [*out, *self._intervals.due(before_ns, frame.stamp_ns)]

    def idle(self) -> None:
        """Nothing waits."""

    def flush(self) -> list[TrafficRecord]:
        """The passages of all tracks, and the interval that has begun."""
        for one in self._open.values():
            one.ended = True
        if self._last_ns is None:
            return []
        out: list[TrafficRecord] = [*self._count_ended()]
        self._last_ns = None
        return [*out, *self._intervals.flush()]

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
            self._open[track.id] = _Open(track.stamp_ns, track.stamp_ns,
                                         [LinePath(line) for line in self._lines],
                                         [LinePath(line) for line in self._lines])
        one = self._open[track.id]
        one.last_ns = track.stamp_ns
        for path in one.published:
            path.add(track)

    def _count_ended(self) -> list[VehiclePassage]:
        """The passages of tracks that have ended, as far as no earlier one can come."""
        for id in [id for id, one in self._open.items() if one.ended]:
            one = self._open[id]
            crossings = [(path.line, path.crossing()) for path in (
                smoothed if smoothed.is_begun else published
                for smoothed, published in zip(one.smoothed, one.published, strict=True))]
            self.counts['tracks that crossed no line'] += all(c is None for _, c in crossings)
            self._found += [_Found(c, line, id, self._error_of(c, id))
                            for line, c in crossings if c is not None]
            del self._open[id]
        earliest = min((one.begin_ns for one in self._open.values()), default=None)
        self._found.sort(key=lambda f: f.crossing.stamp_ns)
        n = sum(earliest is None or f.crossing.stamp_ns < earliest for f in self._found)
        due, self._found = self._found[:n], self._found[n:]
        return [p for p in map(self._passage, due) if p is not None]

    def _error_of(self, crossing: Crossing, id: int) -> float:
        """Error probability of a direction by the fields; NaN where others have a part in them."""
        near = round(ALONE_S * NS)
        for other, one in self._open.items():
            if other != id and one.begin_ns - near < crossing.stamp_ns < one.last_ns + near:
                return float('nan')
        return self._direction.error_probability(crossing)

    def _passage(self, found: _Found) -> VehiclePassage | None:
        """The passage of a crossing; None where it has been counted."""
        crossing, pose, line = found.crossing, found.crossing.pose, found.line
        way = line.name, crossing.forward
        latest = self._latest.get(way)
        headway = float('nan') if latest is None else (crossing.stamp_ns - latest) / NS
        if crossing.is_extrapolated and headway < SAME_S:
            self.counts['crossings of lost tracks, counted once'] += 1
            return None
        self._latest[way] = crossing.stamp_ns
        self.counts['passages'] += 1
        doubts = tuple(name for name, is_so in (
            (AMBIGUOUS, pose.ambiguous), (CONTRADICTED, found.direction_error > MOST_ERROR),
            (EXTRAPOLATED, crossing.is_extrapolated)) if is_so)
        moving = pose.velocity[:2], pose.covariance[3:5, 3:5]
        speed, speed_std = speed_of(*moving)
        posterior = _class_of(pose, self._settings)
        passage = VehiclePassage(
            crossing.stamp_ns, self.counts['passages'], line.name, found.track_id,
            crossing.forward, found.direction_error, crossing.position,
            line.lateral(crossing.position), pose.velocity, speed, speed_std,
            heading_of(*moving)[1], pose.length, pose.length_std, pose.moment,
            pose.moment_covariance, posterior.name, posterior.probabilities, headway, bool(doubts),
            doubts)
        self._intervals.add(passage)
        return passage


def _is_running(record: Track | SmoothedPose | Disturbance) -> bool:
    """Whether a record is a pose of a track that goes on."""
    return isinstance(record, Track) and not record.ended


def _class_of(pose: Pose, settings: TrafficSettings) -> ClassPosterior:
    """The class of a vehicle by the size of its moment, and by its length where it has one."""
    size = float(np.linalg.norm(pose.moment))
    along = pose.moment / size
    features = [Feature(size, float(np.sqrt(along @ pose.moment_covariance @ along)),
                        settings.class_moments, settings.class_moment_spreads)]
    if pose.length > 0.0:
        features.append(Feature(pose.length, pose.length_std, settings.class_lengths,
                                settings.class_length_spreads))
    return class_posterior(settings.class_names, settings.class_shares, features)
