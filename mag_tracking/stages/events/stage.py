"""Events: detect and describe the passes of targets at individual sensors."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.background import RelearntBackground, RunningBackground
from mag_tracking.event_records import SIGNATURE_SPAN, PassEvent
from mag_tracking.inference import driving_direction
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.passes import anderson_residual
from mag_tracking.records import Detection, FieldFrame, Readings, plain
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.events.stays import Stays
from mag_tracking.stages.settings import AlignSettings, DetectSettings
from mag_tracking.stages.stage import Stage
from mag_tracking.stages.track.plausibility import SampleRates
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NEVER, NS

PAD_S = 1.0
"""[s] Length of the margins without a target, before the onset and after the release."""
MAX_DURATION_S = 120.0
"""[s] Maximum duration of an event; only the latest readings of a longer detection are used."""
SIGNATURE_POINTS = 33
"""Number of points of a signature."""
MAX_SAMPLES, MIN_SAMPLES, MAX_STARTS = 200, 8, 5
"""Maximum number of samples (blocks of a longer pass are averaged) and minimum number of samples in
a fit, and number of starts of its search, which has several minima with one axis."""
CORRELATION_TIME, CENTRE_OFFSET = 2.0, 0.15
"""[time scales] Correlation time of the residual when a dipole is fitted to a vehicle, and typical
distance of its magnetic centre from the middle of its body."""


class Events(Stage[Readings, PassEvent]):
    """Converts calibrated readings to pass events, one for each detection at each sensor, without
    lengths, which one sensor does not observe; track settings give the rate that resolves a
    pass."""

    def __init__(self, network: SensorNetwork, align: AlignSettings, detect: DetectSettings,
                 track: TrackSettings) -> None:
        self.counts: Counter[str] = Counter()
        rates = SampleRates(network, track)
        self._index = {name: j for j, name in enumerate(network.names)}
        parts = [network.part(np.array([j])) for j in range(len(network))]
        self._sensors = [_SensorEvents(j, part, align, detect, rates, self.counts)
                         for j, part in enumerate(parts)]

    def set_relearnt(self, backgrounds: Mapping[str, RunningBackground]) -> None:
        """Set the changes of each sensor's background, without which the event of a parked vehicle
        ends when its field has become the background."""
        for name, background in backgrounds.items():
            self._sensors[self._index[name]].relearnt = background.relearnt

    def feed(self, readings: Readings) -> list[PassEvent]:
        """Add calibrated readings, and return the completed events."""
        rows = readings.rows(self._index)
        out: list[PassEvent] = []
        for j in np.unique(rows[rows >= 0]).tolist():
            out += self._sensors[j].feed(readings.part(rows == j))
        return out

    def flush(self) -> list[PassEvent]:
        """Return the events that are still in progress at the end of the input."""
        return [event for s in self._sensors for event in s.flush()]


class _SensorEvents:
    """Detects the passes of targets at one sensor, and creates an event for each pass."""

    def __init__(self, j: int, network: SensorNetwork, align: AlignSettings,
                 detect: DetectSettings, rates: SampleRates, counts: 'Counter[str]') -> None:
        self._j, self._rates = j, rates
        self._name, self._R_ws = network.names[0], network.R_ws[0]
        self._network, self._settings = network, (align, detect)
        self._hold_ns, self._counts = int(detect.hold_s * NS), counts
        earth_field = network.earth_field
        self._n, self._stays = 0, Stays(
            np.full(3, np.nan) if earth_field is None else network.R_sw[0] @ earth_field)
        self.relearnt: Sequence[RelearntBackground] = ()
        self._reset()

    def _reset(self) -> None:
        """Drop all readings and restart the detection."""
        self._align = Align(self._network, self._settings[0])
        self._detect = Detect(self._network, self._settings[1])
        self._buffer: deque[Readings] = deque()
        self._onset_ns: int | None = None
        self._frame_stamps: deque[int] = deque(maxlen=self._settings[1].onset_frames)

    def feed(self, readings: Readings) -> list[PassEvent]:
        """Add readings of this sensor and return the completed events."""
        last = self._buffer[-1].stamp_ns[-1:] if self._buffer else readings.stamp_ns[:0]
        jumps_back = np.flatnonzero(np.diff(np.concatenate([last, readings.stamp_ns])) < 0)
        first, out = 0, []
        for k in (jumps_back + 1 - len(last)).tolist():
            # In a looped recording, the buffered readings belong to the previous loop.
            out += [*self._feed_chronological(readings.part(slice(first, k))), *self.flush()]
            self._reset()
            first = k
        return out + self._feed_chronological(readings.part(slice(first, None)))

    def _feed_chronological(self, readings: Readings) -> list[PassEvent]:
        """Add readings in chronological order and return the completed events."""
        if not len(readings):
            return []
        self._buffer.append(readings)
        if self._stays.first_ns == NEVER:
            self._stays.first_ns = int(readings.stamp_ns[0])
        out: list[PassEvent] = []
        for frame in self._align.feed(readings):
            self._rates.add(frame, self._j)
            self._frame_stamps.append(frame.stamp_ns)
            out += self._detected(frame)
            begin = frame.stamp_ns if self._onset_ns is None else \
                max(self._onset_ns, frame.stamp_ns - int(MAX_DURATION_S * NS))
            while self._buffer[0].stamp_ns[-1] < begin - (2 * PAD_S * NS + self._hold_ns):
                self._buffer.popleft()
        return out

    def flush(self) -> list[PassEvent]:
        """Return the events that are still in progress at the end of the input."""
        out = [event for frame in self._align.flush() for event in self._detected(frame)]
        if self._buffer:
            last_ns = int(self._buffer[-1].stamp_ns[-1])
            if self._onset_ns is not None:
                out += self._event(last_ns, False)
            out += self._numbered(self._stays.flush(last_ns))
        self._onset_ns = None
        return out

    def _detected(self, frame: FieldFrame) -> list[PassEvent]:
        """Store the time of an onset in a frame, or return the event that a release completes."""
        out: list[PassEvent] = []
        for record in self._detect.feed(frame):
            if isinstance(record, Detection) and record.onset:
                # The frames that confirm a detection take long at a low rate.
                self._onset_ns = self._frame_stamps[0] if self._is_slow else record.stamp_ns
            elif isinstance(record, Detection):
                out += self._event(record.stamp_ns - self._hold_ns, True)
        return out

    def _event(self, release_ns: int, ended: bool) -> list[PassEvent]:
        """Return a list with the event that ends at `release_ns`; empty without finite readings."""
        onset_ns, self._onset_ns = self._onset_ns, None
        assert onset_ns is not None
        readings = Readings.joined(self._buffer)
        margin_ns = int(PAD_S * NS)
        begin_ns = max(onset_ns, release_ns - int(MAX_DURATION_S * NS)) - margin_ns
        readings = readings.part((begin_ns <= readings.stamp_ns)
                                 & (readings.stamp_ns <= release_ns + margin_ns))
        if not len(readings) or np.isnan(readings.field).all():
            return []
        event = self._describe(readings, onset_ns, max(release_ns, onset_ns), ended)
        return self._numbered(self._stays.add(event, readings, self.relearnt))

    def _numbered(self, events: list[PassEvent]) -> list[PassEvent]:
        """Count and number completed events."""
        first, self._n = self._n + 1, self._n + len(events)
        self._counts['events'] += len(events)
        return [replace(event, number=first + k) for k, event in enumerate(events)]

    @property
    def _is_slow(self) -> bool:
        """Whether the rate of the sensor is too low to show passes."""
        return bool(self._rates.are_slow()[self._j])

    def _describe(self, readings: Readings, onset_ns: int, release_ns: int,
                  ended: bool) -> PassEvent:
        """Create the event record from the readings around a detection."""
        stamp, field = readings.stamp_ns, readings.field
        t = (stamp - onset_ns) / NS
        noise = _median_noise(readings)
        squared_field = np.nansum(field**2, axis=1)
        peak = int(np.argmax(squared_field))
        is_detected = (onset_ns <= stamp) & (stamp <= release_ns)
        interval_s = float(np.median(np.diff(stamp))) / NS if len(stamp) > 1 else 0.0
        present = ~np.all(np.isnan(field), axis=0)
        closest, left_to_right = ClosestPoint((int(stamp[peak]) - onset_ns) / NS, np.inf, np.nan), \
            0.5
        # A slow sensor, or the end of a long stay, does not show a pass.
        if not self._is_slow and release_ns - onset_ns <= MAX_DURATION_S * NS:
            closest = closest_point(t, field, noise)
            horizontal = driving_direction.horizontal_field(field, self._R_ws)
            is_complete = ~np.isnan(horizontal).any(axis=1)
            rotation = driving_direction.rotation_of_pass(
                horizontal[is_complete], float(np.nanmean(noise)) if is_complete.any() else 0.0,
                int(np.count_nonzero(stamp < onset_ns)))
            if rotation is not None:
                limit = driving_direction.MAX_CONFIDENCE
                left_to_right = float(np.clip(rotation.left_to_right, 1.0 - limit, limit))
        return PassEvent(
            self._name, 0, ended, onset_ns, release_ns, int(stamp[peak]), field[peak],
            float(np.sum(squared_field[is_detected]) * interval_s),
            ''.join(np.array(list('xyz'))[present]), noise,
            onset_ns + int(round(closest.time * NS)), closest.time_std, closest.time_scale,
            left_to_right, _signature(t, field, closest.time, closest.time_scale))


def _median_noise(readings: Readings) -> FloatArray:
    """Median noise standard deviation (3,) [T] of the readings; NaN for a missing axis."""
    out: FloatArray = np.full(3, np.nan)
    if readings.covariance is not None:
        variance = np.einsum('kii->ki', readings.covariance)
        for a in np.flatnonzero(~np.isnan(readings.field).all(axis=0)).tolist():
            out[a] = np.sqrt(np.nanmedian(variance[:, a]))
    return out


def _signature(t: FloatArray, field: FloatArray, time: float, scale: float) -> FloatArray:
    """Field (`SIGNATURE_POINTS`, 3) [T] at equidistant times around `time`, proportional to
    `scale`; NaN outside the readings, or if `scale` is not finite."""
    out = np.full((SIGNATURE_POINTS, 3), np.nan)
    if not np.isfinite(scale):
        return out
    times = time + scale * np.linspace(-SIGNATURE_SPAN, SIGNATURE_SPAN, SIGNATURE_POINTS)
    for a in range(3):
        is_measured = ~np.isnan(field[:, a])
        if is_measured.any():
            out[:, a] = np.interp(times, t[is_measured], field[is_measured, a], left=np.nan,
                                  right=np.nan)
    return out


class ClosestPoint(NamedTuple):
    """Closest point of approach of a pass, estimated from one sensor."""

    time: float
    """[s] Time of the closest point; if not observable, of the largest field, or NaN."""
    time_std: float
    """[s] Standard deviation of `time`; inf if the closest point is not observable."""
    time_scale: float
    """[s] Range at the closest point divided by the speed; NaN if not observable."""


def closest_point(t: FloatArray, field: FloatArray, noise_std: FloatArray) -> ClosestPoint:
    """Fit the Anderson functions of a dipole on a straight line to the field (n, 3) of one sensor.

    One axis is sufficient; a missing axis is NaN. `noise_std` (3,) [T] is the noise of one reading.
    Three coefficients and a constant per axis are solved for each candidate time and time scale.
    See [TSP14]_ eq. (22), (23), with the exponent 5/2.
    """
    present = ~np.isnan(field).all(axis=0) & ~np.isnan(noise_std)
    complete = ~np.isnan(field[:, present]).any(axis=1)
    if np.count_nonzero(complete) < MIN_SAMPLES:
        strongest = float(t[np.argmax(np.nansum(field**2, axis=1))]) if len(t) else np.nan
        return ClosestPoint(strongest, np.inf, np.nan)
    t, y = _averaged(t[complete], field[complete][:, present] / noise_std[present])
    t, y = plain(t), plain(y)
    span = float(t[-1] - t[0])
    strongest = float(t[np.argmax(np.sum(y**2, axis=1))])
    if not span > 0.0:
        return ClosestPoint(strongest, np.inf, np.nan)
    interval = span / (len(t) - 1)

    def cost(time: float, scale: float) -> float:
        return anderson_residual(t, y, time, scale)

    starts = sorted((cost(time, scale), time, scale)
                    for scale in np.geomspace(1.5 * interval, span, 24).tolist()
                    for time in np.arange(t[0], t[-1], max(0.3 * scale, interval)).tolist())

    def cost_of(x: FloatArray) -> float:
        return cost(float(x[0]), float(np.exp(x[1])))

    best = min((minimize(cost_of, np.array([time, np.log(scale)]), method='Nelder-Mead', options={
        'xatol': 1e-4 * interval, 'fatol': 1e-9 * (1.0 + at_start), 'maxiter': 200})
        for at_start, time, scale in starts[:MAX_STARTS]), key=lambda result: float(result.fun))
    time, scale = float(best.x[0]), float(np.exp(best.x[1]))
    # The residual of a vehicle is larger than noise, so the variance is estimated from it.
    residual_variance = max(best.fun / max(y.size - 4 * y.shape[1] - 2, 1), 0.0)
    n_correlated = max(1.0, CORRELATION_TIME * scale / interval)
    step = 0.05 * scale
    curvature = (cost(time + step, scale) + cost(time - step, scale) - 2.0 * best.fun) / step**2
    std = np.sqrt(2.0 * residual_variance * n_correlated / curvature) \
        if curvature > 0.0 else np.inf
    if not (t[0] <= time <= t[-1] and scale <= span and np.isfinite(std)):
        return ClosestPoint(strongest, np.inf, np.nan)
    return ClosestPoint(time, float(np.hypot(std, CENTRE_OFFSET * scale)), scale)


def _averaged(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average samples in at most `MAX_SAMPLES` equal blocks; drop an incomplete last block."""
    n = -(-len(t) // MAX_SAMPLES) or 1
    k = len(t) // n
    return t[:k * n].reshape(k, n).mean(axis=1), y[:k * n].reshape(k, n, -1).mean(axis=1)
