"""The commands of `mag-tracking`; imported is only the one that is asked for."""

import argparse
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from typing import NamedTuple

PACKAGE = 'mag_tracking'
ROS_ARGUMENTS = '--ros-args'
WITH_ROS = ('run', 'record', 'doctor', 'topics', 'echo', 'param', 'lifecycle', 'watch')
"""Commands that take arguments of ROS."""


class Command(NamedTuple):
    """What is known of a command before it is imported."""

    module: str
    """In this folder; its `add` registers the command, and others of the module."""
    short: str
    aliases: tuple[str, ...] = ()


COMMANDS = {
    'replay': Command('replay', 'Track what is in recordings, offline.'),
    'events': Command('events', 'Count and describe passes, sensor by sensor.'),
    'traffic': Command('traffic', 'Count vehicles by direction, class and speed.'),
    'classes': Command('classes', 'Learn and tell classes of passes by one sensor.'),
    'calibrate': Command('calibrate', 'Find how sensors are turned and their clocks are off.'),
    'tumble': Command('tumble', 'Find the hard and soft iron of sensors that were turned about.'),
    'board-geometry': Command(
        'board_geometry', 'Find where the sensors of a board are, from poses of a magnet.',
        ('geometry',)),
    'doctor': Command('doctor', 'Say what is wrong with the sensors.'),
    'fit': Command('fit', 'Fit whole passes at constant velocity, offline.'),
    'plan': Command('plan', 'What a network of sensors will be able to tell.'),
    'listen': Command('listen', 'Print what the devices of a drivers file say.'),
    'record': Command('record', 'Record the sensors (needs ROS 2).'),
    'repair': Command('repair', 'Make a recording whole that was cut off.'),
    'run': Command('run', 'Run the nodes in one process (needs ROS 2).'),
    'info': Command('info', 'Tell what is in a recording.'),
    'archive': Command('archive', 'Track many recordings into one dataset, on a cluster.'),
    'import': Command('import_table', 'Turn a table into a recording.'),
    'topics': Command('graph', 'List the topics of the graph (needs ROS 2).'),
    'echo': Command('graph', 'Print the messages of a topic (needs ROS 2).'),
    'param': Command('graph', 'Show or set parameters of a node (needs ROS 2).'),
    'lifecycle': Command('graph', 'Show or change the state of a lifecycle node (needs ROS 2).'),
    'view': Command('live_page', 'Show a recording on a live page.'),
    'watch': Command('live_page', 'Show running nodes on a live page (needs ROS 2).'),
}


def parse(words: Sequence[str]) -> argparse.Namespace:
    """The parsed command line; its `run_command` takes it and returns the exit status."""
    parser = argparse.ArgumentParser(
        prog='mag-tracking', description='Track magnetic targets with stationary magnetometers.')
    parser.add_argument('--version', action='version', version=f'mag_tracking {version(PACKAGE)}')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    words = list(words)
    split = words.index(ROS_ARGUMENTS) if ROS_ARGUMENTS in words else len(words)
    requested = _module_of(next((word for word in words[:split] if word[:1] != '-'), ''))
    if requested is not None:
        import_module(f'{PACKAGE}.cli.{requested}').add(commands)
    for name, command in COMMANDS.items():
        if command.module != requested:
            commands.add_parser(name, help=command.short, aliases=command.aliases)
    args = parser.parse_args(words[:split])
    args.ros_arguments = words[split:]
    if args.ros_arguments and args.command not in WITH_ROS:
        parser.error(f'{ROS_ARGUMENTS}: {args.command} runs without ROS; only '
                     f'{", ".join(WITH_ROS)} take arguments of ROS')
    return args


def _module_of(word: str) -> str | None:
    """The module of the command that a word names; None where it names none."""
    return next((command.module for name, command in COMMANDS.items()
                 if word in (name, *command.aliases)), None)
