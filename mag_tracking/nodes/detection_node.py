"""detection_node: calibrated fields in, frames of the network and detections out."""

if __name__ == '__main__':
    # Does not return: a signal during the imports below would end in a traceback.
    from mag_tracking.nodes.start import detection_node

    detection_node()

from functools import partial
from typing import Any

from mag_tracking_msgs.msg import Detection as DetectionMessage
from mag_tracking_msgs.msg import FieldReadings, NetworkFrame
from mag_tracking_msgs.msg import PassEvent as PassEventMessage
from sensor_msgs.msg import MagneticField

from mag_tracking.messages.frame import frame_dict
from mag_tracking.messages.schema import detection_dict, pass_event_dict, reading_of
from mag_tracking.messages.types import CALIBRATED_READINGS, NETWORK_FRAME, TRACK_ARRAY
from mag_tracking.nodes import stage_node
from mag_tracking.nodes.convert import to_message
from mag_tracking.nodes.ros_params import declare_settings
from mag_tracking.nodes.stage_node import RESULTS, SENT, STREAM, StageNode, has_subscribers
from mag_tracking.nodes.steady_timer import steady_timer
from mag_tracking.nodes.tracker_node import TrackerNode
from mag_tracking.records import Detection, FieldFrame, Readings
from mag_tracking.stages.align.frame_period import frame_period_warning
from mag_tracking.stages.align.stage import Align
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.events.stage import Events
from mag_tracking.stages.stage import Stage

DESCRIBED_S = 0.5
"""[s] Events are sought once a frame, since a search costs as much as many readings. Without frames
they are sought at this interval."""


class DetectionNode(StageNode):
    """Aligns the sensors to frames and tests each for a target."""

    def __init__(self, tracker: TrackerNode | None = None, **node_arguments: Any) -> None:
        """With a `tracker` in the same process, which takes the frames, calibrated readings come by
        `take_readings`.
        """
        super().__init__('detection_node', 'align', **node_arguments)
        self._tracker = tracker
        self._unpublished: FieldFrame | None = None
        self.settings = declare_settings(self, self.settings, 'detect')
        self.settings = declare_settings(self, self.settings, 'events')
        self._align = Align(self.network, self.settings.align)
        warning = frame_period_warning(self.settings.align, self.network)
        if warning:
            self.get_logger().warning(warning)
        self._events = Events(self.network, self.settings.align, self.settings.detect) \
            if len(self.network) <= self.settings.events.max_sensors else None
        self._undescribed: list[Readings] = []
        if self._events is not None:
            steady_timer(self, DESCRIBED_S, self._describe)
        self._described = self.publisher(PassEventMessage, '~/events', RESULTS)
        self._detect = Detect(self.network, self.settings.detect)
        self._frames = self.publisher(NetworkFrame, NETWORK_FRAME, SENT)
        self._detections = self.publisher(DetectionMessage, '~/detections', RESULTS)
        if tracker is None:
            self._subscribe()
        else:
            tracker.behind_pose = self._publish_frame_behind
            self.take_readings = self.direct('calibration', [CALIBRATED_READINGS], self._feed,
                                             lambda readings: int(readings.stamp_ns[-1]))
        self.report_state()

    def _subscribe(self) -> None:
        """Listen to the calibration, as a process of its own."""
        for sensor, topic in zip(self.network.names, self.network.topics, strict=True):
            self.subscription(MagneticField, f'{topic}_calibrated', partial(self._take, sensor),
                              STREAM, source='calibration')
        self.subscription(FieldReadings, CALIBRATED_READINGS, self._take_many, STREAM,
                          source='calibration', batches=True)
        self.expect('tracker', NETWORK_FRAME, TRACK_ARRAY)

    def stages(self) -> dict[str, Stage[Any, Any]]:
        """{name: stage} whose counts are published."""
        events: dict[str, Stage[Any, Any]] = \
            {} if self._events is None else {'events': self._events}
        return {'align': self._align, 'detect': self._detect, **events}

    def queues(self) -> dict[str, int]:
        """{name of a stage: how many records it holds}."""
        held = {} if self._events is None else {'events': sum(map(len, self._undescribed))}
        return {'align': self._align.n_held, **held}

    def _take(self, sensor: str, message: MagneticField) -> None:
        """One calibrated reading."""
        self._feed(reading_of(message, sensor))

    def _take_many(self, message: FieldReadings) -> None:
        """Calibrated readings of many sensors."""
        readings = self.readings_of(message, self._align)
        if readings is not None:
            self._feed(readings)

    def _feed(self, readings: Readings) -> None:
        """Calibrated readings: the frames and events that they complete."""
        frames = self._align.feed(readings)
        self._publish(frames)
        if self._events is not None:
            self._undescribed.append(readings)
            if frames:
                self._describe()

    def _describe(self) -> None:
        """Publish the events that the readings since the last time complete."""
        assert self._events is not None
        readings, self._undescribed = Readings.joined(self._undescribed), []
        for event in self._events.feed(readings):
            self._described.publish(to_message(PassEventMessage, pass_event_dict(event)))

    def _publish(self, frames: list[FieldFrame]) -> None:
        """Frames that are complete, and what is detected in them."""
        for frame in frames:
            for record in self._detect.feed(frame):
                if isinstance(record, Detection):
                    self._detections.publish(to_message(
                        DetectionMessage, detection_dict(record, self.network.frame)))
                elif self._tracker is None:
                    self._publish_frame(record)
                else:
                    self._unpublished = record
                    self._tracker.take_frame(record)
                    self._publish_frame_behind()

    def _publish_frame_behind(self) -> None:
        """Publish the frame that the tracker has, once, where somebody listens."""
        frame, self._unpublished = self._unpublished, None
        if frame is not None and has_subscribers(self._frames):
            self._publish_frame(frame)

    def _publish_frame(self, frame: FieldFrame) -> None:
        """Publish a frame with its verdict."""
        self._frames.publish(to_message(NetworkFrame, frame_dict(frame, self.network)))


def main(arguments: list[str] | None = None) -> int:
    """Run the node; returns the exit status."""
    return stage_node.main(DetectionNode, arguments)
