"""What a calibration had learnt of the backgrounds, kept for the case that it is started again.

A network file says what holds for years; this is of the last minute, and goes with the readings.
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
from mag_tracking.stages.calibrate.restoration import StoredBackground
from mag_tracking.stages.calibrate.settings import CalibrateSettings

VERSION = 1
_HEAD = '{"version": '


def default_path(network_path: str | PathLike[str], node: str) -> Path:
    """Where node `node` keeps the backgrounds of a network file, in the state folder."""
    path = Path(network_path).resolve()
    mark = hashlib.sha256(f'{path} {node}'.encode()).hexdigest()[:8]
    return state_folder() / f'{path.stem}_{mark}.json'


def is_background_file(path: Path) -> bool:
    """Whether a file begins as one with backgrounds does."""
    with open(path, 'rb') as stream:
        return stream.read(len(_HEAD)) == _HEAD.encode()


def state_folder() -> Path:
    """The folder of what nodes keep: below $ROS_HOME, or ~/.ros."""
    return Path(os.environ.get('ROS_HOME') or Path.home() / '.ros') / 'mag_tracking'


def _made_of(network: SensorNetwork, j: int, settings: CalibrateSettings) -> list[Any]:
    """All that a background of sensor `j` rests on, as lists: where that differs, it is another."""
    arrays = (network.offset[j], network.correction[j], network.clock_offset[j],
              network.background[j], network.noise_std[j], network.positions[j], network.R_ws[j])
    return [None if a is None else np.asarray(a).tolist() for a in arrays] \
        + [settings.decimate_to_hz]


def background_text(stored: StoredBackground, network: SensorNetwork, j: int,
                    settings: CalibrateSettings) -> str:
    """JSON of the background of sensor `j`; `settings` are `CalibrateSettings`."""
    return json.dumps({'stamp_ns': stored.stamp_ns, 'background': stored.background.tolist(),
                       'covariance': stored.covariance.tolist(),
                       'made_of': _made_of(network, j, settings)})


def write_backgrounds(path: str | PathLike[str], texts: Mapping[str, str]) -> None:
    """Write {sensor: `background_text`}; what was there stays whole until the new is.

    Raises OutputError.
    """
    path = Path(path)
    rows = ',\n'.join(f'{json.dumps(name)}: {text}' for name, text in texts.items())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f'{path}: {error.strerror}') from error
    replace_text(path, f'{_HEAD}{VERSION}, "sensors": {{\n{rows}\n}}}}\n')


def read_backgrounds(path: str | PathLike[str], network: SensorNetwork,
                     settings: CalibrateSettings
                     ) -> tuple[dict[str, StoredBackground], dict[str, str]]:
    """What was kept of the sensors of `network`, as far as it rests on the same.

    Returns
    -------
    stored : {sensor: `StoredBackground`}
        {} where there is no file.
    refused : {sensor: why}
        Of what cannot be used.

    Raises RecordingError where the file is none of this kind.
    """
    try:
        content = json.loads(Path(path).read_text())
    except FileNotFoundError:
        return {}, {}
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f'{path}: {error}') from error
    entries = content.get('sensors') if isinstance(content, dict) else None
    if not isinstance(entries, dict) or content.get('version') != VERSION:
        raise RecordingError(f'{path}: not what calibration_node keeps, version {VERSION}')
    stored: dict[str, StoredBackground] = {}
    refused: dict[str, str] = {}
    for j, name in enumerate(network.names):
        try:
            if name in entries and entries[name]['made_of'] != _made_of(network, j, settings):
                refused[name] = 'it is of another network file or of other settings'
            elif name in entries:
                stored[name] = _stored(entries[name])
        except (KeyError, TypeError, ValueError) as error:
            refused[name] = f'{type(error).__name__}: {error}'
    return stored, refused


def _stored(entry: Any) -> StoredBackground:
    """`StoredBackground` of an entry; raises ValueError where its numbers are none."""
    background = np.array(entry['background'], dtype=float)
    covariance = np.array(entry['covariance'], dtype=float)
    if background.shape != (3,) or covariance.shape != (3, 3) or np.isinf(background).any() \
            or not isinstance(entry['stamp_ns'], int):
        raise ValueError(f'a background of {background.tolist()} at {entry["stamp_ns"]}')
    there = ~np.isnan(background)
    C = covariance[np.ix_(there, there)]
    if not there.any() or not np.isfinite(C).all() or np.linalg.eigvalsh(C)[0] <= 0.0:
        raise ValueError('a covariance that is not positive definite')
    return StoredBackground(entry['stamp_ns'], background, covariance)
