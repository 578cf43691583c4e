"""Shutdown of processes with ROS, even if the middleware hangs."""

import ast
import os
import signal
import subprocess
import sys
import time

import pytest

from mag_tracking.errors import MagTrackingError
from mag_tracking.nodes.core import Deadline, end_within
from mag_tracking.nodes.middleware import HUNG_MESSAGE, SHUTDOWN_TIMEOUT_S, shut_down
from support.bundled import NETWORK_FILE, ROOT
from support.node_processes import MAX_S, environment

FAST_DDS = 'rmw_fastrtps_cpp'
STUCK_NODE = '''
import re, sys
from rclpy.node import Node
from mag_tracking.nodes import middleware

class Stuck(Node):
    def __init__(self):
        super().__init__('stuck')
        self.n = 0
        self.create_timer(0.01, self.tick)

    def tick(self):
        self.n += 1
        if self.n == 1:
            print('it runs')
            sys.stdout.flush()
            print('not flushed', end='')
        if 'fails' in sys.argv:
            raise RuntimeError('by design')

    def destroy_node(self):
        # This takes years and, as in Fast DDS, never releases the interpreter's lock.
        re.match(r'(a+)+$', 'a' * 64 + 'b')

sys.exit(middleware.main(Stuck, ['stuck']))
'''
INCOMPLETE_NODE = '''
import atexit, re, sys, types
import rclpy
from mag_tracking.nodes import start

def main():
    # A node whose constructor has raised is destroyed with the interpreter.
    atexit.register(re.match, r'(a+)+$', 'a' * 64 + 'b')
    print('there is no such file', end='')
    return 1

sys.modules['mag_tracking.nodes.failing_node'] = types.SimpleNamespace(main=main)
start.run_node('failing_node')
'''


def started(code, *arguments, **options):
    """Start Python with arguments; its output is buffered until the process ends."""
    buffered = environment(ROS_HOME=os.environ['ROS_HOME'])
    buffered.pop('PYTHONUNBUFFERED', None)
    return subprocess.Popen([sys.executable, *code, *arguments], text=True, **{
        'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, 'env': buffered, **options})


def test_a_stuck_node_is_ended_with_its_exit_status():
    with started(['-c', STUCK_NODE]) as process:
        assert process.stdout.readline() == 'it runs\n'
        begin = time.monotonic()
        process.send_signal(signal.SIGINT)
        # Read from the stream itself: it may have buffered more than one line.
        output, errors = process.stdout.read(), process.stderr.read()
        assert process.wait(MAX_S) == 0 and output == 'not flushed', (output, errors)
    assert time.monotonic() - begin > SHUTDOWN_TIMEOUT_S
    assert errors.endswith(HUNG_MESSAGE)


def test_an_error_is_printed_before_a_stuck_node_is_ended():
    process = started(['-c', STUCK_NODE], 'fails')
    _, errors = process.communicate(timeout=MAX_S)
    assert process.returncode == 1 and f'RuntimeError: by design\n{HUNG_MESSAGE}' in errors, errors


def test_an_incomplete_node_does_not_block_the_exit():
    output, errors = started(['-c', INCOMPLETE_NODE]).communicate(timeout=MAX_S)
    assert (output, errors) == ('there is no such file', HUNG_MESSAGE)


@pytest.mark.parametrize('module, arguments, status, text', [
    ('mag_tracking.cli', ['ros', 'topics'], 0, ''),
    ('mag_tracking.nodes.tracker_node', ['--ros-args', '-p', 'network:=/nonexistent.yaml'], 1,
     '/nonexistent.yaml')])
def test_a_closed_output_does_not_block_the_exit(module, arguments, status, text):
    process = started(['-m', module], *arguments, stdout=None, preexec_fn=lambda: os.close(1))
    _, errors = process.communicate(timeout=MAX_S)
    assert process.returncode == status and text in errors and 'Traceback' not in errors, errors


@pytest.fixture(scope='module')
def hanging_middleware(tmp_path_factory):
    """Preloaded library that makes the middleware hang at the end of every process."""
    path = tmp_path_factory.mktemp('preloaded') / 'hanging.so'
    subprocess.run(['g++', '-shared', '-fPIC', '-o', path,
                    ROOT / 'test' / 'support' / 'hanging_middleware.cpp'], check=True)
    return path


@pytest.mark.skipif(os.environ.get('RMW_IMPLEMENTATION', FAST_DDS) != FAST_DDS,
                    reason='only Fast DDS hangs')
@pytest.mark.parametrize('module, arguments, status, text', [
    ('mag_tracking.cli', ['ros', 'topics'], 0, '/rosout'),
    ('mag_tracking.cli', ['doctor', '--live', '1', '--network', NETWORK_FILE], 2, 'ERROR mag_1'),
    ('mag_tracking.cli', ['run', '--network', NETWORK_FILE, '--drivers', '/none.yaml'], 1,
     '/none.yaml'),
    ('mag_tracking.nodes.tracker_node', ['--ros-args', '-p', 'network:=/none.yaml'], 1,
     '/none.yaml')])
def test_output_is_complete_if_the_middleware_hangs(hanging_middleware, module, arguments, status,
                                                    text):
    process = started(['-m', module], *map(str, arguments), env=environment(
        ROS_HOME=os.environ['ROS_HOME'], LD_PRELOAD=str(hanging_middleware)))
    output, errors = process.communicate(timeout=MAX_S)
    assert process.returncode == status and text in output + errors, (output, errors)
    assert errors.endswith(HUNG_MESSAGE), errors


class FakeNode:
    """Stand-in for a node; records that it was destroyed."""

    def __init__(self, error=None):
        self.error, self.is_destroyed = error, False

    def destroy_node(self):
        self.is_destroyed = True
        if self.error is not None:
            raise self.error


def test_all_nodes_are_destroyed_when_one_fails():
    nodes = [FakeNode(RuntimeError('the first')), FakeNode()]
    with pytest.raises(RuntimeError, match='the first'):
        shut_down(nodes)
    assert all(node.is_destroyed for node in nodes)


def test_an_error_that_cannot_be_encoded_is_still_raised():
    node = FakeNode()
    with pytest.raises(MagTrackingError, match='such file'):
        try:
            raise MagTrackingError('\udcff: no such file')
        finally:
            shut_down([node])
    assert node.is_destroyed


@pytest.mark.parametrize('seconds', [-1.0, float('nan'), float('inf'), 1e10])
def test_deadlines_out_of_range_are_refused(seconds):
    for limit in (Deadline, end_within):
        with pytest.raises(ValueError, match='between 0 and 1e6'):
            limit(seconds, 1, b'')


def test_the_doctor_reports_before_its_shutdown(monkeypatch, capfd):
    from mag_tracking.cli import main
    from mag_tracking.nodes import doctor_node

    statuses = []

    def shut_down_after_report(nodes, executor, status):
        statuses.append((status, 'has no publisher' in capfd.readouterr().out))
        shut_down(nodes, executor, status)

    monkeypatch.setattr(doctor_node, 'shut_down', shut_down_after_report)
    assert main(['doctor', '--live', '1', '--network', str(NETWORK_FILE)]) == 2
    assert statuses == [(2, True)]


@pytest.mark.parametrize('path', sorted((ROOT / 'mag_tracking').rglob('*.py')),
                         ids=lambda p: p.stem)
def test_ros_is_shut_down_in_one_module_only(path):
    names = {ast.unparse(node) for node in ast.walk(ast.parse(path.read_text()))
             if isinstance(node, ast.Attribute)}
    shutdown = names & {'rclpy.try_shutdown', 'rclpy.shutdown', 'node.destroy_node'}
    assert shutdown == ({'rclpy.try_shutdown', 'node.destroy_node'} if path.stem == 'middleware'
                        else set())
