"""`network.yaml`: the geometry and calibration of a sensor network."""

import re

import numpy as np

from mag_tracking.errors import NetworkError, OutputError
from mag_tracking.geometry import rotation_from_quaternion
from mag_tracking.network import SensorNetwork
from mag_tracking.yaml_file import read_yaml

_TOPIC = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')
_NAME = re.compile(r'[A-Za-z0-9_.-]+')
_FRAME = re.compile(r'[A-Za-z0-9_./-]+')
_TOP = {'frame', 'earth_field', 'sensors'}
_SENSOR = {'position', 'orientation', 'noise_std', 'background', 'topic'}


_LONGEST = 1e8
"""[m] No position is farther from the origin: room for any frame of the Earth."""

_QUIETEST = 1e-15
"""[T] No sensor is quieter."""


def _vector(what, value, lengths):
    """A list of finite numbers of one of `lengths`, as an array."""
    if not isinstance(value, list) or len(value) not in lengths:
        raise NetworkError(f'{what}: expected {" or ".join(map(str, lengths))} numbers, '
                           f'got {value!r}')
    for v in value:
        # YAML 1.1 reads 1e-8, without a point, as text, and 1.0e8, without a sign, too.
        if isinstance(v, str):
            raise NetworkError(f'{what}: {v!r} is text; write numbers as 1.0e-8 or 1.0e+8')
        if isinstance(v, bool) or not isinstance(v, (int, float)) or not abs(v) < 1e300:
            raise NetworkError(f'{what}: {v!r} is not a finite number')
    return np.array(value, dtype=float)


def _known(what, mapping, keys):
    """Raise NetworkError for a key that is not among `keys`."""
    if not isinstance(mapping, dict):
        raise NetworkError(f'{what}: expected a mapping, got {mapping!r}')
    for key in mapping:
        if key not in keys:
            raise NetworkError(f'{what}: unknown key {key!r}; known are '
                               f'{", ".join(sorted(keys))}')


def _sensor(name, entry):
    """(position, R_ws, noise_std, background, topic) of one entry."""
    _known(f'sensor {name}', entry, _SENSOR)
    if 'position' not in entry:
        raise NetworkError(f'sensor {name}: position is missing')
    position = _vector(f'sensor {name}: position', entry['position'], (3,))
    if np.abs(position).max() > _LONGEST:
        raise NetworkError(f'sensor {name}: position: {position.tolist()} m is nowhere on Earth')
    q = _vector(f'sensor {name}: orientation', entry.get('orientation', [0, 0, 0, 1]), (4,))
    try:
        R_ws = rotation_from_quaternion(q)
    except ValueError as error:
        raise NetworkError(f'sensor {name}: orientation: {error}') from error
    noise = entry.get('noise_std')
    if noise is not None:
        noise = noise if isinstance(noise, list) else [noise]
        noise = _vector(f'sensor {name}: noise_std', noise, (1, 3)) * np.ones(3)
        if not ((noise >= _QUIETEST) & (noise < 1e-3)).all():
            raise NetworkError(f'sensor {name}: noise_std must be above a femtotesla and below a '
                               f'millitesla, got {noise.tolist()} T')
    background = entry.get('background')
    if background is not None:
        background = _vector(f'sensor {name}: background', background, (3,))
        if np.abs(background).max() > 0.1:
            raise NetworkError(f'sensor {name}: background: {background.tolist()} T is more than '
                               '0.1 T; is it in microtesla or gauss?')
    topic = entry.get('topic', f'/{name}/imu/mag')
    if not isinstance(topic, str) or not topic.startswith('/'):
        raise NetworkError(f'sensor {name}: topic must begin with /, got {topic!r}')
    if not _TOPIC.fullmatch(topic):
        raise NetworkError(f'sensor {name}: {topic!r} is no ROS topic: letters, digits and _, '
                           'no part begins with a digit')
    return position, R_ws, noise, background, topic


def read_network(path):
    """The `SensorNetwork` in a file; raises NetworkError, which names file and key."""
    content = read_yaml(path, NetworkError)
    try:
        return _network(content)
    except NetworkError as error:
        raise NetworkError(f'{path}: {error}') from error


def _network(content):
    """The network of the parsed file."""
    _known('the file', content, _TOP)
    sensors = content.get('sensors')
    if not isinstance(sensors, dict) or not sensors:
        raise NetworkError('sensors: expected at least one sensor')
    earth = content.get('earth_field')
    if earth is not None:
        earth = _vector('earth_field', earth, (3,))
        if np.linalg.norm(earth) > 1e-3:
            raise NetworkError(f'earth_field: {earth.tolist()} T is more than a millitesla; '
                               'is it in microtesla or gauss?')
    frame = content.get('frame', 'map')
    if not isinstance(frame, str) or not _FRAME.fullmatch(frame):
        raise NetworkError(f'frame: expected a name, got {frame!r}')
    names = tuple(str(name) for name in sensors)
    for name in names:
        if not _NAME.fullmatch(name):
            raise NetworkError(f'{name!r} is no name for a sensor: letters, digits, _ . and -')
    parts = [_sensor(n, e) for n, e in zip(names, sensors.values(), strict=True)]
    position, R_ws, noise, background, topics = zip(*parts, strict=True)
    return SensorNetwork(names, np.array(position), np.array(R_ws), topics,
                         frame, earth, noise, background)


def _numbers(values):
    """A flow list that YAML reads back as floats."""
    return '[' + ', '.join(_number(v) for v in values) + ']'


def _number(value):
    """A float with a point, which YAML 1.1 wants before an exponent."""
    text = repr(float(value))
    return text.replace('e', '.0e') if 'e' in text and '.' not in text else text


def write_network(path, network, quaternions, comment=''):
    """Write a network file.

    Parameters
    ----------
    path : path-like
    network : SensorNetwork
    quaternions : (n, 4)
        Orientations xyzw, sensor to world (the network itself keeps matrices).
    comment : str
        Lines for the head of the file.

    Raises OutputError where the file cannot be written.
    """
    lines = [f'# {line}' for line in comment.splitlines()] + [f'frame: {network.frame}']
    if network.earth_field is not None:
        lines.append(f'earth_field: {_numbers(network.earth_field)}')
    lines.append('sensors:')
    for i, name in enumerate(network.names):
        lines += [f'  {name}:', f'    position: {_numbers(network.positions[i])}',
                  f'    orientation: {_numbers(quaternions[i])}']
        if network.noise_std[i] is not None:
            lines.append(f'    noise_std: {_numbers(network.noise_std[i])}')
        if network.background[i] is not None:
            lines.append(f'    background: {_numbers(network.background[i])}')
        lines.append(f'    topic: {network.topics[i]}')
    try:
        with open(path, 'w', encoding='utf-8') as stream:
            stream.write('\n'.join(lines) + '\n')
    except OSError as error:
        raise OutputError(f'cannot write {path}: {error.strerror}') from error
