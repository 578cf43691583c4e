"""Options of tracking commands, and the settings that they select."""

import argparse
from pathlib import Path

from mag_tracking.pipeline import TARGET_DEFAULTS, Settings, settings_for
from mag_tracking.settings import read_parameter_file


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add --target and --params.

    Parameters
    ----------
    parser : argparse.ArgumentParser
    """
    parser.add_argument('--params', type=Path, metavar='FILE',
                        help='YAML file with the settings to override')
    parser.add_argument('--target', choices=list(TARGET_DEFAULTS), default='vehicle',
                        help='type of target (default: vehicle)')


def settings_of(args: argparse.Namespace) -> Settings:
    """Return the settings selected by --target and --params.

    Parameters
    ----------
    args : argparse.Namespace
        Parsed arguments with the options of `add_settings`.

    Returns
    -------
    Settings

    Raises
    ------
    SettingsError
        If the parameter file is invalid.
    """
    changes = read_parameter_file(args.params) if args.params else {}
    return settings_for(args.target, changes)
