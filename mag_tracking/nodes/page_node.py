"""Node that shows running nodes on the live page; requires no network file."""

import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mag_tracking_msgs.msg import NetworkFrame, SmoothedTrack, TrackArray
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from visualization_msgs.msg import MarkerArray

from mag_tracking.errors import RecordingError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.messages.network import frame_of
from mag_tracking.messages.standard import SENSOR_NAMESPACES
from mag_tracking.messages.types import NETWORK_FRAME, TRACK_ARRAY
from mag_tracking.nodes.convert import smoothed_path_of, track_of
from mag_tracking.nodes.middleware import RMWError, init_ros, make_executor, shut_down, spin
from mag_tracking.nodes.scheduling import steady_timer
from mag_tracking.nodes.stage_node import LATCHED_QOS, RESULT_QOS, STREAM_QOS
from mag_tracking.quantities import quantity
from mag_tracking.report.page import ERROR, WARNING, Note, Table
from mag_tracking.report.page_scene import SensorLayout
from mag_tracking.web.live_scene import LiveScene
from mag_tracking.web.page_server import UPDATE_INTERVAL_S, PageServer

NICENESS = 10
"""Scheduling niceness of the process, which must not delay the nodes."""
MAX_FRAMES = 64
"""Maximum number of serialised frames stored for the next tick."""
MAX_TRACKS = 1000
"""Maximum number of track messages stored for the next tick."""
STALE_TIMEOUT_S = 5.0
"""[s] A diagnostic status that has not been repeated for this time is stale."""
_LEVELS = {DiagnosticStatus.OK: 'ok', DiagnosticStatus.WARN: 'warning',
           DiagnosticStatus.ERROR: 'error', DiagnosticStatus.STALE: 'stale'}
EMPTY_LAYOUT = SensorLayout('', (), np.zeros((0, 3)))
"""Placeholder until the tracker has published its sensors."""


class PageNode(Node):
    """Adds the messages of the tracker to a scene; a tracker whose topics are neither
    `tracker_node/tracks` nor remapped is found by its message type if it is the only one."""

    def __init__(self, scene: LiveScene) -> None:
        super().__init__('mag_tracking_page', start_parameter_services=False)
        self._scene = scene
        self._layout = EMPTY_LAYOUT
        self._frames: deque[bytes] = deque(maxlen=MAX_FRAMES)
        self._tracks: deque[Any] = deque(maxlen=MAX_TRACKS)
        self._statuses: dict[str, tuple[float, DiagnosticStatus]] = {}
        # {topic: (number of invalid messages, reason of the latest)}
        self._rejected: dict[str, tuple[int, str]] = {}
        self._tracker_subscriptions: list[Subscription] = []
        self._subscribe_to_tracker(self.resolve_topic_name('tracker_node/tracks'))
        # Frames are frequent and large, so only displayed frames are deserialised.
        self._frames_topic = self.resolve_topic_name(NETWORK_FRAME)
        self.create_subscription(NetworkFrame, NETWORK_FRAME, self._receive_frame, STREAM_QOS,
                                 raw=True)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._receive_diagnostics,
                                 STREAM_QOS)
        steady_timer(self, UPDATE_INTERVAL_S, self._tick)
        steady_timer(self, 1.0, self._update_health)

    def _subscribe_to_tracker(self, tracks_topic: str) -> None:
        """Subscribe to the tracker that publishes `tracks_topic`, instead of any previous one."""
        for subscription in self._tracker_subscriptions:
            self.destroy_subscription(subscription)
        self._tracks_topic, base = tracks_topic, tracks_topic.rpartition('/')[0]
        self._tracker_subscriptions = [
            self.create_subscription(MarkerArray, f'{base}/sensor_markers', self._receive_sensors,
                                     LATCHED_QOS),
            self.create_subscription(TrackArray, tracks_topic, self._receive_tracks, STREAM_QOS),
            self.create_subscription(SmoothedTrack, f'{base}/smoothed', self._receive_smoothed,
                                     RESULT_QOS)]

    def _find_tracker(self) -> list[str]:
        """Return the published track topics in the namespace; subscribe if there is only one."""
        namespace = self.get_namespace().rstrip('/')
        topics = [name for name, kinds in self.get_topic_names_and_types()
                  if TRACK_ARRAY in kinds and name.startswith(f'{namespace}/')
                  and self.count_publishers(name)]
        if topics and self._tracks_topic not in topics and len(topics) == 1:
            self._subscribe_to_tracker(topics[0])
        return topics

    def _receive_sensors(self, message: MarkerArray) -> None:
        """Store the sensor positions; a different network starts a new scene."""
        bodies = [m for m in message.markers if m.ns == SENSOR_NAMESPACES[0]]
        labels = {m.id: m.text for m in message.markers if m.ns == SENSOR_NAMESPACES[1]}
        if not bodies or {m.id for m in bodies} - labels.keys():
            return
        layout = SensorLayout(
            bodies[0].header.frame_id, tuple(labels[m.id] for m in bodies),
            np.array([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in bodies]))
        if not np.isfinite(layout.positions).all():
            self._reject('sensor_markers', 'the position of a sensor is not finite')
            return
        if (layout.names, layout.frame) != (self._layout.names, self._layout.frame) \
                or not np.array_equal(layout.positions, self._layout.positions):
            if len(self._layout):
                # Tracks of the first network can arrive before its sensors.
                self._frames.clear()
                self._tracks.clear()
            self._layout = layout
            self._scene.subtitle = f'{quantity(len(layout), "sensor")}, frame {layout.frame}'
            self._scene.use_network(layout)

    def _receive_frame(self, message: bytes) -> None:
        """Store a serialised frame for the next tick."""
        self._frames.append(message)

    def _receive_tracks(self, message: TrackArray) -> None:
        """Store tracks for the next tick."""
        self._tracks.extend(message.tracks)

    def _receive_smoothed(self, message: SmoothedTrack) -> None:
        """Add the smoothed path of an ended track to the scene."""
        self._tick()
        try:
            self._scene.add_smoothed(message.track_id, smoothed_path_of(message))
        except RecordingError as error:
            self._reject('smoothed', str(error))

    def _reject(self, topic: str, reason: str) -> None:
        """Count an invalid message, which the page names, and log the reason."""
        self._rejected[topic] = self._rejected.get(topic, (0, ''))[0] + 1, reason
        self.get_logger().error(f'{topic}: {reason}', throttle_duration_sec=10.0)

    def _receive_diagnostics(self, message: DiagnosticArray) -> None:
        """Store the latest diagnostic status of each node and sensor in this namespace."""
        now, namespace = time.monotonic(), self.get_namespace().strip('/')
        self._statuses.update({
            s.name: (now, s) for s in message.status
            if s.name.partition(':')[0].rpartition('/')[0] == namespace})

    def _tick(self) -> None:
        """Add received tracks and frames to the scene; without tracks, only the latest frame."""
        if not len(self._layout):
            return
        serialised_frames = list(self._frames)
        self._frames.clear()
        if not self._tracks:
            serialised_frames = serialised_frames[-1:]
        for data in serialised_frames:
            try:
                self._scene.add_frame(
                    frame_of(deserialize_message(data, NetworkFrame), self._layout))
            except (RecordingError, RMWError) as error:
                self._reject(NETWORK_FRAME, str(error))
        tracks = list(self._tracks)
        self._tracks.clear()
        for message in tracks:
            try:
                self._scene.add_track(track_of(message, n_sensors=len(self._layout)))
            except RecordingError as error:
                self._reject('tracks', str(error))

    def _update_health(self) -> None:
        """Update the notes on faults and the table of all diagnostics on the page."""
        now = time.monotonic()
        notes, rows = [], []
        for name, (received, status) in sorted(self._statuses.items()):
            is_stale = now - received > STALE_TIMEOUT_S
            level = 'stale' if is_stale else _LEVELS.get(status.level, 'error')
            rows.append([name, level, status.message])
            if level in ('warning', 'error'):
                notes.append(Note(ERROR if level == 'error' else WARNING,
                                  f'{name}: {status.message}'))
        self._scene.set_health([*self._missing_topics(), *notes],
                               [Table('Health', ['node', 'level', 'message'], rows)])

    def _missing_topics(self) -> Iterator[Note]:
        """Notes on missing topics, positions or selection, and on invalid messages."""
        topics = self._find_tracker()
        if len(topics) > 1 and self._tracks_topic not in topics:
            yield Note(WARNING, f'several trackers: {", ".join(topics)}; select one (--ros-args -r '
                       'tracker_node/tracks:=...)')
        elif not topics:
            yield Note(WARNING, f'no publisher on {self._tracks_topic}: start the tracker, or '
                       'select its namespace (--ros-args -r __ns:=...)')
        elif not len(self._layout):
            yield Note(WARNING, 'waiting for the sensor positions from the tracker')
        if not self.count_publishers(self._frames_topic):
            yield Note(WARNING, f'no publisher on {self._frames_topic}: fields are not shown')
        for topic, (n, reason) in sorted(self._rejected.items()):
            yield Note(WARNING, f'{topic}: {quantity(n, "invalid message")}; the latest: {reason}')


def watch(host: str, port: int, report: Callable[[str], object],
          ros_arguments: Sequence[str] = (), ended: Callable[[], bool] = lambda: False) -> int:
    """Serve the page of running nodes until SIGINT, SIGTERM or `ended`; return the exit status, and
    `report` the address; raises DeviceError if the port cannot be opened."""
    os.nice(NICENESS)
    scene = LiveScene('mag_tracking', EMPTY_LAYOUT)
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals, \
            PageServer(scene, host, port) as server:
        report(f'live page: {server.url}')
        init_ros(list(ros_arguments))
        executor, node, status = make_executor(), PageNode(scene), 1
        executor.add_node(node)
        try:
            spin(executor, lambda: bool(signals) or not server.is_serving or ended())
            status = 0 if server.is_serving else 1
        finally:
            shut_down([node], executor, status)
        return status
