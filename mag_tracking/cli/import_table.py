"""Command `mag-tracking import`."""

import argparse
from pathlib import Path

from mag_tracking.cli.options import Commands, add_command
from mag_tracking.errors import SettingsError
from mag_tracking.quantities import quantity

_IMPORT_HELP = '''
Converts a table (CSV with a header) to a recording.

Table of readings: --columns assigns the columns and --unit gives the unit of the field. Each row
contains either one reading, with the sensor in a column (sensor, x, y, z), or one reading of each
sensor (NAME.x, NAME.y, NAME.z). Omit axes that are not measured. A sensor with the number 3 is
named mag_3. Write a network file with the positions of the sensors yourself; config/network.yaml
is an example.

  mag-tracking import log.csv --columns time=t sensor=id x=bx y=by z=bz --unit uT --out log
  mag-tracking import log.csv --columns time=ms left.x=x1 left.y=y1 right.x=x2 right.y=y2 \\
      --unit gauss --time-unit ms --out log

Table of magnet poses: with --background, a table with one row per sensor and pose (id,
timestamp [s], Bx By Bz [uT, sensor frame], sensor_x..z [mm], sensor_ox..oz [rad], m_x..z [mm],
m_ox..oz [rad]) and a table with the background of each sensor [uT] are converted to a recording
and a network file.

  mag-tracking import poses.csv --background background.csv --out magnet
'''


def add(commands: Commands) -> None:
    """Register the command.

    Parameters
    ----------
    commands : Commands
    """
    p = add_command(commands, 'import', _import, _IMPORT_HELP)
    p.add_argument('table', type=Path, metavar='TABLE.csv', help='table of readings or poses')
    p.add_argument('--columns', nargs='+', metavar='KEY=COLUMN',
                   help='columns of a table of readings: time=, and sensor= x= y= z= or, for each '
                   'sensor, NAME.x= NAME.y= NAME.z=')
    p.add_argument('--unit', metavar='UNIT',
                   help='unit of the field: T, mT, uT, nT, gauss or mgauss')
    p.add_argument('--time-unit', default='s', metavar='UNIT',
                   help='unit of the time: s, ms, us or ns (default: s)')
    p.add_argument('--background', type=Path, metavar='FILE.csv',
                   help='table with the background of each sensor, for a table of magnet poses')
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='output folder')
    p.add_argument('--noise-std', type=float, default=1e-6, metavar='TESLA',
                   help='noise standard deviation of one reading in a table of magnet poses '
                   '(default: 1e-6)')


def _import(args: argparse.Namespace) -> int:
    """Run `mag-tracking import`."""
    if (args.columns is None) == (args.background is None):
        raise SettingsError('import: give either --columns (table of readings) or --background '
                            '(table of magnet poses)')
    # Imported here because other commands do not need them.
    from mag_tracking.recording.field_table import import_field_table
    from mag_tracking.recording.importers import import_pose_table

    if args.columns is None:
        recording, network, n = import_pose_table(args.table, args.background, args.out,
                                                  args.noise_std)
        print(f'{quantity(n, "reading")} written to {recording}, network to {network}')
        return 0
    if args.unit is None:
        raise SettingsError('import: --unit is missing; give the unit of the field')
    recording, counts = import_field_table(args.table, args.columns, args.unit, args.out,
                                           args.time_unit)
    print(f'{quantity(sum(counts.values()), "reading")} written to {recording}')
    for name, n in counts.items():
        print(f'  /{name}/imu/mag  {n}')
    return 0
