"""The launch file: executed with a stand-in for `launch_ros`, and run if ROS launch is installed.

PyPI's `launch` is another package. The stand-in records the objects that the file creates. Their
executables, parameters, arguments and files are compared with the package.
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


class LaunchObject:
    """Object of the stand-in, with the name of its class and its arguments."""

    def __init__(self, name, arguments, keywords):
        self.name, self.arguments, self.keywords = name, arguments, keywords

    def __iter__(self):
        raise TypeError(f'{self.name} is not iterable')


def objects_in(value):
    """Yield each `LaunchObject` in a value."""
    if isinstance(value, LaunchObject):
        yield value
        for part in (*value.arguments, *value.keywords.values()):
            yield from objects_in(part)
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from objects_in(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from objects_in(part)


@pytest.fixture
def launch_objects(monkeypatch):
    """All `LaunchObject` instances of the launch file."""
    for module in ('launch', 'launch_ros', *CLASSES):
        monkeypatch.setitem(sys.modules, module, types.ModuleType(module))
    for module, names in CLASSES.items():
        for name in names:
            setattr(sys.modules[module], name,
                    lambda *a, _name=name, **n: LaunchObject(_name, a, n))
    spec = importlib.util.spec_from_file_location('tracking_launch', LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return list(objects_in(module.generate_launch_description()))


@pytest.fixture
def executables(monkeypatch):
    """Names of the scripts that setup.py installs."""
    settings = {}
    monkeypatch.setattr(setuptools, 'setup', lambda **keywords: settings.update(keywords))
    monkeypatch.chdir(ROOT)
    exec(compile((ROOT / 'setup.py').read_text(), 'setup.py', 'exec'), {'__name__': 'setup'})
    return {line.split('=')[0].strip() for line in settings['entry_points']['console_scripts']}


def of_class(launch_objects, name):
    """Objects of the class `name` in a list of `LaunchObject` instances."""
    return [m for m in launch_objects if m.name == name]


def test_every_name_in_the_launch_file_exists(launch_objects, executables):
    nodes = of_class(launch_objects, 'Node')
    assert len(nodes) == 5
    for node in nodes:
        assert node.keywords['package'] == 'mag_tracking'
        assert node.keywords['executable'] in executables
        assert of_class(objects_in(node.keywords['namespace']),
                        'LaunchConfiguration')[0].arguments == ('namespace',)
        for parameters in node.keywords['parameters']:
            if isinstance(parameters, dict):
                assert parameters.keys() <= NODE_PARAMETERS
    declared = {m.arguments[0] for m in of_class(launch_objects, 'DeclareLaunchArgument')}
    referenced = {m.arguments[0] for m in of_class(launch_objects, 'LaunchConfiguration')}
    assert declared == referenced
    for join in of_class(launch_objects, 'PathJoinSubstitution'):
        package, *path = join.arguments[0]
        assert package.arguments == ('mag_tracking',) and ROOT.joinpath(*path).is_file()
    for m in of_class(launch_objects, 'DeclareLaunchArgument'):
        assert m.keywords.get('description') or m.arguments[0] == 'network', m.arguments


@pytest.mark.skipif(not HAS_LAUNCH, reason='launch_ros is not on PyPI; ROS from apt has it')
def test_the_launch_file_runs():
    process = subprocess.Popen(
        ['ros2', 'launch', str(LAUNCH_FILE), f'network:={NETWORK_FILE}', 'namespace:=road',
         f'recording:={vehicle_path("straight_car_right")}', 'rate:=3.0'], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    # The timer ends the process if the expected line never arrives.
    watchdog = threading.Timer(MAX_S, process.kill)
    watchdog.start()
    try:
        lines = []
        while not (lines and 'track 1 begins' in lines[-1]) and (line := process.stdout.readline()):
            lines.append(line)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=MAX_S)
    finally:
        watchdog.cancel()
    assert 'track 1 begins' in lines[-1], lines
