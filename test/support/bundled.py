"""Paths of the bundled recordings, and settings that several tests use."""

from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / 'test' / 'data'
VEHICLES = sorted(p.stem for p in (DATA / 'vehicles').glob('*.mcap'))
NETWORK_FILE = ROOT / 'config' / 'network.yaml'

POINT = {'track.vehicle.kinds.names': ['car'], 'track.vehicle.kinds.car.length': 0.0,
         'track.vehicle.kinds.car.length_std': 0.0, 'track.vehicle.kinds.car.difference_std': 0.0,
         'track.vehicle.kinds.car.near_field_length': 1.0, 'track.vehicle.turn_acceleration': 0.0}
"""Settings of a tracker that models only point targets on straight paths."""
LINEARISED_ONCE = {'track.relinearise_window_s': 0.0}
"""Settings without relinearisation, which takes most of the computing time."""
QUICK = POINT | LINEARISED_ONCE
"""Settings for point targets without relinearisation, for tests that do not check the tracking.
They need a third of the computing time."""


def parameter_file(path, changes):
    """Write `changes` ({dotted name: value}) as a parameter file; return its path."""
    content = {}
    for name, value in changes.items():
        *groups, last = name.split('.')
        group = content
        for g in groups:
            group = group.setdefault(g, {})
        group[last] = value
    path.write_text(yaml.safe_dump(content))
    return path


def vehicle_path(name):
    return DATA / 'vehicles' / f'{name}.mcap'
