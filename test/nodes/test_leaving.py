"""The end of a process with ROS, also where the middleware hangs."""

import ast
import os
import signal
import subprocess
import sys
import time

import pytest

from mag_tracking.nodes.leaving import LEAVING_S
from support.bundled import ROOT
from support.node_processes import LONGEST_S, environment

STUCK = '''
import re, sys
from rclpy.node import Node
from mag_tracking.errors import MagTrackingError
from mag_tracking.nodes import stage_node

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
            raise RuntimeError('on its way')

    def destroy_node(self):
        # Years, without the lock of Python being given back, as in Fast DDS.
        re.match(r'(a+)+$', 'a' * 64 + 'b')

sys.exit(stage_node.main(Stuck, ['stuck']))
'''


def started(*words):
    """The process of a node that cannot be destroyed, and that keeps its output until it has to
    be written."""
    buffered = environment(ROS_HOME=os.environ['ROS_HOME'])
    buffered.pop('PYTHONUNBUFFERED', None)
    return subprocess.Popen([sys.executable, '-c', STUCK, *words], text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=buffered)


def test_a_node_that_cannot_leave_is_ended_with_its_status():
    with started() as process:
        assert process.stdout.readline() == 'it runs\n'
        begin = time.monotonic()
        process.send_signal(signal.SIGINT)
        # By the stream that has read a line, and may have read more.
        output, errors = process.stdout.read(), process.stderr.read()
        assert process.wait(LONGEST_S) == 0 and output == 'not flushed', (output, errors)
    assert time.monotonic() - begin > LEAVING_S
    assert errors.endswith(f'the middleware has not let go within {LEAVING_S:g} s; the process '
                           'was ended\n')


def test_an_error_on_its_way_is_printed_before_the_end():
    process = started('fails')
    _, errors = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 1 and 'on its way\nthe middleware' in errors, errors


@pytest.mark.parametrize('path', sorted((ROOT / 'mag_tracking').rglob('*.py')),
                         ids=lambda p: p.stem)
def test_ros_is_left_in_one_place(path):
    calls = {ast.unparse(node.func) for node in ast.walk(ast.parse(path.read_text()))
             if isinstance(node, ast.Call)}
    leaving = {c for c in calls if c.endswith(('.try_shutdown', 'rclpy.shutdown'))}
    assert leaving == ({'rclpy.try_shutdown'} if path.stem == 'leaving' else set())
