"""Environment for fault tests: a roadside, a broker, a serial line, and the nodes as processes."""

import signal
import time
from contextlib import contextmanager

import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from mag_tracking_msgs.msg import NetworkFrame, TrackArray
from rclpy.node import Node
from rclpy.task import Future
from scipy.stats import chi2
from sensor_msgs.msg import MagneticField

from mag_tracking.network.file import read_network
from mag_tracking.nodes.convert import track_of
from mag_tracking.nodes.middleware import init_ros, make_executor
from mag_tracking.nodes.stage_node import RESULT_QOS, STREAM_QOS
from support.bundled import NETWORK_FILE, POINT
from support.mqtt_broker import Broker, password_lines
from support.node_processes import MAX_S, start, stop
from support.roadside import NOISE, Roadside
from support.scenario import point_body
from support.serial_line import SerialLine

MAX_NEES = chi2.ppf(1.0 - 1e-4, 2)
"""Maximum NEES of a correct pose, with two degrees of freedom."""
BODY = point_body([0.0, 300.0, -300.0], 5.0, 0.5)
"""Vehicle whose hard and soft iron do not cancel, so that it is detected at 12 m."""
TOPICS = {'driver_node': (MagneticField, '/mag_1/imu/mag'),
          'calibration_node': (MagneticField, '/mag_1/imu/mag_calibrated'),
          'detection_node': (NetworkFrame, '/network_frame'),
          'tracker_node': (TrackArray, '/tracker_node/tracks')}
"""Message type and topic of the output of each node."""
FRAME_S = 0.2
"""[s] `align.period_s`: longer than the default, so that a tracker on a busy machine keeps up."""
NS = 1_000_000_000
STEADY = {'calibration_node': {'calibrate.learn_s': 3600.0},
          'detection_node': {'detect.background_drift': 0.0}}
"""Settings for a constant background from the network file, which is not relearnt between vehicles
and has no uncertainty."""


def network_file(folder):
    """Write the road network with known noise and backgrounds; return the path."""
    content = yaml.safe_load(NETWORK_FILE.read_text())
    for sensor in content['sensors'].values():
        sensor.update(noise_std=NOISE, background=content['earth_field'])
    path = folder / 'network.yaml'
    path.write_text(yaml.safe_dump(content))
    return path


def drivers_files(folder, broker, guarded, line):
    """Write the drivers files for `mqtt` and `serial`; return {link: path}.

    The broker `guarded` refuses the second device of `mqtt`.
    """
    common = {'clock': {'tick_s': 1e-6, 'wrap': 0}, 'unit': 'nT'}
    content = {
        'mqtt': {'transport': 'mqtt', 'framing': 'json',
                 'mqtt': {'host': '127.0.0.1', 'port': broker.port, 'topics': ['road/+']},
                 'json': {'field': ['x', 'y', 'z'], 'ticks': 't', 'sequence': 'n'},
                 'sensors': {'road/A': 'mag_1', 'road/B': 'mag_2'}},
        'serial': {'transport': 'serial', 'framing': 'text', 'serial': {'port': str(line.path)},
                   'text': {'fields': ['sensor', 'sequence', 'ticks', 'x', 'y', 'z'],
                            'checksum': 'nmea'},
                   'sensors': {'A': 'mag_1', 'B': 'mag_2'}}}
    files = {name: {name: {**entry, **common}} for name, entry in content.items()}
    files['mqtt']['guarded'] = {
        'transport': 'mqtt', 'mqtt': {'host': '127.0.0.1', 'port': guarded.port, 'topics': ['#']},
        'framing': 'json', 'json': {'field': ['b']}, 'sensor': 'mag_3'}
    paths = {name: folder / f'{name}.yaml' for name in files}
    for name, path in paths.items():
        path.write_text(yaml.safe_dump(files[name]))
    return paths


class World:
    """The node processes, which a test may kill, and all messages that they publish."""

    def __init__(self, folder, broker, guarded, roadside, line):
        self.broker, self.guarded, self.roadside, self.line = broker, guarded, roadside, line
        self.network = network_file(folder)
        self.drivers = drivers_files(folder, broker, guarded, line)
        self.node, self._executor = Node('tester'), make_executor()
        self._executor.add_node(self.node)
        # `received`: {node: [(arrival [ns], message)]};
        # `statuses`: [(arrival [ns], DiagnosticStatus)].
        self._processes, self.received, self.statuses = {}, {name: [] for name in TOPICS}, []
        self.link = None
        for name, (kind, topic) in TOPICS.items():
            self._subscribe(kind, topic, STREAM_QOS, self.received[name].append)
        self._subscribe(DiagnosticArray, '/diagnostics', RESULT_QOS, lambda e: self.statuses.extend(
            (e[0], status) for status in e[1].status))

    def _subscribe(self, kind, topic, qos, callback):
        """Subscribe to a topic, and pass (arrival [ns], message) to `callback`."""
        self.node.create_subscription(
            kind, topic, lambda m: callback((time.time_ns(), m)), qos)

    def close(self):
        """Interrupt all processes as Ctrl-C does; return (exit codes, outputs)."""
        try:
            return stop(list(self._processes.values()))
        finally:
            self._executor.remove_node(self.node)
            self.node.destroy_node()
            self._executor.shutdown()

    def wait(self, condition, seconds=MAX_S):
        """Spin at 100 Hz until `condition()` is true or `seconds` have passed; return its last
        value."""
        end = time.monotonic() + seconds
        while not (value := condition()) and time.monotonic() < end:
            self._executor.spin_until_future_complete(Future(), 0.01)
        return value

    def pause(self, seconds):
        """Spin for `seconds`, so that messages are received."""
        self.wait(lambda: False, seconds)

    def start(self, name):
        """Start a node as a process with the parameters of this world."""
        parameters = {'driver_node': {'drivers': self.drivers[self.link]},
                      'tracker_node': POINT, **STEADY}[name]
        if name == 'detection_node':
            parameters = {'align.period_s': FRAME_S, **parameters}
        if name != 'driver_node':
            # The driver gets no network: it would refuse `mag_3` of the device `guarded`.
            parameters = {'network': self.network, **parameters}
        self._processes[name] = start(name, *(
            a for key, value in parameters.items() for a in ('-p', f'{key}:={value}')))

    def kill(self, name):
        """Kill a node by SIGKILL."""
        process = self._processes.pop(name)
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=MAX_S)
        # Messages still in transit belong to the killed node.
        self.pause(0.05)

    def publishers(self):
        """Identifiers of the discovered publishers of diagnostics; killed nodes may still be
        included."""
        return {tuple(p.endpoint_gid) for p in
                self.node.get_publishers_info_by_topic('/diagnostics')}

    def recovery(self, name):
        """Start a node; return (seconds until it is up, seconds from then to its first output)."""
        # A node is up when its publisher appears, or at its first output. The tracker has no output
        # without a vehicle, so the first frame that it counts is used instead.
        known, began_ns = self.publishers(), time.time_ns()
        self.start(name)
        up, first_ns = None, None
        while first_ns is None and time.time_ns() < began_ns + MAX_S * NS:
            self.pause(0.01)
            first_ns = self._first_ns(name, began_ns)
            if up is None and (first_ns or self.publishers() - known):
                up = (time.time_ns() - began_ns) / NS
        assert first_ns is not None, f'{name} has no output'
        up = min(up, (first_ns - began_ns) / NS)
        return up, (first_ns - began_ns) / NS - up

    def _first_ns(self, name, since_ns):
        """Time [ns] of the first output of a node after `since_ns`; None without an output."""
        if name != 'tracker_node':
            return next((arrival for arrival, _ in self.messages_since(since_ns, name)), None)
        for arrival, status in self.statuses_since(since_ns, 'tracker_node: track'):
            frames = next((int(v.value) for v in status.values if v.key == 'frames'), 0)
            if frames:
                return arrival - round(frames * FRAME_S * NS)
        return None

    def use_link(self, link):
        """Restart the driver with `link`, 'mqtt' or 'serial', and wait for its first output."""
        if link == self.link:
            return
        if self.link is not None:
            codes, outputs = stop([self._processes.pop('driver_node')])
            assert codes == [0], outputs
        self.link, began_ns = link, time.time_ns()
        self.start('driver_node')
        assert self.wait(lambda: self.messages_since(began_ns, 'driver_node'))

    def messages_since(self, since_ns, name):
        """Messages of a node that arrived after `since_ns`, as [(arrival [ns], message)]."""
        return [entry for entry in self.received[name] if entry[0] > since_ns]

    def statuses_since(self, since_ns, name, *words):
        """Select the received statuses `name` after `since_ns` that contain all `words`.

        Returns [(arrival [ns], DiagnosticStatus)].
        """
        return [(arrival, s) for arrival, s in self.statuses
                if arrival > since_ns and s.name == name
                and all(word in s.message for word in words)]

    def tracks(self, since_ns):
        """List the `Track`s with a timestamp after `since_ns`."""
        # On a busy machine, poses of the previous vehicle arrive while the next one is passing.
        tracks = (track_of(t) for _, m in self.messages_since(since_ns, 'tracker_node')
                  for t in m.tracks)
        return [t for t in tracks if t.stamp_ns > since_ns]

    def is_quiet(self):
        """Whether the latest vehicle has left and the detection has ended."""
        frames = self.received['detection_node']
        return frames and not frames[-1][1].target_present and self.roadside.is_gone()

    def start_vehicle(self):
        """Start a vehicle after the previous vehicle has left; return the start time [ns]."""
        assert self.wait(self.is_quiet)
        self.roadside.start_vehicle()
        return time.time_ns()

    def drive_to(self, x):
        """Spin until the vehicle is at `x` [m]."""
        assert self.wait(lambda: self.roadside.truth(time.time_ns())[0] >= x)

    def wrong_poses(self, since_ns):
        """List the wrong poses with a timestamp after `since_ns`."""
        return [t for t in self.tracks(since_ns)
                if not t.ended and is_wrong(t, self.roadside.truth(t.stamp_ns))]


def is_wrong(track, truth):
    """Whether a pose is unflagged and its NEES exceeds `MAX_NEES`."""
    e = track.position[:2] - truth
    return not track.ambiguous and e @ np.linalg.solve(track.covariance[:2, :2], e) > MAX_NEES


@contextmanager
def world(folder):
    """Run a `World` with all nodes, which must exit cleanly."""
    line = SerialLine(folder / 'port')
    own = folder / 'guarded'
    own.mkdir()
    with Broker(folder) as broker, Broker(
            own, *password_lines(own, 'somebody', 'secret')) as guarded, Roadside(
            read_network(network_file(folder)), BODY, broker.port, line) as roadside:
        init_ros()
        running_world = World(folder, broker, guarded, roadside, line)
        try:
            running_world.use_link('mqtt')
            for name in list(TOPICS)[1:]:
                running_world.start(name)
            assert running_world.wait(lambda: running_world.received['detection_node'])
            yield running_world
        finally:
            codes, outputs = running_world.close()
            rclpy.try_shutdown()
        assert not any(codes), outputs
        assert not any('Traceback' in text for text in outputs), outputs
