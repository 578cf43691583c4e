"""mag-tracking topics, echo, param and lifecycle."""

import argparse
import os
import signal
import sys

from mag_tracking.cli.options import Commands, add_command
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals

_NOTE = '''
A small substitute for those who have ROS from PyPI; with a ROS from apt `ros2` does the same
and more. Names are relative to the namespace given by --ros-args -r __ns:=/NAMESPACE.
'''


def add(commands: Commands) -> None:
    """Register the commands."""
    add_command(commands, 'topics', _topics, _NOTE)
    p = add_command(commands, 'echo', _echo, _NOTE)
    p.add_argument('topic', metavar='TOPIC')
    p.add_argument('--count', type=int, metavar='N', help='end after so many messages')
    p = add_command(commands, 'param', _param, _NOTE)
    p.add_argument('node', metavar='NODE')
    p.add_argument('name', nargs='?', metavar='NAME', help='all of them if left out')
    p.add_argument('value', nargs='?', metavar='VALUE', help='set it to this (YAML)')
    p = add_command(commands, 'lifecycle', _lifecycle, _NOTE)
    p.add_argument('node', metavar='NODE')
    p.add_argument('transition', nargs='?', metavar='TRANSITION',
                   help='configure, activate, deactivate, cleanup or shutdown')


def _topics(args: argparse.Namespace) -> int:
    """mag-tracking topics."""
    from mag_tracking.nodes.graph_tools import observer, topics

    with observer(args.ros_arguments) as graph:
        for name, kinds, n_publishers, n_subscribers in topics(graph):
            print(f'{name}  {kinds}  {n_publishers} publishers, {n_subscribers} subscribers')
    return 0


def _echo(args: argparse.Namespace) -> int:
    """mag-tracking echo."""
    from mag_tracking.nodes.graph_tools import as_text, observer, receive_messages

    if args.count is not None and args.count < 1:
        raise SettingsError(f'--count: {args.count} is not a number of at least 1')
    n = 0

    def show(message: object) -> bool:
        nonlocal n
        n += 1
        try:
            print(f'{as_text(message)}---', flush=True)
        except BrokenPipeError:
            # Nobody reads on, as behind `| head`; Python would complain once more at its end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return False
        return not seen and n != args.count

    with recorded_signals(signal.SIGINT, signal.SIGTERM) as seen:
        with observer(args.ros_arguments) as graph:
            receive_messages(graph, args.topic, show, lambda: bool(seen))
    return 0


def _param(args: argparse.Namespace) -> int:
    """mag-tracking param."""
    from mag_tracking.nodes.graph_tools import observer, parameter_lines, set_parameter

    with observer(args.ros_arguments) as graph:
        if args.value is not None:
            set_parameter(graph, args.node, args.name, args.value)
        for line in parameter_lines(graph, args.node, args.name):
            print(line)
    return 0


def _lifecycle(args: argparse.Namespace) -> int:
    """mag-tracking lifecycle."""
    from mag_tracking.nodes.graph_tools import (
        change_lifecycle_state,
        lifecycle_state,
        observer,
    )

    with observer(args.ros_arguments) as graph:
        if args.transition is not None:
            change_lifecycle_state(graph, args.node, args.transition)
        state, transitions = lifecycle_state(graph, args.node)
        print(f'{state}; possible: {", ".join(transitions)}')
    return 0
