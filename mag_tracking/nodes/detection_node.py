"""detection_node: combines calibrated fields into network frames and detects targets."""

if __name__ == '__main__':
    from mag_tracking.nodes.start import detection_node

    detection_node()

from collections.abc import Mapping
from functools import partial
from typing import Any

from mag_tracking_msgs import msg
from mag_tracking_msgs.msg import FieldReadings, NetworkFrame
from sensor_msgs.msg import MagneticField

from mag_tracking.calibration.background import RunningBackground
from mag_tracking.messages.network import frame_dict
from mag_tracking.messages.schema import detection_dict, pass_event_dict, reading_of, readings_of
from mag_tracking.messages.types import CALIBRATED_READINGS, NETWORK_FRAME, TRACK_ARRAY
from mag_tracking.nodes import middleware
from mag_tracking.nodes.convert import has_subscribers, send
from mag_tracking.nodes.ros_params import declare_settings
from mag_tracking.nodes.scheduling import steady_timer
from mag_tracking.nodes.stage_node import PUBLISHER_QOS, RESULT_QOS, STREAM_QOS, StageNode
from mag_tracking.nodes.tracker_node import TrackerNode
from mag_tracking.records import Detection, FieldFrame, Readings
from mag_tracking.stages.align.stage import Align, frame_period_warning
from mag_tracking.stages.detect.stage import Detect
from mag_tracking.stages.events.stage import Events
from mag_tracking.stages.stage import Stage

MAX_EVENT_SENSORS = 4
"""Maximum number of sensors of a network for which the passes at each sensor are published."""
EVENT_INTERVAL_S = 0.5
"""[s] Interval between searches for pass events. New frames also trigger a search; single readings
do not, because a search takes as long as the processing of many readings."""


class DetectionNode(StageNode):
    """Aligns the readings of all sensors into frames and tests each for a target; with a `tracker`
    in the same process, readings come to `receive_readings`, and frames go to the tracker."""

    def __init__(self, tracker: TrackerNode | None = None, **node_arguments: Any) -> None:
        super().__init__('detection_node', 'align', **node_arguments)
        self._tracker = tracker
        self._pending_frame: FieldFrame | None = None
        self.settings = declare_settings(self, self.settings, 'detect')
        self._align = Align(self.network, self.settings.align)
        if warning := frame_period_warning(self.settings.align, self.network):
            self.get_logger().warning(warning)
        self._events = Events(self.network, self.settings.align, self.settings.detect,
                              self.settings.track) \
            if len(self.network) <= MAX_EVENT_SENSORS else None
        self._event_backlog: list[Readings] = []
        if self._events is not None:
            steady_timer(self, EVENT_INTERVAL_S, self._publish_events)
        self._event_publisher = self.publisher(msg.PassEvent, '~/events', RESULT_QOS)
        self._detect = Detect(self.network, self.settings.detect)
        self._frame_publisher = self.publisher(NetworkFrame, NETWORK_FRAME, PUBLISHER_QOS)
        self._detection_publisher = self.publisher(msg.Detection, '~/detections', RESULT_QOS)
        if tracker is None:
            self._subscribe()
        else:
            tracker.after_pose = self._publish_pending_frame
            self.receive_readings = self.direct_input(
                'calibration', [CALIBRATED_READINGS], self._feed,
                lambda readings: int(readings.stamp_ns[-1]))
        self.report_state()

    def _subscribe(self) -> None:
        """Subscribe to the calibrated fields; monitor whether a tracker receives the frames."""
        for sensor, topic in zip(self.network.names, self.network.topics, strict=True):
            self.subscription(
                MagneticField, f'{topic}_calibrated',
                partial(lambda sensor, message: self._feed(reading_of(message, sensor)), sensor),
                STREAM_QOS, source='calibration')
        self.subscription(FieldReadings, CALIBRATED_READINGS, self._receive_batch, STREAM_QOS,
                          source='calibration', batches=True)
        self.monitor_subscriber('tracker', NETWORK_FRAME, TRACK_ARRAY)

    def stages(self) -> dict[str, Stage[Any, Any]]:
        """Stages whose counts are published in diagnostics, by name."""
        return {'align': self._align, 'detect': self._detect,
                **({} if self._events is None else {'events': self._events})}

    def queues(self) -> dict[str, int]:
        """Number of queued readings of each stage, by name."""
        events = {} if self._events is None else {'events': sum(map(len, self._event_backlog))}
        return {'align': self._align.n_held, **events}

    def _receive_batch(self, message: FieldReadings) -> None:
        """Process calibrated readings of many sensors."""
        readings = self.converted(lambda: readings_of(message), self._align, 'readings')
        if readings is not None:
            self._feed(readings)

    def _feed(self, readings: Readings) -> None:
        """Add calibrated readings; publish completed frames with their detections, and events."""
        frames = self._align.feed(readings)
        self._publish(frames)
        if self._events is not None:
            self._event_backlog.append(readings)
            if frames:
                self._publish_events()

    def set_relearnt(self, backgrounds: Mapping[str, RunningBackground]) -> None:
        """Set the changes of the backgrounds, so that a parked vehicle's event is not split."""
        if self._events is not None:
            self._events.set_relearnt(backgrounds)

    def _publish_events(self) -> None:
        """Publish the events completed by the readings received since the last call."""
        assert self._events is not None
        readings, self._event_backlog = Readings.joined(self._event_backlog), []
        for event in self._events.feed(readings):
            send(self._event_publisher, pass_event_dict(event))

    def _publish(self, frames: list[FieldFrame]) -> None:
        """Detect targets in completed frames; publish frames and detections."""
        for frame in frames:
            for record in self._detect.feed(frame):
                if isinstance(record, Detection):
                    send(self._detection_publisher, detection_dict(record, self.network.frame))
                elif self._tracker is None:
                    send(self._frame_publisher, frame_dict(record, self.network))
                else:
                    self._pending_frame = record
                    self._tracker.receive_frame(record)
                    self._publish_pending_frame()

    def _publish_pending_frame(self) -> None:
        """Publish the pending frame, if any, after its pose or when it has been processed."""
        frame, self._pending_frame = self._pending_frame, None
        if frame is not None and has_subscribers(self._frame_publisher):
            send(self._frame_publisher, frame_dict(frame, self.network))


main = partial(middleware.main, DetectionNode)
