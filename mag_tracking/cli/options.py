"""Options shared by several commands; see `tracking_options` for the options of the tracker."""

import argparse
import dataclasses
import datetime
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeAlias

from tqdm import tqdm

from mag_tracking.cli.commands import COMMANDS
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.network.sensor_network import checked_namespace
from mag_tracking.stages.health.diagnosis import Diagnosis

if TYPE_CHECKING:
    # Not every command loads the stages.
    from mag_tracking.run import RecordingSource

# Quoted because the class is not generic at run time.
Commands: TypeAlias = 'argparse._SubParsersAction[argparse.ArgumentParser]'
"""Subparsers of the main parser or of a command, to which each command is added."""

FIGURE_SUFFIXES = ('.png', '.pdf', '.svg')
"""File name extensions accepted for figures."""


def add_command(commands: Commands, name: str, run: Callable[[argparse.Namespace], int],
                text: str = '') -> argparse.ArgumentParser:
    """Add the parser of a command or subcommand; `name` is a key in `COMMANDS`.

    `run` takes the parsed arguments and returns the exit status. `text`, with the description and
    examples, is printed after the options.
    """
    summary = COMMANDS[name].summary
    parser = commands.add_parser(name.rpartition(' ')[2], help=summary, description=summary,
                                 epilog=text,
                                 formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.set_defaults(run_command=run, ros_arguments=[])
    return parser


def add_network(parser: argparse._ActionsContainer, required: bool = True,
                text: str = 'network file with the sensors (network.yaml)') -> None:
    """Add --network, with the help `text`."""
    parser.add_argument('--network', required=required, type=Path, metavar='FILE', help=text)


def add_recorded_network(parser: argparse._ActionsContainer) -> None:
    """Add --network and --namespace."""
    add_network(parser)
    parser.add_argument('--namespace', metavar='NAMESPACE', help='namespace of the relative topics '
                        'in the network file (e.g. /robot1), if the recording contains several '
                        'namespaces')


def recorded_network(args: argparse.Namespace) -> SensorNetwork:
    """Read the network of --network and --namespace; raises NetworkError if one is invalid."""
    network = read_network(args.network)
    if args.namespace is None:
        return network
    return dataclasses.replace(network, namespace=checked_namespace(args.namespace))


def distinct_names(paths: Iterable[Path]) -> list[str]:
    """Names without extension under which the results of the recordings are stored.

    Raises OutputError if two names are equal, so that the results would overwrite each other.
    """
    names = [path.resolve().stem for path in paths]
    duplicates = sorted({name for name in names if names.count(name) > 1})
    if duplicates:
        raise OutputError(f'several recordings are named {duplicates[0]}: their results would '
                          'overwrite each other; run the command once per recording')
    return names


def utc_timestamp() -> str:
    """Current time (UTC, ISO 8601), for use as the date of a calibration."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec='seconds')


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add --report."""
    parser.add_argument('--report', type=Path, metavar='FILE.html',
                        help='write an HTML report to FILE.html')


def add_verbose(parser: argparse.ArgumentParser) -> None:
    """Add --verbose."""
    parser.add_argument('-v', '--verbose', action='store_true',
                        help='print the details of each vehicle')


def check_writable(path: Path | None) -> None:
    """Check that an output file can be created; raises OutputError if its folder is missing, or if
    it is a folder."""
    if path is not None and not path.absolute().parent.is_dir():
        raise OutputError(f'cannot write {path}: the folder {path.parent} does not exist')
    if path is not None and path.is_dir():
        raise OutputError(f'cannot write {path}: it is a folder')


def check_report(args: argparse.Namespace, *others: Path | None) -> None:
    """Check that the report can be written without replacing another file of the command.

    Raises OutputError if the folder is missing, the path is a folder, the name ends in neither
    .html nor .htm, or the file is one of `others`.
    """
    path = args.report
    if path is None:
        return
    check_writable(path)
    if path.suffix.lower() not in ('.html', '.htm'):
        raise OutputError(f'--report: expected a file name ending in .html, got {path.name}')
    if any(other is not None and other.resolve() == path.resolve() for other in others):
        raise OutputError(f'--report: {path} is also an input or output of this command; choose '
                          'another file')


def check_outputs(args: argparse.Namespace) -> None:
    """Check that the files of --out and --figure can be written.

    Raises OutputError if the folder of a file is missing or the file is a folder, and SettingsError
    if the file type of the figure is not supported.
    """
    for path in (args.out, args.figure):
        check_writable(path)
    if args.figure is not None and args.figure.suffix.lower() not in FIGURE_SUFFIXES:
        raise SettingsError(f'--figure: expected a file name ending in '
                            f'{", ".join(FIGURE_SUFFIXES)}; got {args.figure.name}')


def progress_bar(source: 'RecordingSource') -> 'tqdm[NoReturn]':
    """Progress bar of the bytes of a recording, shown only in a terminal."""
    return tqdm(total=source.recording.size, unit='B', unit_scale=True, desc=source.name,
                disable=None)


def print_diagnoses(diagnoses: Iterable[Diagnosis]) -> None:
    """Print one line per diagnosis."""
    for diagnosis in diagnoses:
        print(f'  {"warning: " if diagnosis.serious else ""}{diagnosis}')
