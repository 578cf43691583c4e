"""A signal at any time during startup ends a process silently with status 0."""

import ast
import signal
import subprocess
import sys
import time

import pytest
import rclpy
from rclpy.node import Node

from mag_tracking.nodes import middleware
from support.bundled import NETWORK_FILE, ROOT, vehicle_path
from support.node_processes import environment, without_info_lines
from support.ros_domain import RosDomain

pytestmark = pytest.mark.timeout(600)

MAX_START_S = 120.0
PARAMETERS = {'driver_node': {'drivers': ROOT / 'config' / 'drivers.yaml', 'network': NETWORK_FILE},
              'replay_node': {'recording': vehicle_path('straight_car_right')},
              **{f'{name}_node': {'network': NETWORK_FILE}
                 for name in ('calibration', 'detection', 'tracker')}}
COMMANDS = {name: ['-m', f'mag_tracking.nodes.{name}', '--ros-args',
                   *(a for key, value in parameters.items() for a in ('-p', f'{key}:={value}'))]
            for name, parameters in PARAMETERS.items()}
COMMANDS['run'] = ['-m', 'mag_tracking.cli', 'run', '--network', str(NETWORK_FILE)]
SCRIPTS = {name: ['-c', f'from mag_tracking.nodes.start import {name}; {name}()',
                  *COMMANDS[name][2:]] for name in PARAMETERS}
"""Equivalents of pip's console scripts."""
SIGNAL_AT_IMPORT = """
import os, runpy, sys
signum, module = int(sys.argv.pop(1)), sys.argv.pop(1)
def send_signal(event, arguments):
    if event == 'import' and arguments[0] == module:
        os.kill(os.getpid(), signum)
sys.addaudithook(send_signal)
kind, what = sys.argv.pop(1), sys.argv.pop(1)
if kind == '-m':
    runpy.run_module(what, run_name='__main__', alter_sys=True)
else:
    exec(what)
"""
"""Program that runs a command and sends itself a signal at the import of a module."""
LIBRARIES = ('librcl.so', 'libfastrtps.so')
"""Libraries loaded during the start of a node; the second is loaded when ROS is initialised."""


def launch(arguments):
    """Start Python with arguments."""
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, env=environment(),
        # In a background job, the process would inherit that SIGINT is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))


def launch_and_wait(arguments):
    """Start Python and wait until mag_tracking has installed its SIGTERM handler."""
    process = launch(arguments)
    wait_for(lambda: handles(process.pid, signal.SIGTERM), process)
    return process


def handles(pid, signum):
    """Whether a process has a handler for a signal."""
    with open(f'/proc/{pid}/status') as stream:
        mask = next(line.split()[1] for line in stream if line.startswith('SigCgt:'))
    return bool(int(mask, 16) >> (signum - 1) & 1)


def has_loaded(pid, name):
    """Whether a process has loaded a library whose path contains `name`."""
    with open(f'/proc/{pid}/maps') as stream:
        return name in stream.read()


def wait_for(condition, process):
    """Wait until a condition holds; fail if the process ends or the time limit passes."""
    end = time.monotonic() + MAX_START_S
    while not condition():
        assert process.poll() is None and time.monotonic() < end, process.communicate()[0]
        time.sleep(0.001)


def signal_and_wait(process, signum):
    """Send a signal to a process; return (exit status, output)."""
    process.send_signal(signum)
    output = process.communicate(timeout=MAX_START_S)[0]
    return process.returncode, without_info_lines(output)


@pytest.mark.parametrize('signum, arguments', [
    pytest.param(signum, arguments, id=f'{name}-{signum.name}',
                 # Commands get SIGINT, as from Ctrl-C; scripts SIGTERM, as from a service manager.
                 # All nodes start in the same way; see the next test.
                 marks=[] if (signum is signal.SIGINT) == (arguments in COMMANDS.values())
                 and name.split()[0] in ('driver_node', 'tracker_node', 'run')
                 else pytest.mark.study)
    for signum in (signal.SIGINT, signal.SIGTERM)
    for name, arguments in [*COMMANDS.items(), *((f'{n} script', w) for n, w in SCRIPTS.items())]])
def test_a_signal_during_imports_ends_the_process(signum, arguments):
    process = launch_and_wait(arguments)
    assert signal_and_wait(process, signum) == (0, '')
    for module in ('numpy', 'rclpy', 'mag_tracking.nodes.middleware'):
        process = launch(['-c', SIGNAL_AT_IMPORT, int(signum), module, *arguments])
        output = process.communicate(timeout=MAX_START_S)[0]
        assert (process.returncode, output) == (0, ''), module


@pytest.mark.parametrize('name', PARAMETERS)
def test_a_node_handles_signals_before_it_imports_anything(name):
    body = ast.parse((ROOT / 'mag_tracking' / 'nodes' / f'{name}.py').read_text()).body
    assert ast.unparse(body[1]) == (f"if __name__ == '__main__':\n    from "
                                    f'mag_tracking.nodes.start import {name}\n    {name}()')


@pytest.mark.parametrize('signum', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('library', LIBRARIES)
def test_a_signal_while_a_library_is_loaded_ends_the_process(library, signum):
    for name in ('tracker_node', 'run'):
        process = launch_and_wait(COMMANDS[name])
        wait_for(lambda process=process: has_loaded(process.pid, library), process)
        assert signal_and_wait(process, signum) == (0, '')


@pytest.fixture
def start_s(monkeypatch):
    """f(arguments): seconds from the start of signal handling until a node is in the graph.

    The domain is not shared: if a process ends while its node is announced, the middleware may
    list the node until the observer ends.
    """
    def measure(arguments):
        process = launch_and_wait(arguments)
        start = time.monotonic()
        wait_for(lambda: len(observer.get_node_names()) > 1, process)
        duration_s = time.monotonic() - start
        assert signal_and_wait(process, signal.SIGINT) == (0, '')
        return duration_s

    with RosDomain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain.number))
        middleware.init_ros()
        observer = Node('observer')
        yield measure
        observer.destroy_node()
        rclpy.try_shutdown()


@pytest.mark.parametrize('name, step_s', [
    pytest.param('tracker_node', 0.25), pytest.param('run', 0.25, marks=pytest.mark.study),
    *(pytest.param(name, 0.05, marks=pytest.mark.study) for name in COMMANDS)])
def test_a_signal_at_any_moment_of_the_start_ends_the_process(start_s, name, step_s):
    """Signals are sent every `step_s`, or less often on a machine where the start takes longer."""
    duration_s = start_s(COMMANDS[name])
    n = round(2.5 / step_s)
    step_s, results = max(step_s, 1.2 * duration_s / n), {}
    for k in range(1, 1 + int(1.2 * duration_s / step_s)):
        signum = (signal.SIGINT, signal.SIGTERM)[k % 2]
        process = launch_and_wait(COMMANDS[name])
        time.sleep(k * step_s)
        results[round(k * step_s, 2), signum.name] = signal_and_wait(process, signum)
    print(f'{name}: up after {duration_s:.2f} s; {len(results)} signals, one every {step_s:.2f} s')
    # A node that is up may have logged a line, for example about a missing device.
    assert {instant: (status, output) for instant, (status, output) in results.items()
            if status or 'Traceback' in output or output.count('\n') > 1} == {}


def test_other_commands_report_the_interrupt():
    process = launch(['-c', SIGNAL_AT_IMPORT, int(signal.SIGINT), 'numpy', '-m', 'mag_tracking.cli',
                      'info'])
    output = process.communicate(timeout=MAX_START_S)[0]
    assert (process.returncode, output) == (130, 'mag-tracking: interrupted\n')
