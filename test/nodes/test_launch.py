"""The launch file: run where `launch_ros` can be had, else executed against a stand-in.

PyPI's `launch` is another package. The stand-in keeps what the file makes; every name in it is
then compared with what the package has: executables, parameters, arguments, files.
"""

import importlib.util
import signal
import subprocess
import sys
import threading
import types
from collections.abc import Mapping

import pytest
import setuptools

from mag_tracking.nodes.ros_params import NODE_PARAMETERS
from support.bundled import NETWORK_FILE, ROOT, vehicle_path
from support.node_processes import MAX_S

LAUNCH_FILE = ROOT / 'launch' / 'tracking.launch.py'
HAS_LAUNCH = importlib.util.find_spec('launch_ros') is not None
CLASSES = {
    'launch': ('LaunchDescription',), 'launch.actions': ('DeclareLaunchArgument',),
    'launch.conditions': ('IfCondition',), 'launch_ros.actions': ('Node',),
    'launch.substitutions': ('LaunchConfiguration', 'NotEqualsSubstitution',
                             'PathJoinSubstitution'),
    'launch_ros.parameter_descriptions': ('ParameterValue',),
    'launch_ros.substitutions': ('FindPackageShare',)}
"""{module: classes} that the launch file imports."""


class Made:
    """An object of the stand-in: its class, and what it was made of."""

    def __init__(self, name, arguments, named):
        self.name, self.arguments, self.named = name, arguments, named

    def __iter__(self):
        raise TypeError(f'{self.name} is not iterable')


def within(thing):
    """All `Made` in a thing."""
    if isinstance(thing, Made):
        yield thing
        for part in (*thing.arguments, *thing.named.values()):
            yield from within(part)
    elif isinstance(thing, Mapping):
        for part in thing.values():
            yield from within(part)
    elif isinstance(thing, (list, tuple)):
        for part in thing:
            yield from within(part)


@pytest.fixture
def made(monkeypatch):
    """[Made] of the launch file."""
    for module in ('launch', 'launch_ros', *CLASSES):
        monkeypatch.setitem(sys.modules, module, types.ModuleType(module))
    for module, names in CLASSES.items():
        for name in names:
            setattr(sys.modules[module], name, lambda *a, _name=name, **n: Made(_name, a, n))
    spec = importlib.util.spec_from_file_location('tracking_launch', LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return list(within(module.generate_launch_description()))


@pytest.fixture
def executables(monkeypatch):
    """Names of the scripts that setup.py installs."""
    given = {}
    monkeypatch.setattr(setuptools, 'setup', lambda **named: given.update(named))
    monkeypatch.chdir(ROOT)
    exec(compile((ROOT / 'setup.py').read_text(), 'setup.py', 'exec'), {'__name__': 'setup'})
    return {line.split('=')[0].strip() for line in given['entry_points']['console_scripts']}


def of(made, name):
    """Those of a class."""
    return [m for m in made if m.name == name]


def test_every_name_in_the_launch_file_exists(made, executables):
    nodes = of(made, 'Node')
    assert len(nodes) == 5
    for node in nodes:
        assert node.named['package'] == 'mag_tracking'
        assert node.named['executable'] in executables
        assert of(within(node.named['namespace']), 'LaunchConfiguration')[0].arguments == (
            'namespace',)
        for parameters in node.named['parameters']:
            if isinstance(parameters, dict):
                assert parameters.keys() <= NODE_PARAMETERS
    declared = {m.arguments[0] for m in of(made, 'DeclareLaunchArgument')}
    used = {m.arguments[0] for m in of(made, 'LaunchConfiguration')}
    assert declared == used
    for share in of(made, 'PathJoinSubstitution'):
        package, *path = share.arguments[0]
        assert package.arguments == ('mag_tracking',) and ROOT.joinpath(*path).is_file()
    for m in of(made, 'DeclareLaunchArgument'):
        assert m.named.get('description') or m.arguments[0] == 'network', m.arguments


@pytest.mark.skipif(not HAS_LAUNCH, reason='launch_ros is not on PyPI: a ROS from apt has it')
def test_the_launch_file_runs():
    process = subprocess.Popen(
        ['ros2', 'launch', str(LAUNCH_FILE), f'network:={NETWORK_FILE}', 'namespace:=road',
         f'recording:={vehicle_path("straight_car_right")}', 'rate:=3.0'], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    # Its end, if the line never comes.
    watch = threading.Timer(MAX_S, process.kill)
    watch.start()
    try:
        lines = []
        while not (lines and 'track 1 begins' in lines[-1]) and (line := process.stdout.readline()):
            lines.append(line)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=MAX_S)
    finally:
        watch.cancel()
    assert 'track 1 begins' in lines[-1], lines
