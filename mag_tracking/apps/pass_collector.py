"""Extraction of passes: the measurements of a network around each detection."""

from collections import deque

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.doubtful_times import DOUBTFUL_BACKGROUND, are_doubtful
from mag_tracking.calibration.reading_faults import saturated_readings, with_margin
from mag_tracking.pipeline import Pipeline
from mag_tracking.record_receiver import Step
from mag_tracking.records import Detection, FieldFrame, Readings
from mag_tracking.stages.track.doubts import MEANINGS
from mag_tracking.units import NS

PAD_S = 1.0
"""Duration of the background included before the onset of a detection [s]."""
MAX_PLATEAU_S = 0.5
"""Maximum time for which a target that passes saturates a sensor [s]."""
MAX_PASS_S = 60.0
"""Maximum duration of a pass; a longer detection is truncated [s]."""


class PassCollector:
    """Extracts passes from the steps of a run.

    A pass contains all measurements from `PAD_S` before the onset of a detection to its release.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._network, self._calibrate = pipeline.network, pipeline.calibrate
        self._max_field = pipeline.settings.calibrate.max_field
        # Raw and calibrated readings, in network time, from `PAD_S` before the onset or, without a
        # detection, before the latest frame.
        self._raw: deque[Readings] = deque()
        self._calibrated: deque[Readings] = deque()
        self._onset_ns: int | None = None
        self._last_ns: int | None = None

    def passes(self, step: Step) -> list[tuple[PassData, tuple[str, ...]]]:
        """Return (measurements, notes for the user) of each pass that ends with a step."""
        passes, readings = [], step.readings
        if len(readings) and (self._calibrate.n_held
                              or any(isinstance(r, Readings) for r in step.records)):
            network = self._network
            sensor = readings.rows({name: j for j, name in enumerate(network.names)})
            self._raw.append(Readings(network.names, sensor,
                                      readings.stamp_ns - network.clock_offset_ns[sensor],
                                      readings.field))
        for record in step.records:
            if isinstance(record, Readings):
                self._calibrated.append(record)
            elif isinstance(record, Detection) and record.onset:
                self._onset_ns = record.stamp_ns
            elif isinstance(record, Detection) and self._onset_ns is not None:
                passes.append(self._cut(self._onset_ns, record.stamp_ns))
            elif isinstance(record, FieldFrame):
                passes += self._add_frame(record)
        if step.is_last and self._onset_ns is not None and self._last_ns is not None:
            passes.append(self._cut(self._onset_ns, self._last_ns,
                                    'the recording ends before the target has passed'))
        return passes

    def _add_frame(self, frame: FieldFrame) -> list[tuple[PassData, tuple[str, ...]]]:
        """Truncate a pass that is too long at a frame, and forget earlier readings."""
        passes = []
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
        for reason, by_sensor in self._calibrate.input_doubts().items():
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
