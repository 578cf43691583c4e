"""What the tests share: recordings, networks, a short way through the pipeline."""

import os
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from mag_tracking.io.bag import Recording
from mag_tracking.io.importers import import_pose_table
from mag_tracking.io.network_file import read_network
from mag_tracking.network import SensorNetwork
from mag_tracking.offline import replay
from mag_tracking.pipeline import settings_for

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / 'test' / 'data'
VEHICLES = sorted(p.stem for p in (DATA / 'vehicles').glob('*.mcap'))
NETWORK_FILE = ROOT / 'config' / 'network.yaml'

POINT = {f'track.vehicle.{name}': [value] for name, value in {
    'kinds': 'car', 'lengths': 0.0, 'length_stds': 0.0, 'moments': 400.0, 'moment_stds': 150.0,
    'difference_stds': 0.0, 'heights': 0.5, 'height_stds': 0.2,
    'near_field_lengths': 1.0}.items()}
"""Settings of a tracker that knows point targets only."""

# Keep the middleware to this machine, and apart from other runs on it.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)
# What nodes keep and log is no business of who runs the tests.
_HOME = tempfile.TemporaryDirectory(prefix='mag_tracking_test_')
os.environ['ROS_HOME'] = _HOME.name


def studied(names, kept=(), also=lambda name: ()):
    """Parameters: those in `kept` for every `make test`, the others for `make studies`; `also`
    gives further marks."""
    return [pytest.param(name, marks=[*also(name), *([] if name in kept else [pytest.mark.study])])
            for name in names]


def pytest_collection_modifyitems(items):
    """Tests of nodes and of what is killed in time are not run beside others (`make test`)."""
    for item in items:
        if any(word in item.path.stem for word in ('node', 'record')) \
                and item.path.stem != 'test_recordings':
            item.add_marker('alone')


@pytest.fixture(scope='session')
def road_network():
    return read_network(NETWORK_FILE)


@pytest.fixture(scope='session')
def magnet_runs(tmp_path_factory):
    """{run: (recording path, network path)} of the imported magnet tables."""
    folder = tmp_path_factory.mktemp('magnet')
    source = DATA / 'magnet_16_sensors'
    return {n: import_pose_table(source / f'lisa_data{n}.csv',
                                 source / f'lisa_data{n}_background.csv',
                                 folder / f'run{n}', 1e-6)[:2] for n in (1, 2)}


def vehicle_path(name):
    return DATA / 'vehicles' / f'{name}.mcap'


@pytest.fixture(scope='session')
def vehicle_replays(tmp_path_factory, road_network):
    """{name: (Run, folder)}: a bundled vehicle recording, replayed with the defaults when it is
    first asked for."""
    out = tmp_path_factory.mktemp('replays')

    class Replays(dict):
        def __missing__(self, name):
            self[name] = replay(Recording(vehicle_path(name)), road_network,
                                settings_for('vehicle'), out / name), out / name
            return self[name]

    return Replays()


@pytest.fixture(scope='session')
def magnet_replays(tmp_path_factory, magnet_runs):
    """{run: (Run, folder)} of the magnet recordings."""
    out = tmp_path_factory.mktemp('magnet_replays')
    return {n: (replay(Recording(recording), read_network(network), settings_for('magnet'),
                       out / str(n)), out / str(n))
            for n, (recording, network) in magnet_runs.items()}


def line_network(n, spacing=9.0, earth=(2e-6, 1.55e-5, -4.9e-5), noise=1.2e-8, tilt=0.3):
    """`n` sensors across and along a road, each turned differently."""
    rng = np.random.default_rng(n)
    positions = np.zeros((n, 3))
    positions[:, 0] = spacing * (np.arange(n) // 2)
    positions[:, 1] = np.where(np.arange(n) % 2, 4.5, -4.5)
    from mag_tracking.geometry import quaternion_from_rotation_vector, rotation_from_quaternion
    R = rotation_from_quaternion(
        quaternion_from_rotation_vector(tilt * rng.standard_normal((n, 3))))
    names = tuple(f'mag_{i + 1}' for i in range(n))
    return SensorNetwork(names, positions, R, tuple(f'/{name}/imu/mag' for name in names),
                         earth_field=np.array(earth), noise_std=(np.full(3, noise),) * n)


@pytest.fixture
def ros():
    """A node of the test's own in an executor: (node, spin_until)."""
    # Only the tests of the nodes need ROS.
    import rclpy
    from rclpy.node import Node

    from mag_tracking.nodes.middleware import begin
    from mag_tracking.nodes.stage_node import make_executor, spin
    begin()
    node, executor = Node('tester'), make_executor()
    executor.add_node(node)

    def spin_until(condition, seconds=30.0):
        end = time.monotonic() + seconds
        spin(executor, lambda: condition() or time.monotonic() > end)
        return condition()

    yield node, spin_until
    executor.remove_node(node)
    node.destroy_node()
    executor.shutdown()
    rclpy.try_shutdown()
