"""A world for tests of faults: a roadside, a broker, a serial line, and the nodes as processes."""

import signal
import time
from contextlib import contextmanager

import numpy as np
import rclpy
import yaml
from conftest import NETWORK_FILE, POINT
from diagnostic_msgs.msg import DiagnosticArray
from mag_tracking_msgs.msg import NetworkFrame, TrackArray
from mqtt_broker import Broker
from node_processes import start, stop
from rclpy.node import Node
from rclpy.task import Future
from roadside import NOISE, Roadside
from scipy.stats import chi2
from sensor_msgs.msg import MagneticField
from serial_line import SerialLine

from mag_tracking.io.network_file import read_network
from mag_tracking.io.simulator import point_body
from mag_tracking.nodes.convert import track_of
from mag_tracking.nodes.stage_node import RESULTS, STREAM, make_executor

WRONG = chi2.ppf(1.0 - 1e-4, 2)
"""A pose whose squared error is beyond this, in its own covariance, is wrong."""
TOPICS = {'driver_node': (MagneticField, '/mag_1/imu/mag'),
          'calibration_node': (MagneticField, '/mag_1/imu/mag_calibrated'),
          'detection_node': (NetworkFrame, '/detection_node/frame'),
          'tracker_node': (TrackArray, '/tracker_node/tracks')}
"""What each node gives."""


def network_file(folder):
    """A copy of the network of the road with noise and backgrounds, so that nothing is learnt."""
    content = yaml.safe_load(NETWORK_FILE.read_text())
    for sensor in content['sensors'].values():
        sensor.update(noise_std=NOISE, background=content['earth_field'])
    path = folder / 'network.yaml'
    path.write_text(yaml.safe_dump(content))
    return path


def drivers_files(folder, host_port, line):
    """{name: path} of the files of one device: `mqtt` and `serial`."""
    common = {'clock': {'tick_s': 1e-6, 'wrap': 0}, 'unit': 'nT'}
    content = {
        'mqtt': {'transport': 'mqtt', 'framing': 'json',
                 'mqtt': {'host': '127.0.0.1', 'port': host_port, 'topics': ['road/+']},
                 'json': {'field': ['x', 'y', 'z'], 'ticks': 't', 'sequence': 'n'},
                 'sensors': {'road/A': 'mag_1', 'road/B': 'mag_2'}},
        'serial': {'transport': 'serial', 'framing': 'text', 'serial': {'port': str(line.path)},
                   'text': {'fields': ['sensor', 'sequence', 'ticks', 'x', 'y', 'z'],
                            'checksum': 'nmea'},
                   'sensors': {'A': 'mag_1', 'B': 'mag_2'}}}
    paths = {}
    for name, entry in content.items():
        paths[name] = folder / f'{name}.yaml'
        paths[name].write_text(yaml.safe_dump({name: {**entry, **common}}))
    return paths


class World:
    """The nodes, which may be killed, and all that is heard of them.

    Attributes
    ----------
    heard : {node: [(came_ns, message)]}
        Of the topics in `TOPICS`.
    statuses : [(came_ns, DiagnosticStatus)]
    """

    def __init__(self, folder, broker, roadside, line):
        self.broker, self.roadside = broker, roadside
        self.network = network_file(folder)
        self.drivers = drivers_files(folder, broker.port, line)
        self.node, self._executor = Node('tester'), make_executor()
        self._executor.add_node(self.node)
        self._processes, self.heard, self.statuses = {}, {name: [] for name in TOPICS}, []
        self.link = None
        for name, (kind, topic) in TOPICS.items():
            self._listen(kind, topic, STREAM, self.heard[name].append)
        self._listen(DiagnosticArray, '/diagnostics', RESULTS, lambda heard: self.statuses.extend(
            (heard[0], status) for status in heard[1].status))

    def _listen(self, kind, topic, qos, take):
        """Have `take` called with (when it came [ns], message)."""
        self.node.create_subscription(
            kind, topic, lambda m: take((time.time_ns(), m)), qos)

    def close(self):
        """End what runs, as Ctrl-C does; (exit codes, outputs)."""
        try:
            return stop(list(self._processes.values()))
        finally:
            self._executor.remove_node(self.node)
            self.node.destroy_node()
            self._executor.shutdown()

    def wait(self, condition, seconds):
        """Listen until there is something in what `condition` gives: that, or what it gives last.

        It is asked a hundred times a second, and what it gives is worth as much in time.
        """
        end = time.monotonic() + seconds
        while not (found := condition()) and time.monotonic() < end:
            self._executor.spin_until_future_complete(Future(), 0.01)
        return found

    def pause(self, seconds):
        """Listen for a while."""
        self.wait(lambda: False, seconds)

    def start(self, name, *arguments):
        """Start a node as a process."""
        self._processes[name] = start(name, '-p', f'network:={self.network}', *arguments)

    def start_again(self, name):
        """Start a node with what it is given in this world."""
        given = {'tracker_node': POINT, 'calibration_node': {'calibrate.learn_s': 3600.0},
                 'driver_node': {'drivers': self.drivers[self.link]}}.get(name, {})
        self.start(name, *(a for key, value in given.items() for a in ('-p', f'{key}:={value}')))

    def kill(self, name):
        """End a node without a word."""
        process = self._processes.pop(name)
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=10)
        # What is still on its way is of the dead.
        self.pause(0.05)

    def endpoints(self, name):
        """The publishers that nodes of this name have announced, also of the dead."""
        return {tuple(p.endpoint_gid) for p in self.node.get_publishers_info_by_topic(
            '/diagnostics') if p.node_name == name}

    def use(self, link):
        """Have the driver listen to `link`, 'mqtt' or 'serial'."""
        if link == self.link:
            return
        if self.link is not None:
            codes, outputs = stop([self._processes.pop('driver_node')])
            assert codes == [0], outputs
        self.link = link
        self.start_again('driver_node')

    def since(self, came_ns, name):
        """[(came_ns, message)] of a node since then."""
        return [h for h in self.heard[name] if h[0] > came_ns]

    def told(self, since_ns, name, *words):
        """[(came_ns, DiagnosticStatus)] of a name since then that have all the `words`."""
        return [(came, s) for came, s in self.statuses if came > since_ns and s.name == name
                and all(word in s.message for word in words)]

    def tracks(self, since_ns):
        """[Track] that have come since then."""
        return [track_of(t) for _, m in self.since(since_ns, 'tracker_node') for t in m.tracks]

    def rows(self, since_ns):
        """[(stamp_ns, id, error [m], squared error in deviations, ambiguous)] of the poses."""
        out = []
        for t in self.tracks(since_ns):
            if not t.ended:
                e = t.position[:2] - self.roadside.truth(t.stamp_ns)
                out.append((t.stamp_ns, t.id, float(np.linalg.norm(e)),
                            float(e @ np.linalg.solve(t.covariance[:2, :2], e)), t.ambiguous))
        return out


@contextmanager
def world(folder):
    """A `World` whose nodes run and give frames; at the end all have to end cleanly."""
    line = SerialLine(folder / 'port')
    network = read_network(network_file(folder))
    body = point_body([0.0, 300.0, -300.0], 5.0, 0.5)
    rclpy.init()
    try:
        with Broker(folder) as broker, Roadside(network, body, broker.port, line) as roadside:
            here = World(folder, broker, roadside, line)
            try:
                here.use('mqtt')
                for name in list(TOPICS)[1:]:
                    here.start_again(name)
                assert here.wait(lambda: here.heard['detection_node'], 30.0)
                yield here
            finally:
                codes, outputs = here.close()
            assert not any(codes), outputs
            assert not any('Traceback' in text for text in outputs), outputs
    finally:
        rclpy.try_shutdown()
