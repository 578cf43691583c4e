"""The commands of `mag-tracking` and their parser; only the requested command is imported."""

import argparse
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import version
from typing import NamedTuple, NoReturn

PACKAGE = 'mag_tracking'
ROS_ARGUMENTS = '--ros-args'
ROS_COMMANDS = ('run', 'record', 'doctor', 'ros')


class Command(NamedTuple):
    """Description of a command; available before the module of the command is imported."""

    module: str
    """Module in this folder. The function `add` of the module registers all its commands."""
    summary: str


COMMANDS = {
    'replay': Command('replay', 'Track, count or describe the targets in recordings, offline.'),
    'fit': Command('fit', 'Fit each pass as a whole at constant velocity, offline.'),
    'archive': Command('archive', 'Track many recordings into one dataset, in parallel.'),
    'classes train': Command('classes', 'Train a classifier on labelled passes.'),
    'classes evaluate': Command('classes', 'Measure accuracy and reliability.'),
    'classes predict': Command('classes', 'Classify signatures.'),
    'plan': Command('plan', 'Predict accuracy and coverage of a sensor network.'),
    'listen': Command('listen', 'Print the readings of the devices in a drivers file.'),
    'calibrate network': Command('calibrate', 'Calibrate sensor orientations, clocks and noise.'),
    'calibrate tumble': Command(
        'calibrate', 'Calibrate hard and soft iron by rotating the sensors.'),
    'calibrate board': Command(
        'board_geometry', 'Calibrate the geometry of a board with a magnet.'),
    'doctor': Command('doctor', 'Diagnose sensor faults.'),
    'info': Command('recordings', 'Summarise the content of a recording.'),
    'import': Command('recordings', 'Convert a CSV table to a recording.'),
    'repair': Command('recordings', 'Rebuild the index of an incomplete recording.'),
    'run': Command('nodes', 'Run all nodes in one process (needs ROS 2).'),
    'record': Command('nodes', 'Record the sensors (needs ROS 2).'),
    'ros topics': Command('ros', 'List the topics of the ROS graph.'),
    'ros echo': Command('ros', 'Print the messages of a topic.'),
    'ros param': Command('ros', 'Show or set the parameters of a node.'),
    'ros lifecycle': Command('ros', 'Show or change the state of a node.'),
    'ros watch': Command('ros', 'Show running nodes on a live page.'),
}
"""Commands and, after a space, their subcommands."""
PARENTS = {
    'classes': 'Train and apply a classifier of passes at one sensor.',
    'calibrate': 'Calibrate a network, hand-held sensors or a board.',
    'ros': 'Inspect and control running nodes (needs ROS 2).',
}
GROUPS = {
    'process recordings': ('replay', 'fit', 'archive', 'classes'),
    'set up sensors': ('plan', 'listen', 'calibrate', 'doctor'),
    'manage recordings': ('info', 'import', 'repair'),
    'run live': ('run', 'record', 'ros'),
}
"""Commands by purpose, in the order of the help text."""
RENAMED = {
    'traffic': 'replay --tables passages', 'events': 'replay --tables events',
    'view': 'replay --live', 'watch': 'ros watch', 'topics': 'ros topics', 'echo': 'ros echo',
    'param': 'ros param', 'lifecycle': 'ros lifecycle', 'tumble': 'calibrate tumble',
    'calibrate': 'calibrate network', 'board-geometry': 'calibrate board',
    'geometry': 'calibrate board',
}
"""Present forms of former commands, and of a command that has subcommands now."""


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse a command line without the program name; `run_command` returns the exit status."""
    parser = argparse.ArgumentParser(
        prog='mag-tracking', usage='%(prog)s [--help] [--version] COMMAND ...',
        description='Track magnetic targets with stationary magnetometers.', epilog=_overview(),
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--version', action='version', version=f'mag_tracking {version(PACKAGE)}')
    arguments = list(arguments)
    ros_start = arguments.index(ROS_ARGUMENTS) if ROS_ARGUMENTS in arguments else len(arguments)
    requested = _requested(parser, [word for word in arguments[:ros_start] if word[:1] != '-'])
    module = COMMANDS[requested].module if requested in COMMANDS else None
    commands = {'': parser.add_subparsers(dest='command', required=True, metavar='COMMAND',
                                          prog=parser.prog, help=argparse.SUPPRESS)}
    for name, summary in PARENTS.items():
        commands[name] = commands[''].add_parser(name, description=summary).add_subparsers(
            dest='action', required=True, metavar='SUBCOMMAND')
    if module is not None:
        import_module(f'{PACKAGE}.cli.{module}').add(commands[requested.rpartition(' ')[0]])
    for name, command in COMMANDS.items():
        parent, _, word = name.rpartition(' ')
        if command.module != module:
            commands[parent].add_parser(word, help=command.summary)
    args = parser.parse_args(arguments[:ros_start])
    args.ros_arguments = arguments[ros_start:]
    if args.ros_arguments and args.command not in ROS_COMMANDS:
        parser.error(f'{ROS_ARGUMENTS}: {args.command} runs without ROS; ROS arguments are '
                     f'accepted by {", ".join(ROS_COMMANDS)}')
    return args


def _overview() -> str:
    lines = []
    for group, names in GROUPS.items():
        lines += [f'{group}:', *(f'  {name:11}{PARENTS.get(name) or COMMANDS[name].summary}'
                                 for name in names), '']
    return '\n'.join([*lines, 'For the options of a command, run "mag-tracking COMMAND --help".'])


def _requested(parser: argparse.ArgumentParser, words: Sequence[str]) -> str:
    """Return the requested command, or '' without words; exit if it is unknown or renamed."""
    requested = ''
    for word in words:
        names = dict.fromkeys(name[len(requested):].split()[0] for name in COMMANDS
                              if name.startswith(requested))
        if word not in names:
            _exit(parser, requested, word, names)
        requested += word
        if requested not in PARENTS:
            break
        requested += ' '
    return requested.strip()


def _exit(parser: argparse.ArgumentParser, parent: str, word: str,
          names: Iterable[str]) -> NoReturn:
    """Exit with the present form of a former command, or with the most similar command."""
    if not parent and word in RENAMED:
        parser.exit(2, f'{parser.prog}: {word} is now: {parser.prog} {RENAMED[word]}\n')
    similar = get_close_matches(word, names, 1)
    if parent.strip() in RENAMED and not similar:
        parser.exit(2, f'{parser.prog}: {parent}is now: {parser.prog} {RENAMED[parent.strip()]}\n')
    parser.exit(2, f'{parser.prog}: unknown command {parent}{word}; '
                + (f'did you mean {parent}{similar[0]}?' if similar else
                   f'expected {", ".join(names)}') + '\n')
