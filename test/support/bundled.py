"""Where the bundled recordings are, and settings that several tests use."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / 'test' / 'data'
VEHICLES = sorted(p.stem for p in (DATA / 'vehicles').glob('*.mcap'))
NETWORK_FILE = ROOT / 'config' / 'network.yaml'

POINT = {f'track.vehicle.{name}': [value] for name, value in {
    'kinds': 'car', 'lengths': 0.0, 'length_stds': 0.0, 'moments': 400.0, 'moment_stds': 150.0,
    'difference_stds': 0.0, 'heights': 0.5, 'height_stds': 0.2,
    'near_field_lengths': 1.0}.items()} | {'track.vehicle.turn_acceleration': 0.0}
"""Settings of a tracker that knows only point targets which go straight on."""


def vehicle_path(name):
    return DATA / 'vehicles' / f'{name}.mcap'
