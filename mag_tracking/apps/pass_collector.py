"""Extraction of passes: the measurements of a network around each detection."""

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.apps.no_detection import no_detection_reason
from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.doubtful_times import DOUBTFUL_BACKGROUND, are_doubtful
from mag_tracking.calibration.saturation import saturated_readings, with_margin
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.records import Detection, FieldFrame, Readings
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.stage import rejected
from mag_tracking.stages.track.doubts import MEANINGS
from mag_tracking.units import NS

PAD_S = 1.0
"""Duration of the background included before the onset of a detection [s]."""
MAX_PLATEAU_S = 0.5
"""Maximum time for which a target that passes saturates a sensor [s]."""
MAX_PASS_S = 60.0
"""Maximum duration of a pass; a longer detection is truncated [s]."""


class PassCollector:
    """Extracts passes from readings, each with notes for the user.

    A pass contains all measurements from `PAD_S` before the onset of a detection to its release.
    `on_frame` is called with every frame that the detection stage has processed.
    """

    def __init__(self, network: SensorNetwork, settings: Settings,
                 on_frame: Callable[[FieldFrame], object] | None = None) -> None:
        self._network, self._settings, self._on_frame = network, settings, on_frame
        self._max_field = settings.calibrate.max_field
        self._stages = (Calibrate(network, settings.calibrate, survey=settings.survey),
                        Align(network, settings.align), Detect(network, settings.detect))
        # Raw and calibrated readings, in network time, from `PAD_S` before the onset or, without a
        # detection, before the latest frame.
        self._raw: deque[Readings] = deque()
        self._calibrated: deque[Readings] = deque()
        self._onset_ns: int | None = None
        self._last_ns: int | None = None

    @property
    def calibrate(self) -> Calibrate:
        """Calibration stage."""
        return self._stages[0]

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected readings: {cause: number}."""
        total: dict[str, int] = {}
        for stage in self._stages[:2]:
            for cause, n in rejected(stage.counts).items():
                total[cause] = total.get(cause, 0) + n
        return total

    def no_detection_reason(self, missing_topics: Sequence[str]) -> str | None:
        """Explain why nothing was detected (`apps.no_detection`); None if a target was."""
        calibrate, _, detect = self._stages
        return no_detection_reason(self._network, self._settings, calibrate, detect, missing_topics,
                                   self.rejected)

    def sensors_without_background(self) -> list[str]:
        """Names of the sensors whose background was never learnt."""
        return self._stages[0].unready()

    def feed(self, readings: Readings) -> list[tuple[PassData, tuple[str, ...]]]:
        """Add raw readings and return the passes that they complete, with notes for the user."""
        calibrate, align, _ = self._stages
        passes: list[tuple[PassData, tuple[str, ...]]] = []
        batches = calibrate.feed(readings)
        if len(readings) and (batches or calibrate.n_held):
            network = self._network
            sensor = readings.rows({name: j for j, name in enumerate(network.names)})
            self._raw.append(Readings(network.names, sensor,
                                      readings.stamp_ns - network.clock_offset_ns[sensor],
                                      readings.field))
        for calibrated in batches:
            self._calibrated.append(calibrated)
            for frame in align.feed(calibrated):
                passes += self._add_frame(frame)
        return passes

    def flush(self) -> list[tuple[PassData, tuple[str, ...]]]:
        """End the recording and return the pass that was still in progress."""
        calibrate, align, _ = self._stages
        passes: list[tuple[PassData, tuple[str, ...]]] = []
        for calibrated in calibrate.flush():
            self._calibrated.append(calibrated)
            passes += [p for frame in align.feed(calibrated) for p in self._add_frame(frame)]
        passes += [p for frame in align.flush() for p in self._add_frame(frame)]
        if self._onset_ns is not None and self._last_ns is not None:
            passes.append(self._cut(self._onset_ns, self._last_ns,
                                    'the recording ends before the target has passed'))
        return passes

    def _add_frame(self, frame: FieldFrame) -> list[tuple[PassData, tuple[str, ...]]]:
        """Detect targets in a frame; return the passes that end with this frame."""
        passes = []
        for record in self._stages[2].feed(frame):
            if not isinstance(record, Detection):
                if self._on_frame is not None:
                    self._on_frame(record)
                continue
            if record.onset:
                self._onset_ns = record.stamp_ns
            elif self._onset_ns is not None:
                passes.append(self._cut(self._onset_ns, record.stamp_ns))
        if self._onset_ns is not None and frame.stamp_ns - self._onset_ns > MAX_PASS_S * NS:
            passes.append(self._cut(self._onset_ns, frame.stamp_ns, 'the detection lasts for more '
                                    f'than {MAX_PASS_S:.0f} s; the remainder is not used'))
        self._last_ns = frame.stamp_ns
        begin = (frame.stamp_ns if self._onset_ns is None else self._onset_ns) - PAD_S * NS
        for buffer in (self._raw, self._calibrated):
            while buffer and buffer[0].stamp_ns.max() < begin:
                buffer.popleft()
        return passes

    def _cut(self, onset_ns: int, end_ns: int,
             *remarks: str) -> tuple[PassData, tuple[str, ...]]:
        """End the current pass; return (PassData up to `end_ns`, notes including `remarks`)."""
        begin = onset_ns - int(PAD_S * NS)
        readings = Readings.joined(self._calibrated)
        readings = readings.part((begin <= readings.stamp_ns) & (readings.stamp_ns <= end_ns))
        readings = readings.part(np.lexsort((readings.stamp_ns, readings.sensor)))
        sensor, field, raw = readings.sensor, readings.field.copy(), self._raw_fields(readings)
        covariance = np.full((len(sensor), 3, 3), np.nan)
        notes = list(remarks)
        for j in np.unique(sensor):
            rows = np.flatnonzero(sensor == j)
            if readings.covariance is not None:
                covariance[rows] = _common_covariance(readings.covariance[rows])
            interval_s = float(np.median(np.diff(readings.stamp_ns[rows]))) / NS \
                if len(rows) > 1 else np.inf
            raw[rows] = np.where(np.isnan(field[rows]), np.nan, raw[rows])
            is_saturated = saturated_readings(raw[rows], MAX_PLATEAU_S / interval_s)
            field[rows] = np.where(with_margin(is_saturated), np.nan, field[rows])
            for a, saturated in enumerate(is_saturated.T):
                if saturated.any():
                    notes.append(f'{self._network.names[j]}: {"xyz"[a]} was saturated in '
                                 f'{saturated.sum()} of {len(rows)} samples at '
                                 f'{raw[rows[saturated][0], a]:.3g} T; these values and the '
                                 'adjacent ones are not used')
        self._onset_ns = None
        t = (readings.stamp_ns - begin) / NS
        return PassData(self._network, begin, t, sensor, field, covariance,
                        doubt=self._doubt_at(onset_ns)), tuple(notes)

    def _doubt_at(self, stamp_ns: int) -> str:
        """Reason why the readings of a sensor are wrong at a time; empty if none is known.

        A doubtful background is no reason, because the background of a fit is free.
        """
        for reason, by_sensor in self.calibrate.input_doubts().items():
            names = [name for name, times in by_sensor.items() if are_doubtful(times, stamp_ns)]
            if names and reason != DOUBTFUL_BACKGROUND:
                return f'{", ".join(names)}: {MEANINGS[reason]}'
        return ''

    def _raw_fields(self, calibrated: Readings) -> FloatArray:
        """Raw fields (n, 3) [T] of calibrated readings; NaN if the raw reading is unavailable."""
        raw = Readings.joined(self._raw)
        row_of: dict[tuple[int, int], int] = {}
        for k, key in enumerate(zip(raw.sensor.tolist(), raw.stamp_ns.tolist(), strict=True)):
            # The calibration accepts the first usable reading of a timestamp.
            if np.nanmax(np.abs(raw.field[k]), initial=0.0) <= self._max_field:
                row_of.setdefault(key, k)
        # Row -1 contains NaN.
        rows = [row_of.get(key, -1) for key in zip(
            calibrated.sensor.tolist(), calibrated.stamp_ns.tolist(), strict=True)]
        fields: FloatArray = np.concatenate([raw.field, np.full((1, 3), np.nan)])[rows]
        return fields


def _common_covariance(covariances: FloatArray) -> FloatArray:
    """Replace the covariances (n, 3, 3) of readings by the first one if they are similar.

    While the noise is being learnt, its estimate varies slightly although the noise is constant.
    The covariances of a coarse sensor differ: they are much larger in a constant field than in a
    changing one.
    """
    traces = np.nansum(np.einsum('kii->ki', covariances), axis=1)
    if traces.max() > 2.0 * traces.min():
        return covariances
    common: FloatArray = np.broadcast_to(covariances[0], covariances.shape)
    return common
