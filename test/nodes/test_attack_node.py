"""Invalid calls to nodes: no file is overwritten, no node ends, each call gets a response."""

import os
from pathlib import Path

import numpy as np
import pytest
import rclpy
from mag_tracking_msgs.srv import Calibrate, Seek, Survey
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from mag_tracking.errors import SettingsError
from mag_tracking.nodes.calibration_node import CalibrationNode
from mag_tracking.nodes.middleware import init_ros
from mag_tracking.recording.background_file import write_backgrounds
from support.bundled import NETWORK_FILE, vehicle_path
from support.node_processes import MAX_S, start, stop

pytestmark = [pytest.mark.alone, pytest.mark.timeout(600)]

N_ATTACKS = 200
N_CONCURRENT = 40
ATTACK_PATHS = (
    '', '/', '.', '..', '/etc/passwd', '/dev/full', '/dev/null', '../../../../x.yaml',
    '~/.bashrc', 'a' * 5000, '/proc/self/mem', 'outside/theirs.yaml', '\n', '//', 'ä\u202e',
    '/nonexistent/dir/file.yaml', 'link.yaml', 'network.yaml')
NODES = ('calibration_node', 'detection_node', 'tracker_node', 'replay_node', 'driver_node')
READ_ONLY_PARAMETERS = {
    'calibration_node': ('network', 'save_as', 'state_file', 'target', 'reliable_input'),
    'detection_node': ('network', 'target'), 'tracker_node': ('network', 'target'),
    'replay_node': ('recording', 'topics', 'rate'),
    'driver_node': ('drivers', 'network', 'autostart')}


@pytest.fixture
def folders(tmp_path):
    """(folder of the network file, protected folder to which links in the first folder point)."""
    network_folder, protected = tmp_path / 'here', tmp_path / 'outside'
    network_folder.mkdir()
    protected.mkdir()
    (network_folder / 'network.yaml').write_text(NETWORK_FILE.read_text())
    for name in ('network_calibrated.yaml', 'network_calibrated.yaml.part', 'link.yaml'):
        (protected / name).write_text('theirs')
        (network_folder / name).symlink_to(protected / name)
    (network_folder / 'outside').symlink_to(protected)
    return network_folder, protected


def contents(*folders):
    """Content of all files in folders: {path: (bytes, whether the file is a link)}."""
    return {path: (path.read_bytes() if path.is_file() else b'', path.is_symlink())
            for folder in folders for path in sorted(Path(folder).rglob('*'))}


def start_nodes(network_folder, home):
    """Start {node: process}; the replay node plays a recording in a loop."""
    network = ['-p', f'network:={network_folder / "network.yaml"}']
    drivers = network_folder / 'drivers.yaml'
    drivers.write_text(NO_DEVICES)
    return {name: start(name, *arguments, home=home) for name, arguments in {
        'calibration_node': network, 'detection_node': network, 'tracker_node': network,
        'replay_node': ['-p', f'recording:={vehicle_path("straight_car_right")}',
                        '-p', 'loop:=true'],
        'driver_node': ['-p', f'drivers:={drivers}']}.items()}


NO_DEVICES = """
unused:
  transport: udp
  udp: {port: 47123, address: 127.0.0.1}
  framing: text
  text: {fields: [x, y, z]}
  unit: nT
  sensor: mag_9
"""


class Attacker:
    """Calls services; creates one client per service and reuses it."""

    def __init__(self, ros):
        self.node, self.spin_until = ros
        self._clients = {}

    def __call__(self, kind, name, request):
        """Call a service and return its response."""
        client = self._clients.get(name) or self.node.create_client(kind, name)
        self._clients[name] = client
        assert self.spin_until(client.service_is_ready), f'service {name} is missing'
        for _ in range(12):
            future = client.call_async(request)
            self.node.executor.spin_until_future_complete(future, 10.0)
            if future.done():
                return future.result()
        raise AssertionError(f'service {name} has not responded')


def set_parameters(call, node, pairs, atomically=False):
    """Set parameters of a node; return the results."""
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in pairs]
    kind, leaf = (SetParametersAtomically, 'set_parameters_atomically') if atomically else \
        (SetParameters, 'set_parameters')
    response = call(kind, f'/{node}/{leaf}', kind.Request(parameters=parameters))
    return [response.result] if atomically else response.results


def attack_once(call, rng, k):
    """Run attack `k`: set a read-only parameter or call services; check the responses."""
    node = NODES[k % len(NODES)]
    path = ATTACK_PATHS[int(rng.integers(len(ATTACK_PATHS)))]
    if k % 4 < 2:
        name = READ_ONLY_PARAMETERS[node][int(rng.integers(len(READ_ONLY_PARAMETERS[node])))]
        for result in set_parameters(call, node, [(name, path)], atomically=k % 4 == 1):
            assert not result.successful, (node, name, path)
    elif k % 4 == 2:
        response = call(Survey, '/calibration_node/survey', Survey.Request(save=True))
        assert isinstance(response.success, bool)
        response = call(Calibrate, '/calibration_node/calibrate',
                        Calibrate.Request(sensors=[path]))
        assert not response.success
    else:
        offset = float(rng.choice([-1.0, np.nan, np.inf, 1e300, 2.0]))
        response = call(Seek, '/replay_node/seek', Seek.Request(offset=offset))
        assert response.success == (offset == 2.0)


def send_concurrent_calls(ros):
    """Send many calls at once and assert that each gets a response."""
    node, spin_until = ros
    clients = [(node.create_client(kind, name), request) for kind, name, request in (
        (Survey, '/calibration_node/survey', Survey.Request(save=True)),
        (Calibrate, '/calibration_node/calibrate', Calibrate.Request(sensors=['unknown'])),
        (Trigger, '/replay_node/pause', Trigger.Request()),
        (GetParameters, '/tracker_node/get_parameters', GetParameters.Request(names=['network'])),
        (Trigger, '/replay_node/resume', Trigger.Request()))
        for _ in range(N_CONCURRENT // 5)]
    assert spin_until(lambda: all(c.service_is_ready() for c, _ in clients))
    # A server may discover a client later than the client discovers the server.
    spin_until(lambda: False, 2.0)
    futures = [client.call_async(request) for client, request in clients]
    assert spin_until(lambda: all(f.done() for f in futures), MAX_S), sum(
        f.done() for f in futures)
    client, request = clients[0]
    futures = [client.call_async(request) for _ in range(N_CONCURRENT)]
    assert spin_until(lambda: all(f.done() for f in futures), MAX_S), sum(
        f.done() for f in futures)
    for client, _ in clients:
        node.destroy_client(client)


def test_nodes_survive_an_attack(ros, folders, tmp_path):
    network_folder, protected = folders
    node, spin_until = ros
    home = tmp_path / 'home'
    home.mkdir()
    processes = start_nodes(network_folder, home)
    try:
        assert spin_until(lambda: set(NODES) <= set(node.get_node_names()))
        before, attack = contents(network_folder, protected), Attacker(ros)
        # Only one file may be written; it replaces a link.
        successes = []
        assert spin_until(lambda: successes.append(attack(
            Survey, '/calibration_node/survey', Survey.Request(save=True)).success)
            or any(successes))
        rng = np.random.default_rng(0)
        for k in range(N_ATTACKS):
            attack_once(attack, rng, k)
        send_concurrent_calls(ros)
        assert not [name for name, p in processes.items() if p.poll() is not None]
        after = contents(network_folder, protected)
    finally:
        exit_codes, outputs = stop(list(processes.values()))
    assert not any(exit_codes), outputs
    assert not any('Traceback' in text for text in outputs), outputs
    changed = {p for p in before.keys() | after.keys() if before.get(p) != after.get(p)}
    assert changed == {network_folder / 'network_calibrated.yaml'}
    assert not (network_folder / 'network_calibrated.yaml').is_symlink()
    written = [p.relative_to(home) for p in home.rglob('*') if p.is_file()]
    assert all(p.parts[0] in ('mag_tracking', 'log') for p in written), written


@pytest.mark.parametrize('parameter', ['save_as', 'state_file'])
@pytest.mark.parametrize('name, message', [
    ('/etc/x.yaml', 'folder of'),
    ('../x.yaml', 'folder of'),
    ('outside/x.yaml', 'folder of'), ('..', 'file name'),
    ('network.yaml', 'network file')])
def test_a_file_outside_the_folder_is_refused_at_start(folders, parameter, name, message):
    network_folder, protected = folders
    with pytest.raises(SettingsError, match=message):
        create_node(network_folder, parameter, name)
    assert set(os.listdir(protected)) == {'network_calibrated.yaml', 'network_calibrated.yaml.part',
                                          'link.yaml'}


def create_node(network_folder, parameter, name):
    """Create and destroy a calibration node with a file name as the value of a parameter."""
    init_ros()
    try:
        node = CalibrationNode(parameter_overrides=[
            Parameter('network', value=str(network_folder / 'network.yaml')),
            Parameter(parameter, value=name)])
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


def test_a_file_without_backgrounds_is_refused_as_state_file(folders):
    network_folder, _ = folders
    (network_folder / 'notes.txt').write_text('theirs')
    with pytest.raises(SettingsError, match='background file'):
        create_node(network_folder, 'state_file', 'notes.txt')
    write_backgrounds(network_folder / 'kept.json', {})
    create_node(network_folder, 'state_file', 'kept.json')
    create_node(network_folder, 'state_file', 'new.json')
