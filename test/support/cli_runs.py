"""Command-line replays with fast settings."""

from mag_tracking.cli import main
from support.bundled import NETWORK_FILE, QUICK, parameter_file, vehicle_path

NAME = 'junction_left_to_right'
"""Name of the replayed recording."""


def quick_file(folder):
    """Write a parameter file with the settings `QUICK` to `folder`; return its path."""
    return parameter_file(folder / 'quick.yaml', QUICK)


def replay_one(out, *options):
    """Replay one recording with the settings `QUICK` into `out`; return the exit status."""
    return main(['replay', str(vehicle_path(NAME)), '--network', str(NETWORK_FILE), '--params',
                 str(quick_file(out.parent)), '--out', str(out), *options])
