"""Latency, CPU time and memory of the nodes with live sensors.

    PYTHONPATH=test python -m bench.load                         # 100 sensors x 100 Hz, ten minutes
    PYTHONPATH=test python -m bench.load --pages 10              # the same with ten live pages open
    PYTHONPATH=test python -m bench.load --sensors 2 --minutes 2 --lean  # 2 sensors, 126 hypotheses
                                --one-process --batches          # further options for minimum cost

Driver, calibration, detection and tracker run as processes; a simulator in the driver replaces the
hardware. The figures are the delay of a pose after the sample that completed its frame, by the
clock of this machine, the CPU time of all nodes, their memory growth, and the number of loss
counters that increased.
The aim is a median delay of 10 ms, or 5 ms with all nodes in one process, without losses. The exit
status is 1 if a sample or a frame is lost.
"""

import argparse
import gc
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from bench.figures import Figures

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_DOMAIN_ID', str(101 + os.getpid() % 100))
ROOT = Path(__file__).resolve().parents[2]
NODES = ('calibration_node', 'detection_node', 'tracker_node', 'driver_node')
RATE, PERIOD_S = 100.0, 0.08
"""Rate of each sensor [Hz], and period of the frames [s] (`align.period_s`)."""
WARM_UP_S = 20.0
BEGINS_AFTER_S = 0.5
"""Interval [s] after which a pose counts as the first pose of a new track."""
MAX_UNBATCHED_SENSORS, BATCH_S = 16, 0.002
"""Maximum number of sensors without batches; duration of a batch [s] if sensors take turns."""
LEAN = {'arrival_names': "['left']", 'arrival_headings_deg': '[0.0]'}
"""Settings with one kind of vehicle and one arrival direction, for which all 126 hypotheses
(3 offsets x 14 moments x 3 speeds) are kept."""


def network_yaml(n):
    """Content of a network file with `n` sensors in pairs along a road."""
    rows = [f'  mag_{i + 1}: {{position: [{9.0 * (i // 2)}, {4.5 if i % 2 else -4.5}, 0.0], '
            'orientation: [0, 0, 0, 1], noise_std: 1.2e-8}' for i in range(n)]
    return '\n'.join(['frame: map', 'earth_field: [2.0e-6, 1.55e-5, -4.9e-5]', 'sensors:', *rows,
                      ''])


def drivers_yaml(n, network, sequential):
    """Content of a driver file that simulates a car at 20 m/s whenever the road is free."""
    batch_line = f'  batch_s: {BATCH_S}\n' if sequential and n > MAX_UNBATCHED_SENSORS else ''
    return (f'road:\n  device: simulator\n{batch_line}  simulator: {{network: {network}, '
            f'rate_hz: {RATE}, speed: 20.0, period_s: 5.0, offset: 1.0, '
            f'sequential: {str(sequential).lower()}}}\n  sensors: {{'
            + ', '.join(f'mag_{i + 1}: mag_{i + 1}' for i in range(n)) + '}\n')


def usage(process):
    """CPU time [s] and resident memory [MB] of a process."""
    fields = Path(f'/proc/{process.pid}/stat').read_text().rpartition(')')[2].split()
    cpu = (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
    return cpu, int(fields[21]) * os.sysconf('SC_PAGE_SIZE') / 1e6


class PoseMonitor:
    """Subscriber that records the latency of poses and the losses in diagnostics."""

    def __init__(self, node, sequential):
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseWithCovarianceStamped

        from mag_tracking.nodes.stage_node import STREAM_QOS
        self.delays, self.values, self.warnings, self._initial_losses = [], {}, {}, {}
        # Whether each pose is the first of a track.
        self.begins, self._stamp = [], 0.0
        self._unread = []
        # The timestamp of a frame is the mean of its samples. The sample that completes the frame
        # is later by half a frame and the time between the sensors.
        self._completed_s = PERIOD_S / 2.0 + (1.0 if sequential else 0.5) / RATE
        node.create_subscription(PoseWithCovarianceStamped, '/tracker_node/pose', self._record_pose,
                                 STREAM_QOS)
        # Diagnostics are parsed later, so that they do not delay the reception of poses.
        self._type = DiagnosticArray
        node.create_subscription(DiagnosticArray, '/diagnostics', self._unread.append, STREAM_QOS,
                                 raw=True)

    def _record_pose(self, message):
        """Record the delay of a pose after the sample that completed its frame."""
        stamp = message.header.stamp.sec + message.header.stamp.nanosec / 1e9
        self.delays.append(time.time() - stamp - self._completed_s)
        self.begins.append(stamp - self._stamp > BEGINS_AFTER_S)
        self._stamp = stamp

    def _parse_diagnostics(self):
        """Parse the received diagnostics, and store the latest values."""
        from rclpy.serialization import deserialize_message
        for raw in self._unread:
            for status in deserialize_message(raw, self._type).status:
                self.values[status.name] = {v.key: v.value for v in status.values}
                if status.level != b'\x00':
                    self.warnings[status.name] = status.message
        self._unread.clear()

    def begin(self):
        """Discard the warm-up, during which sensors near a car still learn their background."""
        self._initial_losses, self.delays, self.begins, self.warnings = \
            self._total_losses(), [], [], {}

    def losses(self):
        """Losses since `begin` by counter, without the counters that have not increased."""
        return {k: n - self._initial_losses.get(k, 0) for k, n in self._total_losses().items()
                if n != self._initial_losses.get(k, 0)}

    def _total_losses(self):
        """Number of losses since the start, by counter."""
        self._parse_diagnostics()
        return {f'{name}: {key}': int(value) for name, values in self.values.items()
                for key, value in values.items() if value and key.startswith(
                    ('rejected', 'lost', 'readings lost', 'frames with a sensor'))}


def start(folder, n, parameters, sequential, batches, is_one_process):
    """Start the nodes as processes, the driver last, or all nodes in one process."""
    network, drivers = folder / 'network.yaml', folder / 'drivers.yaml'
    network.write_text(network_yaml(n))
    drivers.write_text(drivers_yaml(n, network, sequential))
    if is_one_process:
        return {'all_in_one': subprocess.Popen(
            [Path(sys.executable).with_name('mag-tracking'), 'run', '--network', network,
             '--drivers', drivers, '--params', parameters,
             *(['--batches'] if batches or n > MAX_UNBATCHED_SENSORS else [])],
            stdout=subprocess.DEVNULL, stderr=sys.stderr)}
    processes = {}
    for node in NODES:
        options = ['-p', f'drivers:={drivers}',
                   '-p', f'batches:={str(batches or n > MAX_UNBATCHED_SENSORS).lower()}'] \
            if node == 'driver_node' else ['--params-file', str(parameters)]
        processes[node] = subprocess.Popen(
            [sys.executable, '-m', f'mag_tracking.nodes.{node}', '--ros-args', '-p',
             f'network:={network}', *options], stdout=subprocess.DEVNULL, stderr=sys.stderr)
        time.sleep(3.0 if node == 'tracker_node' else 0.0)
    return processes


def open_pages(n):
    """Start the server of the live page, and a process of `n` viewers that read all its data.

    Returns ({name: server process}, viewer process).
    """
    server = subprocess.Popen(
        [Path(sys.executable).with_name('mag-tracking'), 'ros', 'watch', '--port', '0'],
        stdout=subprocess.PIPE, text=True)
    url = server.stdout.readline().split()[-1]
    viewers = subprocess.Popen([sys.executable, '-m', 'support.page_viewers', url, str(n)],
                               stdout=subprocess.PIPE, text=True)
    return {'page': server}, viewers


def parameters_of(folder, lean):
    """Write the parameter file of the nodes; return its path."""
    text = (ROOT / 'config' / 'large_network.yaml').read_text()
    if lean:
        text = re.sub(r'max_hypotheses: \d+', 'max_hypotheses: 126', text) \
            + ''.join(f'        {key}: {value}\n' for key, value in LEAN.items())
    path = folder / 'parameters.yaml'
    path.write_text(text)
    return path


def watch(processes, monitor, executor, minutes):
    """Wait `minutes`; return [(t [s], {node: (CPU [s], memory [MB])})] for every ten seconds."""
    from mag_tracking.nodes.middleware import spin
    begin, rows = time.monotonic(), []
    while time.monotonic() - begin < 60.0 * minutes:
        until = begin + 10.0 * (len(rows) + 1)
        spin(executor, lambda until=until: time.monotonic() > until)
        if time.monotonic() < until:
            # Interrupted by Ctrl-C, which also stops the nodes.
            break
        rows.append((time.monotonic() - begin, {k: usage(p) for k, p in processes.items()}))
        print(f'{rows[-1][0]:6.0f} s  {len(monitor.delays):6d} poses  ' + '  '.join(
            f'{k.removesuffix("_node")} {mb:.0f} MB' for k, (_, mb) in rows[-1][1].items()),
            flush=True)
    return rows


def report(monitor, rows, figures, aim):
    """Print and record the results; return (99 % quantile of the latency [ms], has losses)."""
    delays = 1e3 * np.array(monitor.delays)
    if not len(delays):
        print('no pose was received')
    else:
        figures.record('pose after the last sample of its frame, median', np.median(delays), 'ms',
                       aim)
        figures.record('pose after the last sample of its frame, 99 %', np.quantile(delays, 0.99),
                       'ms')
        print(f'{len(delays)} poses, delay after the sample that completed the frame: median '
              f'{np.median(delays):.1f} ms, p99 {np.quantile(delays, 0.99):.1f} ms, '
              f'worst {delays.max():.1f} ms')
        begins = np.array(monitor.begins)
        first, rest = delays[begins], delays[~begins]
        if len(first) and len(rest):
            print(f'{len(first)} are the first pose of a track: median {np.median(first):.1f} '
                  f'ms, worst {first.max():.1f} ms; other poses: p99 {np.quantile(rest, 0.99):.1f} '
                  f'ms, worst {rest.max():.1f} ms')
    first, last = rows[0], rows[-1]
    minute = rows[min(len(rows) - 1, 5)]
    total = 0.0
    for node in last[1]:
        cpu_fraction = (last[1][node][0] - first[1][node][0]) / max(1e-9, last[0] - first[0])
        total += cpu_fraction
        print(f'{node}: {100.0 * cpu_fraction:.1f} % of a core, {last[1][node][1]:.1f} MB, '
              f'{last[1][node][1] - minute[1][node][1]:+.1f} MB since the first minute')
    print(f'all nodes: {100.0 * total:.1f} % of a core')
    figures.record('all nodes', 100.0 * total, '% of a core')
    figures.record('growth of the largest process after the first minute',
                   max(last[1][node][1] - minute[1][node][1] for node in last[1]), 'MB')
    losses = monitor.losses()
    figures.record('kinds of losses', len(losses), '', 0)
    figures.save()
    print(f'lost: {losses or "nothing"}')
    for text, n in Counter(monitor.warnings.values()).most_common(5):
        print(f'diagnostics of {n} components: {text}')
    return float(np.quantile(delays, 0.99)) if len(delays) else float('nan'), bool(losses)


def main():
    """Run the benchmark; return 1 after losses or an early interruption."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--sensors', type=int, default=100)
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument('--batches', action='store_true',
                        help='send readings in batches, as with many sensors')
    parser.add_argument('--one-process', action='store_true',
                        help='run all nodes in one process, as with `mag-tracking run`')
    parser.add_argument('--lean', action='store_true', help='track with 126 hypotheses')
    parser.add_argument('--sequential', action='store_true',
                        help='simulate sensors that measure in turn, not simultaneously')
    parser.add_argument('--pages', type=int, default=0, help='number of open live pages')
    found = measure(parser.parse_args())
    return 1 if found is None else int(found[1])


def name_of(args):
    """Name under which the figures of a run with these options are recorded."""
    return (f'load, {args.sensors} sensors'
            + (', one process' if args.one_process else ', four processes')
            + (f', {args.pages} pages' if args.pages else ''))


def measure(args):
    """Run the nodes; return the result of `report`, or None if interrupted within ten seconds."""
    import rclpy

    from mag_tracking.nodes.middleware import make_executor, spin
    # Initialised as in a user's subscriber, without the middleware profile of the nodes.
    rclpy.init()  # noqa: TID251
    node, executor = rclpy.create_node('load'), make_executor()
    executor.add_node(node)
    monitor = PoseMonitor(node, args.sequential)
    with tempfile.TemporaryDirectory() as folder:
        os.environ['ROS_HOME'] = folder
        # Garbage collection in this process must not increase the latency.
        gc.disable()
        processes = start(Path(folder), args.sensors, parameters_of(Path(folder), args.lean),
                          args.sequential, args.batches, args.one_process)
        pages, viewers = open_pages(args.pages) if args.pages else ({}, None)
        processes |= pages
        try:
            end = time.monotonic() + WARM_UP_S
            spin(executor, lambda: time.monotonic() > end)
            monitor.begin()
            rows = watch(processes, monitor, executor, args.minutes)
        finally:
            if viewers is not None:
                viewers.terminate()
                print(f'viewers: {viewers.communicate(timeout=30.0)[0].strip()}')
            for process in reversed(list(processes.values())):
                process.send_signal(2)
                process.wait(30.0)
    executor.remove_node(node)
    node.destroy_node()
    executor.shutdown()
    rclpy.try_shutdown()
    if not rows:
        return None
    return report(monitor, rows, Figures(name_of(args)), 5.0 if args.one_process else 10.0)


if __name__ == '__main__':
    sys.exit(main())
