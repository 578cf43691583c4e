"""Commands `mag-tracking ros topics`, `echo`, `param`, `lifecycle` and `watch`."""

import argparse
import os
import signal
import sys
import threading

from mag_tracking.cli.options import Commands, add_command, add_page
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.quantities import quantity

_GRAPH_HELP = '''
A substitute for the command `ros2`, which ROS from PyPI lacks. Names are relative to the
namespace set with --ros-args -r __ns:=/NAMESPACE.
'''

_WATCH_HELP = '''
Shows the tracks of running nodes. Ctrl-C ends the page, not the nodes.

Open the printed address in a browser. The page shows a map with tracks, 90% regions and
hypotheses, the fields of the sensors, and the health of the system. The page is available on this
machine only; --host 0.0.0.0 also serves it to other machines, which need the token in the address.

examples:
  mag-tracking ros watch
  mag-tracking ros watch --ros-args -r __ns:=/robot1
  mag-tracking ros watch --ros-args -r tracker_node/tracks:=/robot1/follower/tracks
'''


def add(commands: Commands) -> None:
    """Register the commands."""
    add_command(commands, 'ros topics', _topics, _GRAPH_HELP)
    p = add_command(commands, 'ros echo', _echo, _GRAPH_HELP)
    p.add_argument('topic', metavar='TOPIC', help='name of the topic')
    p.add_argument('--count', type=int, metavar='N', help='exit after N messages')
    p = add_command(commands, 'ros param', _param, _GRAPH_HELP)
    p.add_argument('node', metavar='NODE', help='name of the node')
    p.add_argument('name', nargs='?', metavar='NAME',
                   help='name of the parameter (default: all parameters)')
    p.add_argument('value', nargs='?', metavar='VALUE', help='new value of the parameter (YAML)')
    p = add_command(commands, 'ros lifecycle', _lifecycle, _GRAPH_HELP)
    p.add_argument('node', metavar='NODE', help='name of the node')
    p.add_argument('transition', nargs='?', metavar='TRANSITION', help='transition to trigger: '
                   'configure, activate, deactivate, cleanup or shutdown')
    p = add_command(commands, 'ros watch', _watch, _WATCH_HELP)
    add_page(p)
    p.add_argument('--until-eof', action='store_true', help=argparse.SUPPRESS)


def _topics(args: argparse.Namespace) -> int:
    from mag_tracking.nodes.graph_tools import observer, topics

    with observer(args.ros_arguments) as graph:
        for name, kinds, n_publishers, n_subscribers in topics(graph):
            print(f'{name}  {kinds}  {quantity(n_publishers, "publisher")}, '
                  f'{quantity(n_subscribers, "subscriber")}')
    return 0


def _echo(args: argparse.Namespace) -> int:
    from mag_tracking.nodes.graph_tools import as_text, observer, receive_messages

    if args.count is not None and args.count < 1:
        raise SettingsError(f'--count: expected 1 or more, got {args.count}')
    n = 0

    def show(message: object) -> bool:
        nonlocal n
        n += 1
        try:
            print(f'{as_text(message)}---', flush=True)
        except BrokenPipeError:
            # The reader has closed the pipe (`| head`). Python would report it again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return False
        return not signals and n != args.count

    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals:
        with observer(args.ros_arguments) as graph:
            receive_messages(graph, args.topic, show, lambda: bool(signals))
    return 0


def _param(args: argparse.Namespace) -> int:
    from mag_tracking.nodes.graph_tools import observer, parameter_lines, set_parameter

    with observer(args.ros_arguments) as graph:
        if args.value is not None:
            set_parameter(graph, args.node, args.name, args.value)
        for line in parameter_lines(graph, args.node, args.name):
            print(line)
    return 0


def _lifecycle(args: argparse.Namespace) -> int:
    from mag_tracking.nodes.graph_tools import change_lifecycle_state, lifecycle_state, observer

    with observer(args.ros_arguments) as graph:
        if args.transition is not None:
            change_lifecycle_state(graph, args.node, args.transition)
        state, transitions = lifecycle_state(graph, args.node)
        print(f'{state}; available transitions: {", ".join(transitions)}')
    return 0


def _watch(args: argparse.Namespace) -> int:
    # Imported here because it needs ROS.
    from mag_tracking.nodes import page_node

    end_of_input = threading.Event()

    def read() -> None:
        # Stdin ends when the parent process has ended.
        sys.stdin.read()
        end_of_input.set()

    if args.until_eof:
        threading.Thread(target=read, daemon=True).start()
    return page_node.watch(args.host, args.port, print, args.ros_arguments, end_of_input.is_set)
