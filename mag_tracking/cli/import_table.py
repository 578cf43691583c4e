"""mag-tracking import."""

import argparse
from pathlib import Path

from mag_tracking.cli.options import Commands, add_command

_IMPORT = '''
Turns a table of magnet poses (a row a sensor and pose: id, timestamp [s],
Bx By Bz [uT, sensor frame], sensor_x..z [mm], sensor_ox..oz [rad], m_x..z [mm],
m_ox..oz [rad]) and the background per sensor [uT] into a recording and a
network.yaml.

example:
  mag-tracking import poses.csv --background background.csv --out magnet
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'import', _import, 'Turn a table of magnet poses into a recording.',
                    _IMPORT)
    p.add_argument('table', type=Path, metavar='POSES.csv')
    p.add_argument('--background', required=True, type=Path, metavar='FILE.csv')
    p.add_argument('--out', required=True, type=Path, metavar='DIR')
    p.add_argument('--noise-std', type=float, default=1e-6, metavar='TESLA',
                   help='noise of one reading (default: 1e-6)')


def _import(args: argparse.Namespace) -> int:
    """mag-tracking import."""
    # Only this command needs it.
    from mag_tracking.recording.importers import import_pose_table

    recording, network, n = import_pose_table(args.table, args.background, args.out,
                                              args.noise_std)
    print(f'{n} readings in {recording}, the network in {network}')
    return 0
