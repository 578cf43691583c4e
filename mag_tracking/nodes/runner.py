"""Run all nodes in one process; replaces the launch file where `ros2 launch` is missing."""

import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from os import PathLike as OsPathLike
from typing import TextIO

from mag_tracking_msgs.msg import TrackArray
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter

from mag_tracking.errors import MagTrackingError, RecordingError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.messages.types import RAW_READINGS
from mag_tracking.network.sensor_network import namespaces_of
from mag_tracking.nodes.calibration_node import CalibrationNode
from mag_tracking.nodes.convert import track_of
from mag_tracking.nodes.detection_node import DetectionNode
from mag_tracking.nodes.driver_node import DriverNode
from mag_tracking.nodes.middleware import freeze, init_ros, make_executor, shut_down, spin
from mag_tracking.nodes.replay_node import ReplayNode
from mag_tracking.nodes.stage_node import STREAM_QOS, StageNode
from mag_tracking.nodes.tracker_node import TrackerNode
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.records import Track
from mag_tracking.settings import flatten

PathLike = str | OsPathLike[str]
MAX_DISCOVERY_S = 60.0
"""[s] Maximum time for mutual discovery of the nodes; a busy computer needs several seconds."""


class TrackPrinter(Node):
    """Prints the poses of the tracks of a topic."""

    def __init__(self, topic: str = 'tracker_node/tracks', out: TextIO = sys.stdout) -> None:
        super().__init__('track_printer')
        self._out = out
        self.create_subscription(TrackArray, topic, self._receive, STREAM_QOS)

    def _receive(self, message: TrackArray) -> None:
        """Print the pose of each track, or that the track has ended; log invalid tracks."""
        for content in message.tracks:
            try:
                track = track_of(content)
            except RecordingError as error:
                self.get_logger().error(str(error), throttle_duration_sec=10.0)
                continue
            line = f'track {track.id} has ended' if track.ended else pose_line(track)
            print(line, file=self._out, flush=True)


def pose_line(track: Track) -> str:
    """Format a pose as a line: position with standard deviations, speed, moment, arrival, kind."""
    x, y, z = track.position
    sx, sy, sz = (float(v) ** 0.5 for v in track.covariance.diagonal()[:3])
    unit, f = ('m', 1.0) if max(sx, sy) > 0.02 or max(abs(x), abs(y)) > 2.0 else ('mm', 1e3)
    vx, vy, _ = track.velocity
    moment = float((track.moment @ track.moment) ** 0.5)
    return (f'track {track.id}  {track.stamp_ns / 1e9:.2f}  '
            f'x {f * x:8.2f} ± {f * sx:5.2f}  y {f * y:8.2f} ± {f * sy:5.2f}  '
            f'z {f * z:7.2f} ± {f * sz:5.2f} {unit}  {(vx * vx + vy * vy) ** 0.5:5.1f} m/s  '
            f'{moment:7.3g} A m²  {track.arrival:6s} {track.kind}'
            f'{"  ambiguous" if track.ambiguous else ""}')


def parameters(network_path: PathLike, settings: Settings, reliable: bool) -> list[Parameter]:
    """ROS parameters of the nodes without default values, which ROS arguments can then change;
    `reliable` is the QoS of the sensors, needed for a replay."""
    out = [Parameter('network', value=str(network_path)),
           Parameter('target', value=settings.track.target),
           Parameter('reliable_input', value=reliable)]
    defaults = {p.name: p.value for p in flatten(settings_for(settings.track.target))}
    return out + [Parameter(p.name, value=list(p.value) if isinstance(p.value, tuple) else p.value)
                  for p in flatten(settings) if p.value != defaults.get(p.name)]


def make_nodes(network_path: PathLike, settings: Settings, recording: PathLike | None = None,
               rate: float = 1.0, loop: bool = False
               ) -> tuple[list[StageNode], ReplayNode | None]:
    """Create the nodes, which call each other directly, and the paused replay node, if any."""
    overrides = parameters(network_path, settings, reliable=recording is not None)
    tracker = TrackerNode(has_direct_input=True, parameter_overrides=overrides)
    detection = DetectionNode(tracker, parameter_overrides=overrides)
    stages: list[StageNode] = [
        CalibrationNode((detection, tracker), parameter_overrides=overrides), detection, tracker]
    if recording is None:
        return stages, None
    replay = ReplayNode(parameter_overrides=[
        Parameter('recording', value=str(recording)), Parameter('rate', value=float(rate)),
        Parameter('loop', value=loop), Parameter('paused', value=True)])
    return stages, replay


def all_connected(stages: list[StageNode], replay: ReplayNode) -> bool:
    """Whether each sensor topic that is replayed has a subscriber."""
    return all(p.get_subscription_count() > 0 for p in replay.publishers_by_topic.values()
               if p.topic_name in stages[0].sensor_topics)


def run(network_path: PathLike, settings: Settings, recording: PathLike | None = None,
        rate: float = 1.0, loop: bool = False,
        observers: Sequence[Callable[[], Node]] | None = None, drivers: PathLike | None = None,
        batches: bool = False, ros_arguments: Sequence[str] = ()) -> int:
    """Run the nodes until Ctrl-C, or until a recording has been played; return the exit status.

    `drivers` is the file of a driver node, with many sensors in one message if `batches`.
    `observers` create additional nodes, by default a `TrackPrinter`.
    """
    # The driver node is created last, so that its first messages have subscribers.
    sources: Sequence[Callable[[], Node]] = [partial(DriverNode, parameter_overrides=[
        Parameter('drivers', value=str(drivers)), Parameter('network', value=str(network_path)),
        Parameter('batches', value=batches)])] if drivers else []
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals:
        init_ros(list(ros_arguments))
        executor, nodes, status = make_executor(), list[Node](), 1
        try:
            stages, replay = make_nodes(network_path, settings, recording, rate, loop)
            if observers is None:
                observers = [partial(TrackPrinter, stages[-1].resolve_topic_name('~/tracks'))]
            nodes = [*stages, *(make() for make in (*observers, *sources))]
            nodes += [replay] if replay else []
            for node in nodes:
                executor.add_node(node)
            freeze()
            if replay is None:
                spin(executor, lambda: bool(signals))
            else:
                _play(executor, stages, replay, lambda: bool(signals))
            status = 0
        finally:
            shut_down(nodes, executor, status)
        return status


def _play(executor: Executor, stages: list[StageNode], replay: ReplayNode,
          stopped: Callable[[], bool]) -> None:
    """Play the recording once all nodes are connected, and wait until it has been processed."""
    _check_topics(stages[0], replay)
    deadline = time.monotonic() + MAX_DISCOVERY_S
    spin(executor, lambda: all_connected(stages, replay) or stopped()
         or time.monotonic() > deadline)
    if not all_connected(stages, replay) and not stopped():
        raise MagTrackingError('the nodes did not discover each other within '
                               f'{MAX_DISCOVERY_S:g} s; check the network interfaces and the '
                               'load of this computer')
    replay.resume()
    spin(executor, lambda: replay.finished or stopped())
    _drain(executor, stages, stopped)


def _check_topics(node: StageNode, replay: ReplayNode) -> None:
    """Raise MagTrackingError if no played topic belongs to the network."""
    played = {p.topic_name for p in replay.publishers_by_topic.values()}
    if played & {*node.sensor_topics, node.resolve_topic_name(RAW_READINGS)}:
        return
    namespaces = namespaces_of((*node.network.topics, RAW_READINGS),
                               list(replay.publishers_by_topic))
    hint = f'; start the nodes in its namespace: --ros-args -r __ns:={namespaces[0]}' \
        if namespaces and namespaces != ['/'] else ''
    raise MagTrackingError(f'the recording contains none of the topics '
                           f'{", ".join(node.sensor_topics)}{hint}')


def _drain(executor: Executor, stages: list[StageNode], stopped: Callable[[], bool]) -> None:
    """Spin until no stage has processed a record for a second, or until `stopped()`."""
    def totals() -> list[int]:
        return [sum(s.counts.values()) for node in stages for s in node.stages().values()]

    previous, since = totals(), time.monotonic()

    def is_quiet() -> bool:
        nonlocal previous, since
        current = totals()
        if current != previous:
            previous, since = current, time.monotonic()
        return stopped() or time.monotonic() - since > 1.0

    spin(executor, is_quiet)
