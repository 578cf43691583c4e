"""Receiver of the records of a run, with one method for each type of record."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from mag_tracking.event_records import Disturbance, TrafficSummary, VehiclePassage
from mag_tracking.records import Detection, FieldFrame, Readings, SmoothedPose, Track


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


class RecordReceiver:
    """Sink that passes each record to the method for its type; subclasses override some."""

    def add(self, step: Step) -> None:
        """Receive the records of a step."""
        self.receive(step.records)

    def receive(self, records: Iterable[object]) -> None:
        """Receive records in order of processing."""
        for record in records:
            if isinstance(record, FieldFrame):
                self.add_frame(record)
            elif isinstance(record, Track):
                self.add_track(record)
            elif isinstance(record, SmoothedPose):
                self.add_smoothed(record)
            elif isinstance(record, Readings):
                self.add_calibrated(record)
            elif isinstance(record, Detection):
                self.add_detection(record)
            elif isinstance(record, Disturbance):
                self.add_disturbance(record)
            elif isinstance(record, VehiclePassage):
                self.add_passage(record)
            elif isinstance(record, TrafficSummary):
                self.add_traffic(record)

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
