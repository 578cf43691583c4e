"""Options that several commands share; `tracking_options` has those of the tracker."""

import argparse
import dataclasses
import datetime
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeAlias

from mag_tracking.cli.commands import COMMANDS
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.network.topics import checked_namespace

# Quoted: at run time the class takes no type arguments.
Commands: TypeAlias = 'argparse._SubParsersAction[argparse.ArgumentParser]'
"""The parser's commands, to which each module adds its own."""

FIGURES = ('.png', '.pdf', '.svg')


def add_command(commands: Commands, name: str, run: Callable[[argparse.Namespace], int],
                text: str = '') -> argparse.ArgumentParser:
    """A command's parser; `run` takes the parsed arguments and returns the exit status."""
    _, short, aliases = COMMANDS[name]
    parser = commands.add_parser(name, aliases=aliases, help=short, description=short, epilog=text,
                                 formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(run_command=run, ros_arguments=[])
    return parser


def add_network(parser: argparse._ActionsContainer, required: bool = True,
                text: str = 'positions and orientations of the sensors (network.yaml)') -> None:
    """--network."""
    parser.add_argument('--network', required=required, type=Path, metavar='FILE', help=text)


def add_recorded_network(parser: argparse._ActionsContainer) -> None:
    """--network and --namespace."""
    add_network(parser)
    parser.add_argument('--namespace', metavar='NAMESPACE', help='of the relative topics of the '
                        'network file, such as /robot1, where the recording has several')


def recorded_network(args: argparse.Namespace) -> SensorNetwork:
    """The network of `add_recorded_network`; raises NetworkError."""
    network = read_network(args.network)
    if args.namespace is None:
        return network
    return dataclasses.replace(network, namespace=checked_namespace(args.namespace))


def distinct_names(paths: Iterable[Path]) -> list[str]:
    """Stems of recordings; raises OutputError where results would overwrite each other."""
    names = [path.resolve().stem for path in paths]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise OutputError(f'two recordings are named {twice[0]}: their results would overwrite '
                          'each other; take them one by one')
    return names


def now() -> str:
    """The time, as a calibration is marked with it."""
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec='seconds')


def add_report(parser: argparse.ArgumentParser) -> None:
    """--report."""
    parser.add_argument('--report', type=Path, metavar='FILE.html',
                        help='write a report for the browser')


def check_writable(path: Path | None) -> None:
    """Raise OutputError if a file cannot be written because of its folder."""
    if path is not None and not path.absolute().parent.is_dir():
        raise OutputError(f'cannot write {path}: there is no folder {path.parent}')
    if path is not None and path.is_dir():
        raise OutputError(f'cannot write {path}: it is a folder')


def check_report(args: argparse.Namespace, *others: Path | None) -> None:
    """Raise OutputError if the report cannot be written, or would replace another file."""
    path = args.report
    if path is None:
        return
    check_writable(path)
    if path.suffix.lower() not in ('.html', '.htm'):
        raise OutputError(f'--report: {path.name} does not end in .html')
    if any(other is not None and other.resolve() == path.resolve() for other in others):
        raise OutputError(f'--report: {path} is another file of this command')


def check_outputs(args: argparse.Namespace) -> None:
    """Raise OutputError where what is to be written has no folder to be in."""
    for path in (args.out, args.figure):
        check_writable(path)
    if args.figure is not None and args.figure.suffix.lower() not in FIGURES:
        raise SettingsError(f'--figure: {args.figure.name} ends in none of {", ".join(FIGURES)}')
