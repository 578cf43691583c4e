"""Traffic: count tracked vehicles that cross counting lines, and summarise intervals."""

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.event_records import Disturbance, TrafficSummary, VehiclePassage
from mag_tracking.geometry import heading_of, speed_of
from mag_tracking.inference import driving_direction
from mag_tracking.inference.driving_direction import MAX_CONFIDENCE, horizontal_field
from mag_tracking.inference.identification import UNKNOWN, ClassPosterior, Feature, class_posterior
from mag_tracking.network import SensorNetwork, counting_line
from mag_tracking.network.counting_line import CountingLine, Crossing, CrossingDetector
from mag_tracking.records import FieldFrame, SmoothedPose, Track
from mag_tracking.stages.stage import Stage
from mag_tracking.stages.traffic.intervals import TrafficIntervals
from mag_tracking.stages.traffic.settings import TrafficSettings, VehicleClass
from mag_tracking.units import NS

AMBIGUOUS, CONTRADICTED, EXTRAPOLATED = 'ambiguous', 'direction_contradicted', 'extrapolated'
"""Doubts about a passage: the track is ambiguous at the line; the rotation of the fields
contradicts the direction of the crossing; the track does not reach the line."""
MAX_DIRECTION_ERROR = 0.9
"""Error probability above which the fields contradict the direction of a crossing."""
INTERFERENCE_S, SMOOTHED_LEAD_S, MAX_WAIT_S = 2.0, 3.0, 120.0
"""[s] Time around a crossing in which another track prevents the check of its direction, maximum
lead of the smoothed poses, and maximum time that passages wait for a running track."""
REACQUIRED_S, REACQUIRED_M = 1.0, 3.0
"""[s], [m] Maximum separation in time and along the line of two crossings of one vehicle, whose
track was lost and reacquired near the line."""
TrafficRecord: TypeAlias = VehiclePassage | TrafficSummary
"""Output of the stage."""
MAX_AGE_S = 70.0
"""[s] Maximum age of stored frames; longer than any smoothed track."""
MIN_LATERAL, MAX_ALONG = 1.5, 12.0
"""[m] Minimum distance of a sensor that observes the direction from the path, and maximum distance
from the crossing to its closest point of approach."""
WINDOW_RATIO = 3.0
"""Distance that the vehicle travels in half the window, relative to that of the sensor from it."""
MIN_HALF_WINDOW_S, MAX_HALF_WINDOW_S = 0.5, 4.0
"""[s] Bounds of half the duration of the window."""
MAX_LOG_ODDS = float(np.log(MAX_CONFIDENCE / (1.0 - MAX_CONFIDENCE)))
"""Largest log odds from one sensor."""


class TrackedFrame(NamedTuple):
    """A frame, None after the last one, and the records that the tracker returned for it."""

    frame: FieldFrame | None
    records: Sequence[Track | SmoothedPose | Disturbance]


@dataclass
class _TrackHistory:
    """Published and smoothed paths of a running or ended track."""

    begin_ns: int
    last_ns: int
    published: list[CrossingDetector]
    smoothed: list[CrossingDetector]
    ended: bool = False

    def overlaps(self, begin_ns: int, end_ns: int) -> bool:
        """Whether the track existed at any time in an interval."""
        return self.begin_ns <= end_ns and begin_ns <= self.last_ns


class _PendingCrossing(NamedTuple):
    """A crossing that waits until all earlier crossings are known."""

    crossing: Crossing
    line: CountingLine
    track_id: int
    track: _TrackHistory
    direction_error: float


class Traffic(Stage[TrackedFrame, TrafficRecord]):
    """Converts tracked frames to passages and summaries.

    A vehicle is counted when its track has ended, from its smoothed poses if available. Passages
    are in chronological order, unless a track lasts longer than `MAX_WAIT_S`. Raises SettingsError
    if a class has the name of vehicles that match no class.
    """

    def __init__(self, network: SensorNetwork, settings: TrafficSettings,
                 counts_vehicles: bool = True) -> None:
        self.counts: Counter[str] = Counter()
        self._classes, names = settings.classes, [line.name for line in settings.lines]
        if any(c.name == UNKNOWN for c in settings.classes):
            raise SettingsError(f'traffic.classes.names: {UNKNOWN!r} is the name of vehicles that '
                                'match no class')
        self._lines = counting_line.counting_lines(
            names, [line.heading_deg for line in settings.lines],
            [line.offset for line in settings.lines], [line.half_width for line in settings.lines],
            network.centre) if counts_vehicles else []
        self._direction = FieldDirection(network)
        self._intervals = TrafficIntervals(names, settings.interval_s, self.counts)
        self._open: dict[int, _TrackHistory] = {}
        self._ended: list[_TrackHistory] = []
        self._pending: list[_PendingCrossing] = []
        # {(line, forward): latest crossing}
        self._latest: dict[tuple[str, bool], _PendingCrossing] = {}
        self._last_ns: int | None = None

    def feed(self, item: TrackedFrame) -> list[TrafficRecord]:
        """Add a frame and the records of the tracker; return completed passages and summaries."""
        if not self._lines:
            return []
        out: list[TrafficRecord] = []
        frame, records = item
        if frame is not None and self._last_ns is not None and frame.stamp_ns < self._last_ns:
            self.counts['time jumped back'] += 1
            self._add_records(r for r in records if not _is_running(r))
            out += self.flush()
            records = [r for r in records if _is_running(r)]
        self._add_records(records)
        if frame is None:
            return [*out, *self._count_ended(None)]
        self._last_ns = frame.stamp_ns
        self._direction.add(frame, self._complete_before(frame.stamp_ns))
        out += self._count_ended(frame.stamp_ns)
        return [*out, *self._intervals.close_until(
            self._complete_before(frame.stamp_ns), frame.stamp_ns)]

    def flush(self) -> list[TrafficRecord]:
        """End all tracks; return the remaining passages and the summary of the current interval."""
        for history in self._open.values():
            history.ended = True
        out: list[TrafficRecord] = [*self._count_ended(None), *self._intervals.flush()]
        self._ended, self._last_ns = [], None
        self._latest.clear()
        return out

    def _complete_before(self, now_ns: int) -> int:
        """Time [ns] before which no further crossing can be found."""
        oldest = now_ns - round(MAX_WAIT_S * NS)
        begin_times = [max(history.begin_ns, oldest) for history in self._open.values()]
        return min([now_ns, *begin_times]) - round(SMOOTHED_LEAD_S * NS)

    def _add_records(self, records: Iterable[Track | SmoothedPose | Disturbance]) -> None:
        """Add poses, and the smoothed poses of whole tracks, to the histories of their tracks."""
        for record in records:
            if isinstance(record, Track):
                self._add_pose(record)
            elif isinstance(record, SmoothedPose) and record.complete and record.id in self._open:
                history = self._open[record.id]
                history.begin_ns = min(history.begin_ns, record.stamp_ns)
                for path in history.smoothed:
                    path.add(record)

    def _add_pose(self, track: Track) -> None:
        """Add a pose of a running track, or mark the track as ended."""
        if track.ended:
            if track.id in self._open:
                self._open[track.id].ended = True
            return
        if track.id not in self._open:
            self._open[track.id] = _TrackHistory(track.stamp_ns, track.stamp_ns,
                                                 [CrossingDetector(line) for line in self._lines],
                                                 [CrossingDetector(line) for line in self._lines])
        history = self._open[track.id]
        history.last_ns = track.stamp_ns
        for path in history.published:
            path.add(track)

    def _count_ended(self, now_ns: int | None) -> list[VehiclePassage]:
        """Find the crossings of ended tracks; return the passages that none can precede."""
        ended = {id: track for id, track in self._open.items() if track.ended}
        self._ended += ended.values()
        for id, track in ended.items():
            del self._open[id]
            crossings = [(path.line, path.crossing()) for path in (
                smoothed if smoothed.has_pose else published
                for smoothed, published in zip(track.smoothed, track.published, strict=True))]
            self.counts['tracks that crossed no line'] += all(c is None for _, c in crossings)
            self._pending += [_PendingCrossing(c, line, id, track, self._direction_error(c, track))
                              for line, c in crossings if c is not None]
        self._pending.sort(key=lambda f: f.crossing.stamp_ns)
        n = len(self._pending)
        if now_ns is not None:
            before = self._complete_before(now_ns)
            n = sum(f.crossing.stamp_ns < before for f in self._pending)
            self._ended = [track for track in self._ended
                           if now_ns - track.last_ns < MAX_WAIT_S * NS]
        due, self._pending = self._pending[:n], self._pending[n:]
        return [p for p in map(self._passage, due) if p is not None]

    def _direction_error(self, crossing: Crossing, track: _TrackHistory) -> float:
        """Probability that the direction of a crossing is wrong; NaN if it cannot be checked."""
        margin_ns = round(INTERFERENCE_S * NS)
        if any(other is not track
               and other.overlaps(crossing.stamp_ns - margin_ns, crossing.stamp_ns + margin_ns)
               for other in (*self._open.values(), *self._ended)):
            return float('nan')
        return self._direction.error_probability(crossing)

    def _passage(self, pending: _PendingCrossing) -> VehiclePassage | None:
        """Create and count the passage of a crossing; None if the vehicle was already counted."""
        crossing, pose, line = pending.crossing, pending.crossing.pose, pending.line
        direction = line.name, crossing.forward
        latest = self._latest.get(direction)
        if latest is not None and _are_same_vehicle(latest, pending):
            self.counts['repeated crossings after a lost track'] += 1
            return None
        self._latest[direction] = pending
        headway = float('nan') if latest is None else \
            (crossing.stamp_ns - latest.crossing.stamp_ns) / NS
        self.counts['passages'] += 1
        doubts = tuple(name for name, applies in (
            (AMBIGUOUS, pose.ambiguous),
            (CONTRADICTED, pending.direction_error > MAX_DIRECTION_ERROR),
            (EXTRAPOLATED, crossing.is_extrapolated)) if applies)
        velocity_estimate = pose.velocity[:2], pose.covariance[3:5, 3:5]
        speed, speed_std = speed_of(*velocity_estimate)
        posterior = _class_of(pose, self._classes)
        passage = VehiclePassage(
            crossing.stamp_ns, self.counts['passages'], line.name, pending.track_id,
            crossing.forward, pending.direction_error, crossing.position,
            line.lateral_offset(crossing.position), pose.velocity, speed, speed_std,
            heading_of(*velocity_estimate)[1], pose.length, pose.length_std, pose.moment,
            pose.moment_covariance, posterior.name, posterior.probabilities,
            headway if headway >= 0.0 else float('nan'), bool(doubts), doubts)
        self._intervals.add(passage)
        return passage


def _are_same_vehicle(one: _PendingCrossing, other: _PendingCrossing) -> bool:
    """Whether two crossings belong to one vehicle whose track was lost near the line."""
    separation_s = abs(other.crossing.stamp_ns - one.crossing.stamp_ns) / NS
    separation_m = abs(one.line.lateral_offset(one.crossing.position)
                       - one.line.lateral_offset(other.crossing.position))
    return ((one.crossing.is_extrapolated or other.crossing.is_extrapolated)
            and separation_s < REACQUIRED_S and separation_m < REACQUIRED_M
            and not one.track.overlaps(other.track.begin_ns, other.track.last_ns))


def _is_running(record: Track | SmoothedPose | Disturbance) -> bool:
    """Whether a record is a pose of a running track."""
    return isinstance(record, Track) and not record.ended


def _class_of(pose: counting_line.Pose, classes: Sequence[VehicleClass]) -> ClassPosterior:
    """Class of a vehicle by the magnitude of its moment, and by its length if available."""
    magnitude, shares = float(np.linalg.norm(pose.moment)), [c.share for c in classes]
    if not magnitude > 0.0:
        prior = np.array(shares)
        return ClassPosterior(UNKNOWN, prior / prior.sum())
    along = pose.moment / magnitude
    features = [Feature(magnitude, float(np.sqrt(along @ pose.moment_covariance @ along)),
                        [c.moment for c in classes], [c.moment_spread for c in classes])]
    if pose.length > 0.0:
        features.append(Feature(pose.length, pose.length_std, [c.length for c in classes],
                                [c.length_spread for c in classes]))
    return class_posterior([c.name for c in classes], shares, features)


class FieldDirection:
    """Estimates, from the latest frames, the probability that a crossing direction is wrong."""

    def __init__(self, network: SensorNetwork) -> None:
        self._network = network
        self._frames: deque[FieldFrame] = deque()

    def add(self, frame: FieldFrame, since_ns: int) -> None:
        """Store a frame; drop frames not needed from `since_ns` on, and all after a jump back."""
        if self._frames and frame.stamp_ns <= self._frames[-1].stamp_ns:
            self._frames.clear()
        self._frames.append(frame)
        oldest = max(since_ns - round(MAX_HALF_WINDOW_S * NS),
                     frame.stamp_ns - round(MAX_AGE_S * NS))
        while self._frames[0].stamp_ns < oldest:
            self._frames.popleft()

    def error_probability(self, crossing: Crossing) -> float:
        """Probability that a direction is wrong; NaN if unknown or contradictory."""
        velocity = crossing.pose.velocity[:2]
        speed = float(np.hypot(*velocity))
        if not self._frames or speed < 0.1:
            return float('nan')
        u = velocity / speed
        r = self._network.positions[:, :2] - crossing.position[:2]
        along, left = r @ u, u[0] * r[:, 1] - u[1] * r[:, 0]
        odds, same_side = [], []
        for j in np.flatnonzero(
                (np.abs(left) >= MIN_LATERAL) & (np.abs(along) <= MAX_ALONG)).tolist():
            half_window_s = np.clip(WINDOW_RATIO * abs(left[j]) / speed,
                                    MIN_HALF_WINDOW_S, MAX_HALF_WINDOW_S)
            log_odds = self._log_odds(j, crossing.stamp_ns + round(along[j] / speed * NS),
                                      round(half_window_s * NS))
            if log_odds is not None:
                odds.append(float(np.clip(log_odds, -MAX_LOG_ODDS, MAX_LOG_ODDS)))
                # From a sensor to the left of the path, the vehicle moves from right to left.
                same_side.append(bool(left[j] < 0.0))
        fused = driving_direction.fused_log_odds(odds, same_side)
        if not odds or len(odds) > 1 and abs(fused) < 0.5 * max(map(abs, odds)):
            return float('nan')
        return float(1.0 / (1.0 + np.exp(fused)))

    def _log_odds(self, j: int, middle_ns: int, half_ns: int) -> float | None:
        """Log odds of motion from left to right as seen from sensor `j`; None if unobservable."""
        frames = [f for f in self._frames if abs(f.stamp_ns - middle_ns) <= half_ns]
        field = horizontal_field(np.array([f.field[j] for f in frames]).reshape(-1, 3),
                                 self._network.R_ws[j])
        is_measured = ~np.isnan(field).any(axis=1)
        if not is_measured.any():
            return None
        variance = [np.nanmean(np.diagonal(frames[k].covariance[j]))
                    for k in np.flatnonzero(is_measured).tolist()]
        noise = float(np.sqrt(np.median(variance)))
        rotation = driving_direction.rotation_of_pass(field[is_measured], noise, len(frames) // 4)
        return None if rotation is None else rotation.log_odds
