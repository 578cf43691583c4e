"""The settings tree and the chain of processing stages, shared by nodes and offline programs."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from mag_tracking.calibration.agreement import SurveySettings
from mag_tracking.errors import SettingsError
from mag_tracking.event_records import Disturbance, TrafficSummary, VehiclePassage
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Detection, FieldFrame, Readings, SmoothedPose, Track
from mag_tracking.settings import replace
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.settings import AlignSettings, CalibrateSettings, DetectSettings
from mag_tracking.stages.stage import rejected
from mag_tracking.stages.track.manager import TrackManager
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.traffic.settings import TrafficSettings
from mag_tracking.stages.traffic.stage import TrackedFrame, Traffic


@dataclass(frozen=True)
class Settings:
    """All settings, one group per stage."""

    calibrate: CalibrateSettings = field(default_factory=CalibrateSettings)
    align: AlignSettings = field(default_factory=AlignSettings)
    detect: DetectSettings = field(default_factory=DetectSettings)
    track: TrackSettings = field(default_factory=TrackSettings)
    traffic: TrafficSettings = field(default_factory=TrafficSettings)
    survey: SurveySettings = field(default_factory=SurveySettings)


_MAGNET: dict[str, Any] = {
    'track.target': 'magnet',
    # Sensors beside a magnet have offsets of tens of microtesla, which are harmless.
    'survey.offset_std': 0.0,
    'calibrate.max_field': 0.1,
    'calibrate.relearn_s': 0.0,
    'calibrate.spike_std': 0.0,
    'align.burst': True,
    'align.period_s': 0.5,
    'align.max_wait_s': 2.0,
    'detect.onset_frames': 1,
    'detect.background_std': 5e-7,
    'track.field_error': 0.01,
    'track.mounting_std_deg': 0.0,
    'track.model_error_time_s': 0.0,
    'track.background_std': 5e-7,
    'track.iterations': 5,
    'track.relinearise_window_s': 0.0,
    'track.lookback_s': 0.0,
    'track.end_gap_s': 30.0,
    'track.max_smoothing_s': 3600.0,
    'track.end_std': 0.2,
}

TARGET_DEFAULTS: dict[str, dict[str, Any]] = {
    'vehicle': {'track.target': 'vehicle'},
    'magnet': {
        **_MAGNET,
        'track.magnet.speed_std': 0.5,
        'track.magnet.spin_std': 3.0,
        'track.magnet.acceleration': 0.5,
        'track.magnet.angular_acceleration': 1.5,
    },
    'bench': _MAGNET,
}
"""Overrides of the default settings by type of target: vehicles, a magnet in a hand (up to 0.5 m/s
and 3 rad/s), or a magnet that is moved step by step on a bench."""


def settings_for(target: str, changes: Mapping[str, Any] | None = None) -> Settings:
    """Settings for a target, a key of `TARGET_DEFAULTS`, with changes by dotted name.

    Raises SettingsError if `target` is unknown, if a change is invalid, or if the change of
    `track.target` differs from the target.
    """
    if target not in TARGET_DEFAULTS:
        raise SettingsError(f'target: expected {" or ".join(TARGET_DEFAULTS)}, got {target!r}')
    defaults, changes = TARGET_DEFAULTS[target], dict(changes or {})
    if changes.get('track.target', defaults['track.target']) != defaults['track.target']:
        raise SettingsError(f'track.target: the parameters contain {changes["track.target"]!r}, '
                            f'but {target!r} was requested; remove one of them')
    return replace(replace(Settings(), defaults), changes)


Output: TypeAlias = (Readings | FieldFrame | Detection | Track | SmoothedPose | Disturbance
                     | VehiclePassage | TrafficSummary)
"""Records that the pipeline returns; `Readings` are calibrated."""
STAGES = ('calibrate', 'align', 'detect', 'track', 'traffic')
"""Stages in order of processing."""


class Pipeline:
    """Chain of stages that converts raw readings to frames, detections, tracks and passages.

    The chain depends neither on ROS nor on a clock. The stages after `upto`, one of `STAGES`, are
    missing. Raises SettingsError if `upto` is unknown, or the settings do not suit the network.
    """

    def __init__(self, network: SensorNetwork, settings: Settings, upto: str = 'traffic') -> None:
        if upto not in STAGES:
            raise SettingsError(f'upto: expected {" or ".join(STAGES)}, got {upto!r}')
        self.network, self.settings = network, settings
        self._names = STAGES[:STAGES.index(upto) + 1]
        self.calibrate = Calibrate(network, settings.calibrate, survey=settings.survey)
        if 'align' in self._names:
            self.align = Align(network, settings.align)
        if 'detect' in self._names:
            self.detect = Detect(network, settings.detect)
        if 'track' in self._names:
            self.track = TrackManager(network, settings.track)
        if 'traffic' in self._names:
            self.traffic = Traffic(network, settings.traffic, settings.track.target == 'vehicle')

    def feed(self, readings: Readings) -> list[Output]:
        """Process raw readings; return the resulting records in order of processing.

        The records do not depend on how the readings are split into batches.
        """
        return self._process_calibrated(self.calibrate.feed(readings))

    def flush(self) -> list[Output]:
        """Process all records that are still buffered at the end of the input."""
        return [*self.drain(), *self.close()]

    def drain(self) -> list[Output]:
        """Process the readings and frames that are still buffered at the end of the input."""
        out = self._process_calibrated(self.calibrate.flush())
        if 'align' in self._names:
            out += [r for frame in self.align.flush() for r in self._process_frame(frame)]
        if 'detect' in self._names:
            out += [r for record in self.detect.flush() for r in self._process_detected(record)]
        return out

    def close(self) -> list[Output]:
        """End the tracks and the summaries after `drain`."""
        tracked = self.track.flush() if 'track' in self._names else []
        out: list[Output] = [*tracked]
        if 'traffic' in self._names:
            out += [*self.traffic.feed(TrackedFrame(None, tracked)), *self.traffic.flush()]
        return out

    def _process_calibrated(self, batches: Iterable[Readings]) -> list[Output]:
        """Tell the tracker which readings are doubtful; return the calibrated batches, each with
        the records that result from it."""
        if 'track' in self._names:
            self.track.set_input_doubts(self.calibrate.input_doubts())
        out: list[Output] = []
        for batch in batches:
            out.append(batch)
            for frame in self.align.feed(batch) if 'align' in self._names else ():
                out += self._process_frame(frame)
        return out

    def _process_frame(self, frame: FieldFrame) -> Iterator[Output]:
        """Yield the records that result from a frame."""
        if 'detect' not in self._names:
            yield frame
            return
        for record in self.detect.feed(frame):
            yield from self._process_detected(record)

    def _process_detected(self, record: FieldFrame | Detection) -> Iterator[Output]:
        """Yield a record of the detection and, for a frame, the tracks and passages."""
        yield record
        if 'track' not in self._names or not isinstance(record, FieldFrame):
            return
        tracked = self.track.feed(record)
        yield from tracked
        if 'traffic' in self._names:
            yield from self.traffic.feed(TrackedFrame(record, tracked))

    def counts(self) -> dict[str, dict[str, int]]:
        """Counters of the stages: {stage: {event: number}}."""
        return {name: dict(sorted(getattr(self, name).counts.items())) for name in self._names}

    def rejections(self) -> dict[str, int]:
        """Number of rejections, summed over the stages: {cause: number}."""
        total: Counter[str] = Counter()
        for counts in self.counts().values():
            total.update(rejected(counts))
        return dict(total)


class Step(NamedTuple):
    """A batch of raw readings and what the pipeline made of it."""

    readings: Readings
    """Raw readings; empty at the end of the source."""
    received_ns: int | None
    """Time of receipt [ns]; None if unknown."""
    records: Sequence[object]
    """Records in order of processing."""
    is_last: bool = False
    """Whether the records follow from the end of the source; all frames precede them."""


_RECEIVERS = {
    Readings: 'add_calibrated', FieldFrame: 'add_frame', Detection: 'add_detection',
    Track: 'add_track', SmoothedPose: 'add_smoothed', Disturbance: 'add_disturbance',
    VehiclePassage: 'add_passage', TrafficSummary: 'add_traffic'}


class RecordReceiver:
    """Sink that passes each record to the method for its type; subclasses override some."""

    def add(self, step: Step) -> None:
        """Receive the records of a step."""
        self.receive(step.records)

    def receive(self, records: Iterable[object]) -> None:
        """Receive records in order of processing."""
        for record in records:
            if name := _RECEIVERS.get(type(record)):
                getattr(self, name)(record)

    def add_calibrated(self, readings: Readings) -> None:
        """Receive a batch of calibrated readings."""

    def add_frame(self, frame: FieldFrame) -> None:
        """Receive a frame, which precedes its tracks."""

    def add_detection(self, detection: Detection) -> None:
        """Receive the onset or release of a detection."""

    def add_track(self, track: Track) -> None:
        """Receive a pose, or the closing record of a track."""

    def add_smoothed(self, pose: SmoothedPose) -> None:
        """Receive a smoothed pose."""

    def add_disturbance(self, disturbance: Disturbance) -> None:
        """Receive a disturbance, when it is detected and again when it has ended."""

    def add_passage(self, passage: VehiclePassage) -> None:
        """Receive the passage of a vehicle."""

    def add_traffic(self, summary: TrafficSummary) -> None:
        """Receive the summary of the traffic in an interval."""
