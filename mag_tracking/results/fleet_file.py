"""JSON file of enrolled vehicles. It contains every pass, so that passes can be added later."""

import json
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import RecordingError
from mag_tracking.files import checked_path, replace_text

VERSION = 1
"""Version of the file format."""


@dataclass(frozen=True)
class FleetPass:
    """One pass of an enrolled vehicle."""

    moment: FloatArray
    """Magnetic moment, (3,) A m², world frame."""
    covariance: FloatArray
    """Covariance of `moment`, (3, 3) (A m²)², world frame."""
    heading: float
    """Heading, rad, anticlockwise from x."""
    source: str
    """Name of the recording, and index of the passage in it."""


def read_fleet(path: str | PathLike[str]) -> dict[str, list[FleetPass]]:
    """Passes of enrolled vehicles by name; raises RecordingError for a file of another version."""
    path = checked_path(path, RecordingError)
    try:
        with open(path, encoding='utf-8') as stream:
            content = json.load(stream)
        if content['mag_tracking.fleet'] != VERSION:
            raise RecordingError(f'{path}: fleet version {content["mag_tracking.fleet"]} is not '
                                 f'supported; expected {VERSION}')
        return {str(name): [FleetPass(
            np.array(p['moment'], dtype=float).reshape(3),
            np.array(p['covariance'], dtype=float).reshape(3, 3), float(p['heading']),
            str(p['source'])) for p in passes] for name, passes in content['vehicles'].items()}
    except OSError as error:
        raise RecordingError(f'cannot read {path}: {error.strerror}') from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(
            f'{path} is not a valid fleet file (missing or invalid: {error})') from error


def write_fleet(path: Path, fleet: dict[str, list[FleetPass]]) -> None:
    """Write the passes of enrolled vehicles atomically."""
    vehicles = {name: [{k: v.tolist() if isinstance(v, np.ndarray) else v
                        for k, v in asdict(p).items()} for p in passes]
                for name, passes in fleet.items()}
    replace_text(path, json.dumps({'mag_tracking.fleet': VERSION, 'vehicles': vehicles},
                                  indent=1) + '\n')
