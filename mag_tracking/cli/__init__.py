"""The command `mag-tracking`: one module a command."""

import argparse
import sys
from collections.abc import Sequence

from mag_tracking.cli import (
    board_geometry,
    calibrate,
    doctor,
    fit,
    import_table,
    info,
    listen,
    plan,
    record,
    repair,
    replay,
    run,
    tumble,
)
from mag_tracking.errors import MagTrackingError


def _parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog='mag-tracking', description='Track magnetic targets with stationary magnetometers.')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for module in (replay, calibrate, tumble, board_geometry, doctor, fit, plan, listen, record,
                   repair, run, info, import_table):
        module.add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status (1 for an error that a message explains)."""
    args = _parser().parse_args(argv)
    try:
        status: int = args.run_command(args)
        return status
    except (MagTrackingError, OSError) as error:
        # An OSError here is a full disk or a lost drive; its text names the file.
        print(f'mag-tracking: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('mag-tracking: interrupted', file=sys.stderr)
        return 130
