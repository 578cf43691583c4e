"""Listeners: a command opens only the ports that its user requested, on the loopback interface."""

import ipaddress
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time

import psutil
import pytest

from mag_tracking.cli.commands import COMMANDS
from support.archives import archive_recordings, command, wait_for
from support.bundled import DATA, NETWORK_FILE, QUICK, parameter_file, vehicle_path
from support.mqtt_broker import free_port
from support.node_processes import MAX_S

RECORDING, NETWORK = str(vehicle_path('straight_car_right')), ['--network', str(NETWORK_FILE)]
LOOPBACK = '127.0.0.1'

WITHOUT_UDP = '''<dds xmlns="http://www.eprosima.com"><profiles>
<transport_descriptors><transport_descriptor>
<transport_id>shared</transport_id><type>SHM</type>
</transport_descriptor></transport_descriptors>
<participant profile_name="quiet" is_default_profile="true"><rtps>
<userTransports><transport_id>shared</transport_id></userTransports>
<useBuiltinTransports>false</useBuiltinTransports>
</rtps></participant></profiles></dds>'''
"""Profile with which Fast DDS opens no sockets, so that all sockets belong to this package. With
ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, rmw_fastrtps adds UDP to every profile."""

DRIVERS = '''board: {{transport: udp, udp: {{port: {port}, address: 127.0.0.1}}, framing: text,
        text: {{fields: [x, y, z]}}, unit: nT, sensor: mag_1}}
'''


@pytest.fixture
def environment(tmp_path):
    """Environment of a process whose ROS middleware opens no sockets."""
    (tmp_path / 'dds.xml').write_text(WITHOUT_UDP)
    return os.environ | {'FASTRTPS_DEFAULT_PROFILES_FILE': str(tmp_path / 'dds.xml'),
                         'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT'}


def listeners(process):
    """Listening sockets of a process and its descendants: {(protocol, address, port)}."""
    found = set()
    try:
        for member in [process, *process.children(recursive=True)]:
            for s in member.net_connections('inet'):
                if s.laddr and (s.type == socket.SOCK_DGRAM or s.status == psutil.CONN_LISTEN):
                    found.add(('udp' if s.type == socket.SOCK_DGRAM else 'tcp', *s.laddr))
    except psutil.NoSuchProcess:
        pass
    return found


def listeners_of(arguments, environment, expected):
    """Run a command until it has opened the expected listeners, and for one more second."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'mag_tracking.cli', *arguments], stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, env=environment | {'PYTHONUNBUFFERED': '1'})
    try:
        assert process.stdout.readline()
        found, tree = set(), psutil.Process(process.pid)
        wait_for(lambda: expected <= found | listeners(tree))
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            found |= listeners(tree)
            time.sleep(0.02)
        assert process.poll() is None
    finally:
        process.send_signal(signal.SIGINT)
        output = process.communicate(timeout=MAX_S)[0]
    assert b'Traceback' not in output, output
    return found


@pytest.mark.alone
@pytest.mark.parametrize('name, options, page, drivers', [
    ('replay', [RECORDING, *NETWORK, '--live', '--port'], True, False),
    ('ros watch', ['--port'], True, False),
    ('listen', [], False, True),
    ('run', [*NETWORK, '--drivers', 'drivers.yaml', '--web'], True, True),
    ('record', [*NETWORK, '--out', 'out'], False, False)])
def test_a_command_that_waits_listens_only_as_requested(
        tmp_path, monkeypatch, environment, name, options, page, drivers):
    port, device_port = free_port(), free_port(socket.SOCK_DGRAM)
    (tmp_path / 'drivers.yaml').write_text(DRIVERS.format(port=device_port))
    monkeypatch.chdir(tmp_path)
    expected = {('tcp', LOOPBACK, port)} if page else set()
    arguments = [*name.split(), *options] + [str(port)] * page
    if name == 'listen':
        arguments.append('drivers.yaml')
    if drivers:
        expected.add(('udp', LOOPBACK, device_port))
    assert listeners_of(arguments, environment, expected) == expected


def test_an_archive_listens_on_the_loopback_interface(tmp_path):
    """Workers of Dask communicate through sockets."""
    recordings = tmp_path / 'recordings'
    recordings.mkdir()
    archive_recordings(recordings)
    process = psutil.Popen(command(recordings, tmp_path / 'out', tmp_path, '--workers', '2'),
                           stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    found = set()
    while process.poll() is None:
        found |= listeners(process)
        time.sleep(0.02)
    # Scheduler and its HTTP server, two workers with an HTTP server each, and their supervisors.
    assert len(found) >= 8
    assert [s for s in found if not ipaddress.ip_address(s[1]).is_loopback] == []


ONE_BY_ONE = '''
import json, sys
sys.addaudithook(lambda event, arguments: event in ('socket.bind', 'socket.listen')
                 and print('opened:', event, arguments))
from mag_tracking.cli import main
for arguments in json.loads(sys.argv[1]):
    print(f'status of {arguments[0]}:', main([*arguments[0].split(), *arguments[1:]]))
'''


def test_commands_that_end_by_themselves_do_not_listen(tmp_path, environment):
    params = ['--params', str(parameter_file(tmp_path / 'quick.yaml', QUICK))]
    magnet = DATA / 'magnet_16_sensors' / 'lisa_data1.csv'
    (tmp_path / 'passes.csv').write_text('label,' + ','.join(f'x{k}' for k in range(20)) + '\n' + (
        ('car,' + ','.join(map(str, range(20))) + '\ntruck,' + ','.join(['1', '2'] * 10) + '\n')
        * 8))
    arguments_of = {
        'replay': [RECORDING, *NETWORK, *params, '--out', 'replay', '--tables',
                   'poses,passages,events'],
        'classes train': ['passes.csv', '--out', 'classes.json'],
        'classes evaluate': ['passes.csv'], 'doctor': [*NETWORK, '--live', '2'],
        'calibrate network': [RECORDING, *NETWORK, '--out', 'calibrated.yaml', '--report',
                              'c.html'],
        'calibrate tumble': [RECORDING, *NETWORK, '--out', 'tumbled.yaml'],
        'calibrate board': [str(magnet), *NETWORK, '--moment', '1', '--out', 'board.yaml'],
        'fit': [RECORDING, *NETWORK, '--out', 'fit'],
        'plan': [*NETWORK, '--target', 'car', '--grid', '9', '--out', 'plan'],
        'repair': [RECORDING], 'info': [RECORDING],
        'import': [str(magnet), '--background',
                   str(magnet.with_name('lisa_data1_background.csv')), '--out', 'magnet'],
        'ros topics': [], 'ros echo': ['/none', '--count', '1'], 'ros param': ['none'],
        'ros lifecycle': ['none'], 'classes predict': ['passes.csv', '--model', 'classes.json']}
    assert {*arguments_of, 'ros watch', 'listen', 'run', 'record', 'archive'} == {*COMMANDS}
    finished = subprocess.run(
        [sys.executable, '-c', ONE_BY_ONE, json.dumps([[n, *a] for n, a in arguments_of.items()])],
        cwd=tmp_path, env=environment, capture_output=True, text=True)
    statuses = re.findall(r'status of (.+): \d', finished.stdout)
    assert statuses == [*arguments_of], finished.stderr
    assert 'opened:' not in finished.stdout
