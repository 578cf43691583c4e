"""Command `mag-tracking import`."""

import argparse
import datetime
from pathlib import Path

from mag_tracking.cli.options import Commands, add_command
from mag_tracking.cli.table_options import add_table_options, print_notes, table_options
from mag_tracking.errors import SettingsError
from mag_tracking.quantities import quantity
from mag_tracking.units import NS

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


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'import', _import, _IMPORT_HELP)
    p.add_argument('table', type=Path, metavar='TABLE', help='table of readings or poses')
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='output folder')
    add_table_options(p)
    poses = p.add_argument_group('table of magnet poses')
    poses.add_argument('--background', type=Path, metavar='FILE.csv',
                       help='table with the background of each sensor')
    poses.add_argument('--noise-std', type=float, default=1e-6, metavar='TESLA',
                       help='noise standard deviation of one reading (default: 1e-6)')


def _import(args: argparse.Namespace) -> int:
    """Run `mag-tracking import`."""
    # Imported here because other commands do not need them.
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
    recordings, content = import_field_table(args.table, table_options(args), args.out)
    print_notes(args.table, content.notes)
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
