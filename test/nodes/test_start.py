"""A process that is sent a signal at any moment of its start ends with status 0, and silently."""

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
from support.node_processes import environment, without_states
from support.ros_domain import RosDomain

pytestmark = pytest.mark.timeout(600)

MAX_START_S = 120.0
GIVEN = {'driver_node': {'drivers': ROOT / 'config' / 'drivers.yaml', 'network': NETWORK_FILE},
         'replay_node': {'recording': vehicle_path('straight_car_right')},
         **{f'{name}_node': {'network': NETWORK_FILE}
            for name in ('calibration', 'detection', 'tracker')}}
COMMANDS = {name: ['-m', f'mag_tracking.nodes.{name}', '--ros-args',
                   *(a for key, value in given.items() for a in ('-p', f'{key}:={value}'))]
            for name, given in GIVEN.items()}
COMMANDS['run'] = ['-m', 'mag_tracking.cli', 'run', '--network', str(NETWORK_FILE)]
SCRIPTS = {name: ['-c', f'from mag_tracking.nodes.start import {name}; {name}()',
                  *COMMANDS[name][2:]] for name in GIVEN}
"""What pip's console scripts do."""
STRUCK = """
import os, runpy, sys
how, module = int(sys.argv.pop(1)), sys.argv.pop(1)
def strike(event, arguments):
    if event == 'import' and arguments[0] == module:
        os.kill(os.getpid(), how)
sys.addaudithook(strike)
kind, what = sys.argv.pop(1), sys.argv.pop(1)
if kind == '-m':
    runpy.run_module(what, run_name='__main__', alter_sys=True)
else:
    exec(what)
"""
"""Runs a command, and sends itself a signal when it begins to import a module."""
LIBRARIES = ('librcl.so', 'libfastrtps.so')
"""Loaded while a node starts, the second when it enters ROS."""


def begun(words):
    """A process with these arguments for Python."""
    return subprocess.Popen(
        [sys.executable, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, env=environment(),
        # A background job, which these tests may be, passes on that it ignores SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))


def started(words):
    """A process whose first line of the project's has run: it handles SIGTERM."""
    process = begun(words)
    wait_for(lambda: handles(process.pid, signal.SIGTERM), process)
    return process


def handles(pid, signum):
    """Whether a process has a handler for a signal."""
    with open(f'/proc/{pid}/status') as stream:
        mask = next(line.split()[1] for line in stream if line.startswith('SigCgt:'))
    return bool(int(mask, 16) >> (signum - 1) & 1)


def has_loaded(pid, name):
    """Whether a process has a library whose path has this in it."""
    with open(f'/proc/{pid}/maps') as stream:
        return name in stream.read()


def wait_for(condition, process):
    """Ask until it is so; a process that ends meanwhile or never gets there is an error."""
    end = time.monotonic() + MAX_START_S
    while not condition():
        assert process.poll() is None and time.monotonic() < end, process.communicate()[0]
        time.sleep(0.001)


def end_of(process, how):
    """(exit status, output) of a process that is sent a signal."""
    process.send_signal(how)
    output = process.communicate(timeout=MAX_START_S)[0]
    return process.returncode, without_states(output)


@pytest.mark.parametrize('how, words', [
    pytest.param(how, words, id=f'{name}-{how.name}',
                 # Commands get SIGINT, as from Ctrl-C; scripts SIGTERM, as from a service manager.
                 # All nodes start in the same way; see the next test.
                 marks=[] if (how is signal.SIGINT) == (words in COMMANDS.values())
                 and name.split()[0] in ('driver_node', 'tracker_node', 'run')
                 else pytest.mark.study)
    for how in (signal.SIGINT, signal.SIGTERM)
    for name, words in [*COMMANDS.items(), *((f'{n} script', w) for n, w in SCRIPTS.items())]])
def test_a_signal_during_the_imports_ends_it(how, words):
    process = started(words)
    assert end_of(process, how) == (0, '')
    for module in ('numpy', 'rclpy', 'mag_tracking.nodes.middleware'):
        process = begun(['-c', STRUCK, int(how), module, *words])
        output = process.communicate(timeout=MAX_START_S)[0]
        assert (process.returncode, output) == (0, ''), module


@pytest.mark.parametrize('name', GIVEN)
def test_a_node_handles_signals_before_it_imports_anything(name):
    body = ast.parse((ROOT / 'mag_tracking' / 'nodes' / f'{name}.py').read_text()).body
    assert ast.unparse(body[1]) == (f"if __name__ == '__main__':\n    from "
                                    f'mag_tracking.nodes.start import {name}\n    {name}()')


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('library', LIBRARIES)
def test_a_signal_while_a_library_is_loaded_ends_it(library, how):
    for name in ('tracker_node', 'run'):
        process = started(COMMANDS[name])
        wait_for(lambda process=process: has_loaded(process.pid, library), process)
        assert end_of(process, how) == (0, '')


@pytest.fixture
def start_s(monkeypatch):
    """f(words): seconds from the first line until a node of the process is in the graph.

    The graph is that of a domain that nobody else uses: where a process ends just as its node is
    announced, the middleware may list the node until the observer itself has left.
    """
    def measured(words):
        process = started(words)
        began = time.monotonic()
        wait_for(lambda: len(observer.get_node_names()) > 1, process)
        took = time.monotonic() - began
        assert end_of(process, signal.SIGINT) == (0, '')
        return took

    with RosDomain() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain.number))
        middleware.begin()
        observer = Node('observer')
        yield measured
        observer.destroy_node()
        rclpy.try_shutdown()


@pytest.mark.parametrize('name, step_s', [
    pytest.param('tracker_node', 0.25), pytest.param('run', 0.25, marks=pytest.mark.study),
    *(pytest.param(name, 0.05, marks=pytest.mark.study) for name in COMMANDS)])
def test_a_signal_at_any_moment_of_the_start_ends_it(start_s, name, step_s):
    """On a slow machine the steps are as many, and longer."""
    took = start_s(COMMANDS[name])
    n = round(2.5 / step_s)
    step_s, ends = max(step_s, 1.2 * took / n), {}
    for k in range(1, 1 + int(1.2 * took / step_s)):
        how = (signal.SIGINT, signal.SIGTERM)[k % 2]
        process = started(COMMANDS[name])
        time.sleep(k * step_s)
        ends[round(k * step_s, 2), how.name] = end_of(process, how)
    print(f'{name}: up after {took:.2f} s; {len(ends)} signals, {step_s:.2f} s apart')
    # A node that is up may have said something of its own, as of a device that is missing.
    assert {moment: (status, said) for moment, (status, said) in ends.items()
            if status or 'Traceback' in said or said.count('\n') > 1} == {}


def test_other_commands_say_that_they_were_interrupted():
    process = begun(['-c', STRUCK, int(signal.SIGINT), 'numpy', '-m', 'mag_tracking.cli', 'info'])
    output = process.communicate(timeout=MAX_START_S)[0]
    assert (process.returncode, output) == (130, 'mag-tracking: interrupted\n')
