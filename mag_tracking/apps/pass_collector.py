"""Cut the passes out of a recording: what the network measured around each detection."""

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from mag_tracking.analysis.pass_data import PassData
from mag_tracking.apps.no_detection import no_detection_reason
from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.saturation import saturated_readings
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.records import Detection, FieldFrame, Readings
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.stage import rejected
from mag_tracking.units import NS

PAD_S = 1.0
"""[s] What is taken before a detection begins: there the background is seen alone."""
MAX_S = 60.0
"""[s] What is seen for longer does not pass; it is cut there."""


class PassCollector:
    """Readings to passes: what the network measured from before a detection until it ended."""

    def __init__(self, network: SensorNetwork, settings: Settings,
                 seen: Callable[[FieldFrame], object] | None = None) -> None:
        """`seen` is called with every frame, with its verdict."""
        self._network, self._settings, self._seen = network, settings, seen
        self._max_field = settings.calibrate.max_field
        self._stages = (Calibrate(network, settings.calibrate), Align(network, settings.align),
                        Detect(network, settings.detect))
        # Raw and calibrated readings by the network's clock, since before the latest onset.
        self._raw: deque[Readings] = deque()
        self._calibrated: deque[Readings] = deque()
        self._onset_ns: int | None = None
        self._last_ns: int | None = None

    @property
    def calibrate(self) -> Calibrate:
        """The first stage."""
        return self._stages[0]

    @property
    def rejected(self) -> dict[str, int]:
        """{cause: number} of samples that were not used."""
        total: dict[str, int] = {}
        for stage in self._stages[:2]:
            for cause, n in rejected(stage.counts).items():
                total[cause] = total.get(cause, 0) + n
        return total

    def no_detection_reason(self, missing_topics: Sequence[str]) -> str | None:
        """One sentence, or None where something was detected; see `no_detection_reason`."""
        calibrate, _, detect = self._stages
        return no_detection_reason(self._network, self._settings, calibrate, detect, missing_topics,
                                self.rejected)

    def waiting(self) -> list[str]:
        """Names of sensors whose background was never learnt."""
        return self._stages[0].unready()

    def feed(self, readings: Readings) -> list[tuple[PassData, tuple[str, ...]]]:
        """Raw `Readings` of the network give the passes that they complete: [(PassData, notes)]."""
        calibrate, align, _ = self._stages
        out: list[tuple[PassData, tuple[str, ...]]] = []
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
                out += self._judge(frame)
        return out

    def flush(self) -> list[tuple[PassData, tuple[str, ...]]]:
        """The recording has ended: the pass that was still going on."""
        calibrate, align, _ = self._stages
        out: list[tuple[PassData, tuple[str, ...]]] = []
        for calibrated in calibrate.flush():
            self._calibrated.append(calibrated)
            out += [p for frame in align.feed(calibrated) for p in self._judge(frame)]
        out += [p for frame in align.flush() for p in self._judge(frame)]
        if self._onset_ns is not None and self._last_ns is not None:
            out.append(self._cut(self._onset_ns, self._last_ns,
                                 'the recording ends while it is still seen'))
        return out

    def _judge(self, frame: FieldFrame) -> list[tuple[PassData, tuple[str, ...]]]:
        """Take a frame; the pass that has ended with it."""
        out = []
        for record in self._stages[2].feed(frame):
            if not isinstance(record, Detection):
                if self._seen is not None:
                    self._seen(record)
                continue
            if record.onset:
                self._onset_ns = record.stamp_ns
            elif self._onset_ns is not None:
                out.append(self._cut(self._onset_ns, record.stamp_ns))
        if self._onset_ns is not None and frame.stamp_ns - self._onset_ns > MAX_S * NS:
            out.append(self._cut(self._onset_ns, frame.stamp_ns, 'it is seen for more than '
                                 f'{MAX_S:.0f} s: what comes after, until it is gone, is '
                                 'left out'))
        self._last_ns = frame.stamp_ns
        begin = (frame.stamp_ns if self._onset_ns is None else self._onset_ns) - PAD_S * NS
        for kept in (self._raw, self._calibrated):
            while kept and kept[0].stamp_ns.max() < begin:
                kept.popleft()
        return out

    def _cut(self, onset_ns: int, end_ns: int,
             *remarks: str) -> tuple[PassData, tuple[str, ...]]:
        """(PassData, notes) of what was kept from an onset to a time; the pass is over."""
        begin = onset_ns - int(PAD_S * NS)
        found = Readings.joined(self._calibrated)
        found = found.part((begin <= found.stamp_ns) & (found.stamp_ns <= end_ns))
        found = found.part(np.lexsort((found.stamp_ns, found.sensor)))
        sensor, field, raw = found.sensor, found.field.copy(), self._raw_fields(found)
        covariance = np.full((len(sensor), 3, 3), np.nan)
        notes = list(remarks)
        for j in np.unique(sensor):
            mine = np.flatnonzero(sensor == j)
            if found.covariance is not None:
                covariance[mine] = _settled(found.covariance[mine])
            for a, axis in enumerate('xyz'):
                bad = mine[saturated_readings(raw[mine, a])]
                if len(bad):
                    field[bad, a] = np.nan
                    notes.append(f'{self._network.names[j]}: {axis} was saturated in {len(bad)} '
                                 f'of {len(mine)} samples at {raw[bad[0], a]:.3g} T; left out')
        self._onset_ns = None
        t = (found.stamp_ns - begin) / NS
        return PassData(self._network, begin, t, sensor, field, covariance), tuple(notes)

    def _raw_fields(self, calibrated: Readings) -> FloatArray:
        """Raw fields (n, 3) [T] of calibrated readings; NaN where a reading has none."""
        raw = Readings.joined(self._raw)
        known: dict[tuple[int, int], int] = {}
        for k, key in enumerate(zip(raw.sensor.tolist(), raw.stamp_ns.tolist(), strict=True)):
            # Of two with the same timestamp the calibration accepts the first usable one.
            if np.nanmax(np.abs(raw.field[k]), initial=0.0) <= self._max_field:
                known.setdefault(key, k)
        # Row -1 is NaN.
        rows = [known.get(key, -1) for key in zip(
            calibrated.sensor.tolist(), calibrated.stamp_ns.tolist(), strict=True)]
        fields: FloatArray = np.concatenate([raw.field, np.full((1, 3), np.nan)])[rows]
        return fields


def _settled(covariances: FloatArray) -> FloatArray:
    """(n, 3, 3) covariances of readings; the first for all where they are about the same.

    Noise that is still being learnt differs a little from reading to reading, and the sensor's
    does not. That of a coarse sensor at rest is many times that of one that moves.
    """
    size = np.nansum(np.einsum('kii->ki', covariances), axis=1)
    if size.max() > 2.0 * size.min():
        return covariances
    settled: FloatArray = np.broadcast_to(covariances[0], covariances.shape)
    return settled
