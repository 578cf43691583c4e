"""Events: passes described by each sensor alone, from its calibrated readings."""

from collections import Counter, deque

import numpy as np

from mag_tracking.arrays import FloatArray, IntArray
from mag_tracking.event_records import SIGNATURE_SPAN, PassEvent
from mag_tracking.inference.driving_direction import (
    MAX_CONFIDENCE,
    horizontal_field,
    rotation_of_pass,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Detection, Readings
from mag_tracking.stages.align.settings import AlignSettings
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.detect.settings import DetectSettings
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.events.single_sensor_pass import closest_point
from mag_tracking.units import NS

PAD_S = 1.0
"""[s] Before an onset and after the last loud frame, where the sensor is without the target."""

MAX_S = 120.0
"""[s] Of a longer detection, the latest readings are described."""

SIGNATURE_POINTS = 33
"""Points of a signature."""


class Events:
    """Calibrated `Readings` to `PassEvent`s, one for each detection by each sensor.

    Those that one batch completes come sensor by sensor. Nothing is in metres: a single sensor
    cannot observe the scale.
    """

    def __init__(self, network: SensorNetwork, align: AlignSettings,
                 detect: DetectSettings) -> None:
        self.counts: Counter[str] = Counter()
        self._index = {name: j for j, name in enumerate(network.names)}
        parts = [network.part(np.array([j])) for j in range(len(network))]
        self._sensors = [_SensorEvents(part, align, detect, self.counts) for part in parts]

    def feed(self, readings: Readings) -> list[PassEvent]:
        """Calibrated `Readings` give the events that they complete."""
        rows = readings.rows(self._index)
        out: list[PassEvent] = []
        for j in np.unique(rows[rows >= 0]).tolist():
            out += self._sensors[j].feed(readings.part(rows == j))
        return out

    def idle(self) -> None:
        """Nothing waits."""

    def flush(self) -> list[PassEvent]:
        """The events that have not ended."""
        return [event for s in self._sensors for event in s.flush()]


class _SensorEvents:
    """The events of one sensor."""

    def __init__(self, network: SensorNetwork, align: AlignSettings, detect: DetectSettings,
                 counts: 'Counter[str]') -> None:
        self._name, self._R_ws = network.names[0], network.R_ws[0]
        self._network, self._settings = network, (align, detect)
        self._hold_ns, self._counts = int(detect.hold_s * NS), counts
        self._n = 0
        self._begin()

    def _begin(self) -> None:
        """Start without any reading."""
        self._align = Align(self._network, self._settings[0])
        self._detect = Detect(self._network, self._settings[1])
        self._kept: deque[Readings] = deque()
        self._onset_ns: int | None = None

    def feed(self, readings: Readings) -> list[PassEvent]:
        """Readings of this sensor give the events that they complete."""
        last = self._kept[-1].stamp_ns[-1:] if self._kept else readings.stamp_ns[:0]
        back = np.flatnonzero(np.diff(np.concatenate([last, readings.stamp_ns])) < 0)
        first, out = 0, []
        for k in (back + 1 - len(last)).tolist():
            # A looped recording: what was kept is of another time.
            out += [*self._feed(readings.part(slice(first, k))), *self.flush()]
            self._begin()
            first = k
        return out + self._feed(readings.part(slice(first, None)))

    def _feed(self, readings: Readings) -> list[PassEvent]:
        """`feed` of readings in order of time."""
        if not len(readings):
            return []
        self._kept.append(readings)
        out: list[PassEvent] = []
        for frame in self._align.feed(readings):
            for record in self._detect.feed(frame):
                if isinstance(record, Detection):
                    out += self._at(record)
            begin = frame.stamp_ns if self._onset_ns is None else \
                max(self._onset_ns, frame.stamp_ns - int(MAX_S * NS))
            while self._kept[0].stamp_ns[-1] < begin - (2 * PAD_S * NS + self._hold_ns):
                self._kept.popleft()
        return out

    def flush(self) -> list[PassEvent]:
        """The event that has not ended."""
        out: list[PassEvent] = []
        for frame in self._align.flush():
            for record in self._detect.feed(frame):
                if isinstance(record, Detection):
                    out += self._at(record)
        if self._onset_ns is not None and self._kept:
            out += self._event(int(self._kept[-1].stamp_ns[-1]), False)
        self._onset_ns = None
        return out

    def _at(self, detection: Detection) -> list[PassEvent]:
        """An onset, or the event that a release completes."""
        if detection.onset:
            self._onset_ns = detection.stamp_ns
            return []
        return self._event(detection.stamp_ns - self._hold_ns, True)

    def _event(self, release_ns: int, ended: bool) -> list[PassEvent]:
        """The event from the onset until `release_ns`, or none without readings."""
        onset_ns, self._onset_ns = self._onset_ns, None
        assert onset_ns is not None
        readings = Readings.joined(self._kept)
        pad = int(PAD_S * NS)
        begin_ns = max(onset_ns, release_ns - int(MAX_S * NS)) - pad
        readings = readings.part((begin_ns <= readings.stamp_ns)
                                 & (readings.stamp_ns <= release_ns + pad))
        if not len(readings) or np.isnan(readings.field).all():
            return []
        self._n += 1
        self._counts['events'] += 1
        return [self._described(readings, onset_ns, max(release_ns, onset_ns), ended)]

    def _described(self, readings: Readings, onset_ns: int, release_ns: int,
                   ended: bool) -> PassEvent:
        """The `PassEvent` of the readings around a detection."""
        stamp, field = readings.stamp_ns, readings.field
        t = (stamp - onset_ns) / NS
        noise = _noise_of(readings)
        size = np.nansum(field**2, axis=1)
        peak = int(np.argmax(size))
        inside = (onset_ns <= stamp) & (stamp <= release_ns)
        there = ~np.all(np.isnan(field), axis=0)
        closest = closest_point(t, field, noise)
        horizontal = horizontal_field(field, self._R_ws)
        known = ~np.isnan(horizontal).any(axis=1)
        left = _left_to_right(horizontal[known], float(np.nanmean(noise)) if known.any() else 0.0,
                              int(np.count_nonzero(stamp < onset_ns)))
        return PassEvent(
            self._name, self._n, ended, onset_ns, release_ns, int(stamp[peak]), field[peak],
            float(np.sum(size[inside]) * _interval(stamp)),
            ''.join(np.array(list('xyz'))[there]), noise,
            onset_ns + int(round(closest.time * NS)), closest.time_std, closest.time_scale, left,
            _signature(t, field, closest.time, closest.time_scale))


def _left_to_right(horizontal: FloatArray, noise_std: float, n_quiet: int) -> float:
    """Probability of a target that moves from left to right; 0.5 where the field does not tell."""
    found = rotation_of_pass(horizontal, noise_std, n_quiet)
    if found is None:
        return 0.5
    return float(np.clip(found.left_to_right, 1.0 - MAX_CONFIDENCE, MAX_CONFIDENCE))


def _noise_of(readings: Readings) -> FloatArray:
    """(3,) [T] median noise of the readings; NaN of an axis that none has."""
    out: FloatArray = np.full(3, np.nan)
    if readings.covariance is not None:
        variance = np.einsum('kii->ki', readings.covariance)
        for a in np.flatnonzero(~np.isnan(readings.field).all(axis=0)).tolist():
            out[a] = np.sqrt(np.nanmedian(variance[:, a]))
    return out


def _interval(stamp: IntArray) -> float:
    """[s] Usual time between readings."""
    return float(np.median(np.diff(stamp))) / NS if len(stamp) > 1 else 0.0


def _signature(t: FloatArray, field: FloatArray, time: float, scale: float) -> FloatArray:
    """(`SIGNATURE_POINTS`, 3) [T] field over time in units of the time scale; NaN outside."""
    if not np.isfinite(scale):
        return np.full((SIGNATURE_POINTS, 3), np.nan)
    at = time + scale * np.linspace(-SIGNATURE_SPAN, SIGNATURE_SPAN, SIGNATURE_POINTS)
    out = np.full((SIGNATURE_POINTS, 3), np.nan)
    for a in range(3):
        known = ~np.isnan(field[:, a])
        if known.any():
            out[:, a] = np.interp(at, t[known], field[known, a], left=np.nan, right=np.nan)
    return out
