"""Command `mag-tracking repair`."""

import argparse
from pathlib import Path

from mag_tracking.cli.options import Commands, add_command
from mag_tracking.recording.repair import repair

_REPAIR_HELP = '''
A recording that was interrupted (power failure, crash, full disk) has no index.
`mag-tracking replay` can still read it; rosbag2 and other tools need the index.
This command writes the index and a new metadata.yaml, and keeps the messages unchanged.
The complete messages of a chunk that was cut are written as a new chunk. Damaged chunks cannot be
restored. If nothing can be recovered, the exit status is 1.

example:
  mag-tracking repair night
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'repair', _repair, _REPAIR_HELP)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='.mcap file or rosbag2 folder')


def _repair(args: argparse.Namespace) -> int:
    """Run `mag-tracking repair`."""
    n = repair(args.recording)
    print(f'{args.recording}: files repaired: {n}')
    return 0
