"""Options shared by several commands, and what they select."""

import argparse
import dataclasses
import datetime
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from mag_tracking.cli.commands import COMMANDS
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.network.sensor_network import MAX_BOARD_EXTENT, checked_namespace
from mag_tracking.settings import TARGETS, read_parameter_file
from mag_tracking.stages.health.diagnosis import Diagnosis
from mag_tracking.web import DEFAULT_PORT, LOOPBACK

if TYPE_CHECKING:
    # Not every command loads the stages.
    from mag_tracking.pipeline import Settings
    from mag_tracking.recording.field_table import TableOptions

# Quoted because the class is not generic at run time.
Commands: TypeAlias = 'argparse._SubParsersAction[argparse.ArgumentParser]'
"""Subparsers of the main parser or of a command, to which each command is added."""


def add_command(commands: Commands, name: str, run: Callable[[argparse.Namespace], int],
                text: str = '') -> argparse.ArgumentParser:
    """Add the parser of the command `name` in `COMMANDS`; `text` is printed after its options."""
    summary = COMMANDS[name].summary
    parser = commands.add_parser(
        name.rpartition(' ')[2], help=summary, description=summary, epilog=text,
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
    """Names of results without extension; raises OutputError if two recordings share one."""
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


def add_page(parser: argparse._ActionsContainer, port: bool = True) -> None:
    """Add --host and --port, or only --host."""
    if port:
        parser.add_argument('--port', type=int, default=DEFAULT_PORT, metavar='PORT',
                            help=f'port of the page (default: {DEFAULT_PORT}; 0 selects a free '
                            'port)')
    parser.add_argument('--host', default=LOOPBACK, metavar='ADDRESS', help='local address of '
                        f'the page (default: {LOOPBACK})')


def check_writable(path: Path | None) -> None:
    """Raise OutputError if the folder of an output file is missing, or if it is a folder."""
    if path is not None and not path.absolute().parent.is_dir():
        raise OutputError(f'cannot write {path}: the folder {path.parent} does not exist')
    if path is not None and path.is_dir():
        raise OutputError(f'cannot write {path}: it is a folder')


def check_report(args: argparse.Namespace, *others: Path | None) -> None:
    """Raise OutputError if --report cannot be written, is not HTML, or would replace `others`."""
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
    """Raise OutputError if --out or --figure cannot be written, SettingsError for the file type."""
    for path in (args.out, args.figure):
        check_writable(path)
    if args.figure is not None:
        # Imported here because it loads matplotlib.
        from matplotlib.backend_bases import FigureCanvasBase

        types = FigureCanvasBase.get_supported_filetypes()
        if args.figure.suffix.lower().removeprefix('.') not in types:
            raise SettingsError(f'--figure: expected a file name ending in .{", .".join(types)}; '
                                f'got {args.figure.name}')


def print_diagnoses(diagnoses: Iterable[Diagnosis]) -> None:
    """Print one line per diagnosis."""
    for diagnosis in diagnoses:
        print(f'  {"warning: " if diagnosis.serious else ""}{diagnosis}')


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add --target and --params."""
    parser.add_argument('--params', type=Path, metavar='FILE',
                        help='YAML file with the settings to override')
    parser.add_argument('--target', choices=TARGETS,
                        help='type of target: a vehicle, a magnet in a hand, or a magnet on a '
                        'bench (default: magnet for a board of sensors, otherwise vehicle)')


def settings_of(args: argparse.Namespace, network: SensorNetwork) -> 'Settings':
    """Settings of --target and --params, by default for a magnet if the sensors form a board."""
    from mag_tracking.pipeline import settings_for

    changes = read_parameter_file(args.params) if args.params else {}
    if args.target is not None:
        return settings_for(args.target, changes)
    if 'track.target' in changes or not network.is_board:
        return settings_for(changes.get('track.target', 'vehicle'), changes)
    print(f'{args.network}: {len(network)} sensors within {MAX_BOARD_EXTENT:g} m: the settings for '
          'a magnet are used; --target vehicle selects those for vehicles')
    return settings_for('magnet', changes)


def add_table_options(parser: argparse.ArgumentParser, sensor: bool = True) -> None:
    """Add the options that describe a table of readings, with or without --sensor."""
    p = parser.add_argument_group('table of readings', 'properties that are found if not given')
    p.add_argument('--columns', nargs='+', metavar='KEY=COLUMN',
                   help='columns, by name or number (from 1): time=, and x= y= z= with sensor=, or '
                   'for each sensor NAME.x= NAME.y= NAME.z=')
    p.add_argument('--unit', default='', metavar='UNIT',
                   help='unit of the field: T, mT, uT, nT, G or mG, counts per unit such as '
                   '1090/G, or tesla per count')
    p.add_argument('--time-unit', default='', metavar='UNIT',
                   help='unit of times that are numbers: s, ms, us, ns, min, h, d, ticks per unit '
                   'such as 32768/s, or seconds per tick')
    if sensor:
        p.add_argument('--sensor', default='', metavar='NAME',
                       help='name of the only sensor (default: mag_1)')
    p.add_argument('--sensors', nargs='+', default=[], metavar='TEXT=NAME',
                   help='names of the sensors by the text in their column, or - to ignore it')
    p.add_argument('--separator', default='', metavar='CHARACTER',
                   help='comma, semicolon, tab, spaces, bar, or another character')
    p.add_argument('--decimal', default='', metavar='MARK', help="decimal mark, . or ','")
    p.add_argument('--header', type=int, metavar='LINE',
                   help='number of the header line; 0 without a header')
    p.add_argument('--encoding', default='', metavar='NAME', help='such as utf-16 or latin-1')
    p.add_argument('--date-order', default='', metavar='ORDER',
                   help='order of a date of three numbers: dmy, mdy or ymd')
    p.add_argument('--rate', type=float, metavar='HZ',
                   help='rate of the readings, for tables without times or with coarse times')
    p.add_argument('--wrap', type=int, default=0, metavar='N',
                   help='number at which the time returns to 0')
    p.add_argument('--jumps', default='', metavar='split|sort',
                   help='meaning of a time that runs backwards: the clock restarted (split into '
                   'recordings), or the rows are out of order (sort)')


def table_options(args: argparse.Namespace, sensor: str | None = None) -> 'TableOptions':
    """Collect the options of `add_table_options`, with the name `sensor` if not an option."""
    from mag_tracking.recording.field_table import TableOptions

    sensors = dict(text.rpartition('=')[::2] for text in args.sensors)
    if '' in sensors or not all(sensors.values()):
        raise SettingsError('--sensors: expected TEXT=NAME such as A=mag_1')
    return TableOptions(
        args.columns or (), args.unit, args.time_unit,
        args.sensor if sensor is None else sensor, sensors,
        args.separator, args.decimal, args.header, args.encoding, args.date_order, args.rate,
        args.wrap, args.jumps)


def print_notes(table: Path, notes: Iterable[str]) -> None:
    """Print what was found out about a table, with each warning on its own line."""
    notes = list(notes)
    print(f'{table}: {"; ".join(n for n in notes if not n.startswith("warning"))}')
    for note in notes:
        if note.startswith('warning'):
            print(f'  {note}')
