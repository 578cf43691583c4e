"""The command `mag-tracking`: one module a command, or a few small ones."""

import argparse
import sys

from mag_tracking.cli import (
    calibrate,
    doctor,
    fit,
    geometry,
    listen,
    plan,
    record,
    recordings,
    replay,
)
from mag_tracking.errors import MagTrackingError


def _parser():
    """The command line."""
    parser = argparse.ArgumentParser(
        prog='mag-tracking', description='Track magnetic targets with stationary magnetometers.')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for module in (replay, calibrate, geometry, doctor, fit, plan, listen, record, recordings):
        module.add(commands)
    return parser


def main(argv=None):
    """Run the command; returns its exit status (1 for an error that a message explains)."""
    args = _parser().parse_args(argv)
    try:
        return args.run_command(args)
    except (MagTrackingError, OSError) as error:
        # An OSError here is a full disk or a lost drive; its text names the file.
        print(f'mag-tracking: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print('mag-tracking: interrupted', file=sys.stderr)
        return 130
