"""Background file, in which calibration_node stores learnt backgrounds for a restart.

A network file contains parameters that stay valid for years. A background file contains the current
background of each sensor, which is soon outdated.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mag_tracking.errors import OutputError, RecordingError
from mag_tracking.files import replace_text
from mag_tracking.network import SensorNetwork
from mag_tracking.stages.calibrate.stage import StoredBackground
from mag_tracking.stages.settings import CalibrateSettings

VERSION = 1
_HEAD = '{"version": '


def default_path(network_path: str | PathLike[str], node: str) -> Path:
    """File in the state folder in which a node (full name) stores a network's backgrounds."""
    path = Path(network_path).resolve()
    digest = hashlib.sha256(f'{path} {node}'.encode()).hexdigest()[:8]
    return state_folder() / f'{path.stem}_{digest}.json'


def is_background_file(path: Path) -> bool:
    """Whether a file begins with the header of a background file."""
    with open(path, 'rb') as stream:
        return stream.read(len(_HEAD)) == _HEAD.encode()


def state_folder() -> Path:
    """Folder of the nodes' persistent state, below $ROS_HOME or ~/.ros."""
    return Path(os.environ.get('ROS_HOME') or Path.home() / '.ros') / 'mag_tracking'


def _dependencies(network: SensorNetwork, j: int, settings: CalibrateSettings) -> list[Any]:
    """Parameters on which the background of sensor `j` depends, as comparable lists."""
    arrays = (network.offset[j], network.correction[j], network.clock_offset[j],
              network.background[j], network.noise_std[j], network.positions[j], network.R_ws[j])
    return [None if a is None else np.asarray(a).tolist() for a in arrays] \
        + [settings.decimate_to_hz]


def background_text(stored: StoredBackground, network: SensorNetwork, j: int,
                    settings: CalibrateSettings) -> str:
    """Serialise the background of sensor `j` as JSON."""
    return json.dumps({'stamp_ns': stored.stamp_ns, 'background': stored.background.tolist(),
                       'covariance': stored.covariance.tolist(),
                       'made_of': _dependencies(network, j, settings)})


def write_backgrounds(path: str | PathLike[str], texts: Mapping[str, str]) -> None:
    """Write the backgrounds of all sensors (`background_text` by name) atomically."""
    path = Path(path)
    rows = ',\n'.join(f'{json.dumps(name)}: {text}' for name, text in texts.items())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f'cannot write {path}: {error.strerror}') from error
    replace_text(path, f'{_HEAD}{VERSION}, "sensors": {{\n{rows}\n}}}}\n')


def read_backgrounds(path: str | PathLike[str], network: SensorNetwork,
                     settings: CalibrateSettings
                     ) -> tuple[dict[str, StoredBackground], dict[str, str]]:
    """Usable backgrounds, and the reasons for those refused, by sensor; none if the file is
    missing, and RecordingError for another kind or version."""
    try:
        content = json.loads(Path(path).read_text())
    except FileNotFoundError:
        return {}, {}
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f'cannot read {path}: {error}') from error
    entries = content.get('sensors') if isinstance(content, dict) else None
    if not isinstance(entries, dict) or content.get('version') != VERSION:
        raise RecordingError(f'{path} is not a background file of version {VERSION}')
    stored: dict[str, StoredBackground] = {}
    refused: dict[str, str] = {}
    for j, name in enumerate(network.names):
        try:
            if name in entries and entries[name]['made_of'] != _dependencies(network, j, settings):
                refused[name] = 'it was stored for another network file or other settings'
            elif name in entries:
                stored[name] = _background_of(entries[name])
        except KeyError as error:
            refused[name] = f'the stored entry has no {error.args[0]}'
        except TypeError:
            refused[name] = 'the stored entry is not valid'
        except ValueError as error:
            refused[name] = f'the stored entry is not valid: {error}'
    return stored, refused


def _background_of(entry: Any) -> StoredBackground:
    """Parse an entry of the file; raises KeyError, TypeError or ValueError if it is invalid."""
    background = np.array(entry['background'], dtype=float)
    covariance = np.array(entry['covariance'], dtype=float)
    if background.shape != (3,) or covariance.shape != (3, 3) or np.isinf(background).any() \
            or not isinstance(entry['stamp_ns'], int):
        raise ValueError(f'the background {background.tolist()}, its covariance or its timestamp '
                         f'(stamp_ns {entry["stamp_ns"]}) is invalid')
    is_known = ~np.isnan(background)
    C = covariance[np.ix_(is_known, is_known)]
    if not is_known.any() or not np.isfinite(C).all() or np.linalg.eigvalsh(C)[0] <= 0.0:
        raise ValueError('the covariance is not positive definite')
    return StoredBackground(entry['stamp_ns'], background, covariance)
