"""Fixtures, environment variables and order of execution of the tests."""

import os
import signal
import tempfile
import time

import pytest

from mag_tracking.apps.replay import replay
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.pose_table import import_pose_table
from mag_tracking.recording.reader import Recording
from support.bundled import DATA, NETWORK_FILE, ROOT, vehicle_path
from support.ros_domain import RosDomain

# Restrict the middleware to this machine, and separate it from other test runs.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
DOMAIN = RosDomain()
os.environ['ROS_DOMAIN_ID'] = str(DOMAIN.number)
# A background job of a shell ignores SIGINT, and its child processes inherit this setting.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Nodes must not write to the home folder of the user who runs the tests.
_ROS_HOME = tempfile.TemporaryDirectory(prefix='mag_tracking_test_')
os.environ['ROS_HOME'] = _ROS_HOME.name


LONGEST_FILES = (
    'test_site.py', 'test_wheel.py', 'test_busy.py', 'test_pass_fit.py', 'test_archive.py',
    'test_archive_faults.py', 'test_traffic.py', 'test_situations.py', 'test_cli.py',
    'test_nodes.py', 'test_node_faults.py', 'test_shutdown.py', 'test_health_node.py')
"""Files with the longest run times; files without nodes come first."""


def pytest_collection_modifyitems(items):
    """Mark the node tests as `alone`, and start the files with the longest run times first."""
    for item in items:
        if item.path.is_relative_to(ROOT / 'test' / 'nodes'):
            item.add_marker('alone')
    items.sort(key=lambda item: LONGEST_FILES.index(item.path.name)
               if item.path.name in LONGEST_FILES else len(LONGEST_FILES))


@pytest.fixture(scope='session')
def road_network():
    return read_network(NETWORK_FILE)


@pytest.fixture(scope='session')
def magnet_runs(tmp_path_factory):
    """Import the bundled magnet tables: {run: (recording path, network path)}."""
    folder = tmp_path_factory.mktemp('magnet')
    source = DATA / 'magnet_16_sensors'
    return {n: import_pose_table(source / f'lisa_data{n}.csv',
                                 source / f'lisa_data{n}_background.csv',
                                 folder / f'run{n}', 1e-6)[:2] for n in (1, 2)}


@pytest.fixture(scope='session')
def vehicle_replays(tmp_path_factory, road_network):
    """Replay bundled vehicle recordings on first access: {name: (Run, folder)}."""
    out = tmp_path_factory.mktemp('replays')

    class Replays(dict):
        def __missing__(self, name):
            self[name] = replay(Recording(vehicle_path(name)), road_network,
                                settings_for('vehicle'), out / name), out / name
            return self[name]

    return Replays()


@pytest.fixture(scope='session')
def magnet_replays(tmp_path_factory, magnet_runs):
    """Replay the magnet recordings: {run: (Run, folder)}."""
    out = tmp_path_factory.mktemp('magnet_replays')
    return {n: (replay(Recording(recording), read_network(network), settings_for('magnet'),
                       out / str(n)), out / str(n))
            for n, (recording, network) in magnet_runs.items()}


@pytest.fixture
def ros():
    """Yield (node, spin_until): `spin_until` waits for a condition, at most for `seconds`."""
    # Imported here because only the node tests require ROS.
    import rclpy
    from rclpy.node import Node

    from mag_tracking.nodes.middleware import init_ros, make_executor, spin
    from support.node_processes import MAX_S
    init_ros()
    node, executor = Node('tester'), make_executor()
    executor.add_node(node)

    def spin_until(condition, seconds=MAX_S):
        end = time.monotonic() + seconds
        spin(executor, lambda: condition() or time.monotonic() > end)
        return condition()

    yield node, spin_until
    executor.remove_node(node)
    node.destroy_node()
    executor.shutdown()
    rclpy.try_shutdown()
