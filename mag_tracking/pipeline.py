"""The settings tree and the chain of processing stages, shared by nodes and offline programs."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from mag_tracking.errors import SettingsError
from mag_tracking.event_records import Disturbance, TrafficSummary, VehiclePassage
from mag_tracking.network import SensorNetwork
from mag_tracking.records import Detection, FieldFrame, Readings, SmoothedPose, Track
from mag_tracking.settings import replace
from mag_tracking.stages.align.settings import AlignSettings
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.calibrate.settings import CalibrateSettings
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.detect.settings import DetectSettings
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.stage import Stage, rejected
from mag_tracking.stages.survey.settings import SurveySettings
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


Output: TypeAlias = (FieldFrame | Detection | Track | SmoothedPose | Disturbance | VehiclePassage
                     | TrafficSummary)
"""Records that the pipeline returns."""


class Pipeline:
    """Chain of stages that converts raw readings to frames, detections, tracks and passages.

    The chain depends neither on ROS nor on a clock.
    """

    def __init__(self, network: SensorNetwork, settings: Settings) -> None:
        self.network = network
        self.settings = settings
        self.calibrate = Calibrate(network, settings.calibrate, survey=settings.survey)
        self.align = Align(network, settings.align)
        self.detect = Detect(network, settings.detect)
        self.track = TrackManager(network, settings.track)
        self.traffic = Traffic(network, settings.traffic, settings.track.target == 'vehicle')
        # Aliases with protocol types, so that a type checker verifies each stage.
        self._calibrate: Stage[Readings, Readings] = self.calibrate
        self._align: Stage[Readings, FieldFrame] = self.align
        self._detect: Stage[FieldFrame, FieldFrame | Detection] = self.detect
        self._track: Stage[FieldFrame, Track | SmoothedPose | Disturbance] = self.track
        self._traffic: Stage[TrackedFrame, VehiclePassage | TrafficSummary] = self.traffic

    def feed(self, readings: Readings) -> list[Output]:
        """Process raw readings, and return the resulting records in order of processing.

        The records do not depend on how the readings are split into batches.
        """
        calibrated = self._calibrate.feed(readings)
        self.track.set_input_doubts(self.calibrate.input_doubts())
        return self._process_calibrated(calibrated)

    def flush(self) -> list[Output]:
        """Process and return all records that are still buffered at the end of the input."""
        out = [*self._process_calibrated(self._calibrate.flush()),
               *self._process_frames(self._align.flush()),
               *self._process_detected(self._detect.flush())]
        tracked = self._track.flush()
        return [*out, *tracked, *self._traffic.feed(TrackedFrame(None, tracked)),
                *self._traffic.flush()]

    def _stages(self) -> dict[str, Stage[Any, Any]]:
        """Stages by name, in order of processing."""
        return {'calibrate': self._calibrate, 'align': self._align, 'detect': self._detect,
                'track': self._track, 'traffic': self._traffic}

    def _process_calibrated(self, batches: Iterable[Readings]) -> list[Output]:
        """Align calibrated readings, and process the resulting frames."""
        return self._process_frames([f for b in batches for f in self._align.feed(b)])

    def _process_frames(self, frames: Iterable[FieldFrame]) -> list[Output]:
        """Run the detection on frames, and process the results."""
        return self._process_detected([r for f in frames for r in self._detect.feed(f)])

    def _process_detected(self, records: Iterable[FieldFrame | Detection]) -> list[Output]:
        """Track targets in the frames; return each record and the records that result from it."""
        out: list[Output] = []
        for record in records:
            out.append(record)
            if isinstance(record, FieldFrame):
                tracked = self._track.feed(record)
                out += [*tracked, *self._traffic.feed(TrackedFrame(record, tracked))]
        return out

    def counts(self) -> dict[str, dict[str, int]]:
        """Counters of all stages, by name of the stage."""
        return {name: dict(sorted(stage.counts.items())) for name, stage in self._stages().items()}

    def rejections(self) -> dict[str, int]:
        """Number of rejections by cause, summed over all stages."""
        total: Counter[str] = Counter()
        for stage in self._stages().values():
            total.update(rejected(stage.counts))
        return dict(total)
