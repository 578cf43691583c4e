"""Latency of the middleware alone: a chain of four bare rclpy nodes.

    PYTHONPATH=test python -m bench.chain [--seconds 60]

A source publishes a message of a hundred readings at 100 Hz, two nodes forward it, and the last
node publishes a pose for every eighth message. The figure is the delay of a pose after its readings
were sent, by the clock of this machine. It is the reference for `bench.load`, whose nodes also
process the readings. There is no aim.
"""

import argparse
import os
import signal
import subprocess
import sys
import time

import numpy as np

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
os.environ.setdefault('ROS_DOMAIN_ID', str(101 + os.getpid() % 100))
N_SENSORS, RATE, DECIMATION = 100, 100.0, 8
ROLES = ('last', 'second', 'first', 'source')


def readings(k):
    """Create a `FieldReadings` message with covariances."""
    from mag_tracking_msgs.msg import FieldReadings

    from mag_tracking.messages.schema import readings_dict
    from mag_tracking.nodes.convert import to_message
    from mag_tracking.records import Readings
    return to_message(FieldReadings, readings_dict(Readings(
        tuple(f'mag_{i + 1}' for i in range(N_SENSORS)), np.arange(N_SENSORS),
        np.full(N_SENSORS, time.time_ns()), np.full((N_SENSORS, 3), 1e-9 * k),
        np.tile(1e-16 * np.eye(3), (N_SENSORS, 1, 1)))))


def run_node(role):
    """Run the node of a role until it is stopped."""
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from mag_tracking_msgs.msg import FieldReadings

    from mag_tracking.interrupts import recorded_signals
    from mag_tracking.nodes.middleware import init_ros, make_executor, spin
    from mag_tracking.nodes.stage_node import STREAM_QOS
    init_ros()
    node, executor, count = rclpy.create_node(f'chain_{role}'), make_executor(), [0]
    out = {'last': 'pose', 'second': 'c', 'first': 'b', 'source': 'a'}[role]
    kind = PoseWithCovarianceStamped if role == 'last' else FieldReadings
    publisher = node.create_publisher(kind, f'/chain/{out}', STREAM_QOS)

    def forward(message):
        count[0] += 1
        if role != 'last':
            publisher.publish(message)
        elif count[0] % DECIMATION == 0:
            publisher.publish(PoseWithCovarianceStamped(header=message.header))

    if role == 'source':
        node.create_timer(1.0 / RATE, lambda: forward(readings(count[0])))
    else:
        source = {'last': 'c', 'second': 'b', 'first': 'a'}[role]
        node.create_subscription(FieldReadings, f'/chain/{source}', forward, STREAM_QOS)
    executor.add_node(node)
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as seen:
        spin(executor, lambda: bool(seen))


def main():
    """Run the benchmark, or the node of one role."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--role', choices=ROLES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role:
        return run_node(args.role)
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped

    from mag_tracking.nodes.middleware import init_ros, make_executor, spin
    from mag_tracking.nodes.stage_node import STREAM_QOS
    init_ros()
    node, executor, delays = rclpy.create_node('chain'), make_executor(), []
    executor.add_node(node)
    node.create_subscription(
        PoseWithCovarianceStamped, '/chain/pose', lambda m: delays.append(
            time.time() - m.header.stamp.sec - m.header.stamp.nanosec / 1e9), STREAM_QOS)
    processes = [subprocess.Popen([sys.executable, __file__, '--role', role]) for role in ROLES]
    try:
        end = time.monotonic() + args.seconds + 5.0
        spin(executor, lambda: time.monotonic() > end)
    finally:
        for process in processes:
            process.terminate()
            process.wait(30.0)
    delays = 1e3 * np.array(delays[60:])
    from bench.figures import Figures
    figures = Figures('chain')
    figures.record('four bare nodes: pose after its readings, median', np.median(delays), 'ms')
    figures.record('four bare nodes: pose after its readings, 99 %', np.quantile(delays, 0.99),
                   'ms')
    figures.save()
    print(f'{len(delays)} poses of four bare nodes, delay after their readings were sent: median '
          f'{np.median(delays):.1f} ms, p99 {np.quantile(delays, 0.99):.1f} ms, worst '
          f'{delays.max():.1f} ms')


if __name__ == '__main__':
    sys.exit(main())
