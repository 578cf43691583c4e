"""The commands of `mag-tracking` and their parser; only the requested command is imported."""

import argparse
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from typing import NamedTuple

PACKAGE = 'mag_tracking'
ROS_ARGUMENTS = '--ros-args'
ROS_COMMANDS = ('run', 'record', 'doctor', 'topics', 'echo', 'param', 'lifecycle', 'watch')
"""Commands that accept ROS arguments."""


class Command(NamedTuple):
    """Description of a command; available before the module of the command is imported."""

    module: str
    """Module in this folder. The function `add` of the module registers all its commands."""
    summary: str
    """Summary in the list of commands."""
    aliases: tuple[str, ...] = ()
    """Alternative names."""


COMMANDS = {
    'replay': Command('replay', 'Track the targets in recordings, offline.'),
    'events': Command('events', 'Count and describe the passes at each sensor.'),
    'traffic': Command('traffic', 'Count vehicles by direction, class and speed.'),
    'classes': Command('classes', 'Train and apply a classifier of passes at one sensor.'),
    'calibrate': Command('calibrate', 'Calibrate sensor orientations, clocks and noise.'),
    'tumble': Command('tumble', 'Calibrate hard and soft iron by rotating the sensors.'),
    'board-geometry': Command(
        'board_geometry', 'Calibrate the geometry of a board with a magnet.',
        ('geometry',)),
    'doctor': Command('doctor', 'Diagnose sensor faults.'),
    'fit': Command('fit', 'Fit each pass as a whole at constant velocity, offline.'),
    'plan': Command('plan', 'Predict accuracy and coverage of a sensor network.'),
    'listen': Command('listen', 'Print the readings of the devices in a drivers file.'),
    'record': Command('record', 'Record the sensors (needs ROS 2).'),
    'repair': Command('repair', 'Rebuild the index of an incomplete recording.'),
    'run': Command('run', 'Run all nodes in one process (needs ROS 2).'),
    'info': Command('info', 'Summarise the content of a recording.'),
    'archive': Command('archive', 'Track many recordings into one dataset, in parallel.'),
    'import': Command('import_table', 'Convert a CSV table to a recording.'),
    'topics': Command('graph', 'List the topics of the ROS graph (needs ROS 2).'),
    'echo': Command('graph', 'Print the messages of a topic (needs ROS 2).'),
    'param': Command('graph', 'Show or set the parameters of a node (needs ROS 2).'),
    'lifecycle': Command('graph', 'Show or change the state of a node (needs ROS 2).'),
    'view': Command('live_page', 'Track a recording in real time on a live page.'),
    'watch': Command('live_page', 'Show running nodes on a live page (needs ROS 2).'),
}


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse a command line without the program name.

    `run_command` of the namespace takes the namespace and returns the exit status.
    """
    parser = argparse.ArgumentParser(
        prog='mag-tracking', description='Track magnetic targets with stationary magnetometers. '
        'For the options of a command, run "mag-tracking COMMAND --help".')
    parser.add_argument('--version', action='version', version=f'mag_tracking {version(PACKAGE)}')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    arguments = list(arguments)
    ros_start = arguments.index(ROS_ARGUMENTS) if ROS_ARGUMENTS in arguments else len(arguments)
    requested_module = _module_of(
        next((word for word in arguments[:ros_start] if word[:1] != '-'), ''))
    if requested_module is not None:
        import_module(f'{PACKAGE}.cli.{requested_module}').add(commands)
    for name, command in COMMANDS.items():
        if command.module != requested_module:
            commands.add_parser(name, help=command.summary, aliases=command.aliases)
    args = parser.parse_args(arguments[:ros_start])
    args.ros_arguments = arguments[ros_start:]
    if args.ros_arguments and args.command not in ROS_COMMANDS:
        parser.error(f'{ROS_ARGUMENTS}: {args.command} runs without ROS; ROS arguments are '
                     f'accepted by {", ".join(ROS_COMMANDS)}')
    return args


def _module_of(word: str) -> str | None:
    """Return the module of the command with name or alias `word`; None if no command matches."""
    return next((command.module for name, command in COMMANDS.items()
                 if word in (name, *command.aliases)), None)
