"""Options of tracking commands, and the settings that they select."""

import argparse
from pathlib import Path

from mag_tracking.network import SensorNetwork
from mag_tracking.network.sensor_network import MAX_BOARD_EXTENT
from mag_tracking.pipeline import TARGET_DEFAULTS, Settings, settings_for
from mag_tracking.settings import read_parameter_file


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add --target and --params."""
    parser.add_argument('--params', type=Path, metavar='FILE',
                        help='YAML file with the settings to override')
    parser.add_argument('--target', choices=list(TARGET_DEFAULTS),
                        help='type of target: a vehicle, a magnet in a hand, or a magnet on a '
                        'bench (default: magnet for a board of sensors, otherwise vehicle)')


def settings_of(args: argparse.Namespace, network: SensorNetwork) -> Settings:
    """Settings of --target and --params; raises SettingsError if the parameter file is invalid.

    Without both, a board of sensors selects a magnet, and a line is printed.
    """
    changes = read_parameter_file(args.params) if args.params else {}
    if args.target is not None:
        return settings_for(args.target, changes)
    if 'track.target' in changes or not network.is_board:
        return settings_for(changes.get('track.target', 'vehicle'), changes)
    print(f'{args.network}: {len(network)} sensors within {MAX_BOARD_EXTENT:g} m: the settings for '
          'a magnet are used; --target vehicle selects those for vehicles')
    return settings_for('magnet', changes)
