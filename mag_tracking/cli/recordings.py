"""Commands `mag-tracking info`, `import` and `repair`."""

import argparse
import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from mag_tracking.cli import options
from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.network.sensor_network import absolute, namespaces_of
from mag_tracking.quantities import quantity
from mag_tracking.units import NS

if TYPE_CHECKING:
    from mag_tracking.apps.info import Source, Timing
    from mag_tracking.recording.reader import Recording

_IMPORT_HELP = '''
Converts a table of text (CSV, TSV, lines of numbers) to a recording. Encoding, separator, decimal
mark, preamble, header, line of units and form of the time are found from the table and printed;
an ambiguous property is refused with the option that states it.

Table of readings: the columns are found by their names, or assigned by --columns. Each row
contains either one reading (x, y, z, and sensor if there are several) or one reading of each sensor
(NAME.x, NAME.y, NAME.z). Omit axes that are not measured. A sensor with the number 3 is named
mag_3. Two columns of date and time are joined: time=Date+Time. Write a network file with the
positions of the sensors yourself; config/network.yaml is an example.

  mag-tracking import phone.csv --out phone
  mag-tracking import log.csv --columns time=t sensor=id x=bx y=by z=bz --unit uT --out log
  mag-tracking import raw.txt --columns time=1 sensor=2 x=3 y=4 z=5 --unit 1090/G --out raw
  mag-tracking import log.csv --columns time=ms left.x=x1 left.y=y1 right.x=x2 right.y=y2 \\
      --unit gauss --time-unit ms --out log

Table of magnet poses: with --background, a table with one row per sensor and pose (id,
timestamp [s], Bx By Bz [uT, sensor frame], sensor_x..z [mm], sensor_ox..oz [rad], m_x..z [mm],
m_ox..oz [rad]) and a table with the background of each sensor [uT] are converted to a recording
and a network file.

  mag-tracking import poses.csv --background background.csv --out magnet
'''

_REPAIR_HELP = '''
A recording that was interrupted (power failure, crash, full disk) has no index.
`mag-tracking replay` can still read it; rosbag2 and other tools need the index.
This command writes the index and a new metadata.yaml, and keeps the messages unchanged.
The complete messages of a chunk that was cut are written as a new chunk. Damaged chunks cannot be
restored. If nothing can be recovered, the exit status is 1.

example:
  mag-tracking repair night
'''


def add(commands: options.Commands) -> None:
    """Register the commands."""
    p = options.add_command(commands, 'info', _info)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='.mcap, .db3 or .bag file, or rosbag2 folder')
    options.add_network(p, False, 'network file; report which of its topics are recorded')
    p = options.add_command(commands, 'import', _import, _IMPORT_HELP)
    p.add_argument('table', type=Path, metavar='TABLE', help='table of readings or poses')
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='output folder')
    options.add_table_options(p)
    poses = p.add_argument_group('table of magnet poses')
    poses.add_argument('--background', type=Path, metavar='FILE.csv',
                       help='table with the background of each sensor')
    poses.add_argument('--noise-std', type=float, default=1e-6, metavar='TESLA',
                       help='noise standard deviation of one reading (default: 1e-6)')
    p = options.add_command(commands, 'repair', _repair, _REPAIR_HELP)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='.mcap file or rosbag2 folder')


def _info(args: argparse.Namespace) -> int:
    # Imported here, as in the other functions, because other commands do not need them.
    from mag_tracking.apps.info import time_topics
    from mag_tracking.recording.reader import Recording

    recording = Recording(args.recording)
    with tqdm(total=recording.size, unit='B', unit_scale=True, desc=args.recording.name,
              disable=None) as bar:
        timings, faults, counts = time_topics(recording, bar.update)
    print(f'{recording.path}: {recording.size / 1e6:.2f} MB, '
          f'{quantity(counts.total(), "message")}')
    _print_duration(recording, list(timings.values()))
    if not counts:
        print('  warning: the recording contains no messages')
    by_topic: dict[str, dict[str, Timing]] = {}
    for source, timing in timings.items():
        by_topic.setdefault(source.topic, {})[source.sensor] = timing
    for topic, kind in sorted(recording.types.items()):
        sensors = by_topic.get(topic, {})
        rate = next(iter(sensors.values())).describe() if len(sensors) == 1 else ''
        print(f'  {topic}  {kind}  {counts[topic]}' + (f'  {rate}' if rate else ''))
        for sensor, timing in sensors.items() if len(sensors) > 1 else ():
            print(f'    {sensor or "no frame_id"}  {timing.n_messages}  {timing.describe()}')
    for cause, n in {**faults, **recording.losses}.items():
        print(f'  warning: {cause}: {n}')
    if args.network:
        _print_sensors(read_network(args.network), recording, timings)
    return 0


def _print_duration(recording: 'Recording', timings: 'Sequence[Timing]') -> None:
    """Print the duration by the log times, or by the timestamps if they contradict each other."""
    wrong = next((timing for timing in timings if timing.clocks_disagree), None)
    if wrong is not None:
        print(f'  {wrong.span_s:.2f} s by the timestamps\n  warning: the log times span '
              f'{wrong.log_span_s:.2f} s: the clock of the recorder jumped or was wrong, or the '
              'timestamps are')
    elif recording.start_ns is not None and recording.end_ns is not None:
        print(f'  {(recording.end_ns - recording.start_ns) / 1e9:.2f} s')


def _print_sensors(network: SensorNetwork, recording: 'Recording',
                   timings: 'Mapping[Source, Timing]') -> None:
    from mag_tracking.messages.types import MAGNETIC_FIELD

    namespaces = namespaces_of(network.topics, recording.types) or ['/']
    if len(namespaces) > 1:
        print(f'  namespaces with topics of the network: {", ".join(namespaces)}')
    for name, topic in zip(network.names, network.topics, strict=True):
        topic = absolute(topic, namespaces[0])
        kind = recording.types.get(topic)
        state = 'MISSING' if kind is None else 'recorded' if kind == MAGNETIC_FIELD \
            else f'recorded as {kind}, not {MAGNETIC_FIELD}'
        shared = sorted({source.topic for source in timings if source.sensor == name})
        if kind is None and shared:
            state = f'not recorded, but its frame_id is on {", ".join(shared)}'
        print(f'  sensor {name}: {topic} is {state}')


def _import(args: argparse.Namespace) -> int:
    from mag_tracking.recording.field_table import describe, import_field_table
    from mag_tracking.recording.pose_table import import_pose_table

    if args.background is not None:
        if args.columns is not None:
            raise SettingsError('import: --columns is for a table of readings and --background for '
                                'a table of magnet poses; give one of them')
        recording, network, n = import_pose_table(args.table, args.background, args.out,
                                                  args.noise_std)
        print(f'{quantity(n, "reading")} written to {recording}, network to {network}')
        return 0
    recordings, content = import_field_table(args.table, options.table_options(args), args.out)
    options.print_notes(args.table, content.notes)
    for recording, readings in zip(recordings, content.sessions, strict=True):
        first, last = (int(t) for t in readings.stamp_ns[[0, -1]])
        print(f'{quantity(len(readings), "reading")} written to {recording}: '
              f'{(last - first) / NS:.6g} s from {_time_text(first)}')
        for line in describe(readings):
            print(f'  {line}')
    return 0


def _time_text(stamp_ns: int) -> str:
    """Date and time of a timestamp, or seconds if it is not since 1970."""
    if stamp_ns < 365 * 86400 * NS:
        return f'{stamp_ns / NS:.6g} s'
    return f'{datetime.datetime.fromtimestamp(stamp_ns // NS, datetime.UTC):%F %T} UTC'


def _repair(args: argparse.Namespace) -> int:
    from mag_tracking.recording.repair import repair

    n = repair(args.recording)
    print(f'{args.recording}: files repaired: {n}')
    return 0
