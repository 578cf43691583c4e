"""mag-tracking import."""

import argparse
from pathlib import Path

from mag_tracking.cli.options import Commands, add_command
from mag_tracking.errors import SettingsError

_IMPORT = '''
Turns a table (CSV with a header) into a recording.

Readings: --columns says which column is what, --unit what the field is in. Either a row is one
reading and a column names the sensor (sensor, x, y, z), or a row has all sensors (NAME.x, NAME.y,
NAME.z). Axes that are not measured are left out. A sensor of the number 3 becomes mag_3. The
network.yaml with the sensors' positions is yours to write (config/network.yaml is an example).

  mag-tracking import log.csv --columns time=t sensor=id x=bx y=by z=bz --unit uT --out log
  mag-tracking import log.csv --columns time=ms left.x=x1 left.y=y1 right.x=x2 right.y=y2 \\
      --unit gauss --time-unit ms --out log

Poses of a magnet: with --background, a table with a row a sensor and pose (id, timestamp [s],
Bx By Bz [uT, sensor frame], sensor_x..z [mm], sensor_ox..oz [rad], m_x..z [mm], m_ox..oz [rad])
and the background per sensor [uT] become a recording and a network.yaml.

  mag-tracking import poses.csv --background background.csv --out magnet
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'import', _import, _IMPORT)
    p.add_argument('table', type=Path, metavar='TABLE.csv')
    p.add_argument('--columns', nargs='+', metavar='WHAT=COLUMN',
                   help='time=, and sensor= x= y= z=, or NAME.x= NAME.y= NAME.z= of each sensor')
    p.add_argument('--unit', metavar='UNIT', help='of the field: T, mT, uT, nT, gauss or mgauss')
    p.add_argument('--time-unit', default='s', metavar='UNIT',
                   help='of the time: s, ms, us or ns (default: s)')
    p.add_argument('--background', type=Path, metavar='FILE.csv', help='for poses of a magnet')
    p.add_argument('--out', required=True, type=Path, metavar='DIR')
    p.add_argument('--noise-std', type=float, default=1e-6, metavar='TESLA',
                   help='noise of one reading of a table of poses (default: 1e-6)')


def _import(args: argparse.Namespace) -> int:
    """mag-tracking import."""
    if (args.columns is None) == (args.background is None):
        raise SettingsError('import: either --columns (readings) or --background (poses of a '
                            'magnet)')
    # Only this command needs them.
    from mag_tracking.recording.field_table import import_field_table
    from mag_tracking.recording.importers import import_pose_table

    if args.columns is None:
        recording, network, n = import_pose_table(args.table, args.background, args.out,
                                                  args.noise_std)
        print(f'{n} readings in {recording}, the network in {network}')
        return 0
    if args.unit is None:
        raise SettingsError('import: --unit is needed; a table does not tell tesla from gauss')
    recording, counts = import_field_table(args.table, args.columns, args.unit, args.out,
                                           args.time_unit)
    print(f'{sum(counts.values())} readings in {recording}')
    for name, n in counts.items():
        print(f'  /{name}/imu/mag  {n}')
    return 0
