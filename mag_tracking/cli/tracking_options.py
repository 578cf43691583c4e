"""The options of commands that track, and the settings that they ask for."""

import argparse
from pathlib import Path

from mag_tracking.pipeline import TARGET_DEFAULTS, Settings, settings_for
from mag_tracking.settings import read_parameter_file


def add_settings(parser: argparse.ArgumentParser) -> None:
    """--target and --params."""
    parser.add_argument('--params', type=Path, metavar='FILE', help='settings that differ')
    parser.add_argument('--target', choices=list(TARGET_DEFAULTS), default='vehicle',
                        help='what moves (default: vehicle)')


def settings_of(args: argparse.Namespace) -> Settings:
    """Settings of the command line's target and parameter file."""
    changes = read_parameter_file(args.params) if args.params else {}
    return settings_for(args.target, changes)
