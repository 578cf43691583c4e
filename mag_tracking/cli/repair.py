"""mag-tracking repair."""

import argparse
from pathlib import Path

from mag_tracking.cli.options import Commands, add_command
from mag_tracking.recording.repair import repair

_REPAIR = '''
A recording that was cut off (power, a crash, a full disk) has no index.
`mag-tracking replay` reads it as it is; rosbag2 and others need the index,
which this writes, and a new metadata.yaml. The messages stay untouched.

example:
  mag-tracking repair night
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'repair', _repair, _REPAIR)
    p.add_argument('recording', type=Path, metavar='RECORDING',
                   help='an .mcap file or a rosbag2 folder')


def _repair(args: argparse.Namespace) -> int:
    """mag-tracking repair."""
    n = repair(args.recording)
    print(f'{args.recording}: files that were not whole: {n}')
    return 0
