"""`network.yaml`: the geometry and calibration of a sensor network."""

import datetime
import json
import re
from collections.abc import Collection, Iterable
from os import PathLike
from typing import Any

import numpy as np
import yaml

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import NetworkError
from mag_tracking.files import replace_text
from mag_tracking.geometry import quaternion_from_rotation, rotation_from_quaternion
from mag_tracking.network import Calibrated, SensorNetwork
from mag_tracking.network.geomagnetic import Site, decimal_year, earth_field
from mag_tracking.network.topics import NAME
from mag_tracking.yaml_file import is_text, read_yaml, shown

_NAME = re.compile(r'[A-Za-z0-9_.-]+')
_FRAME = re.compile(r'[A-Za-z0-9_./-]+')
_TOP = {'frame', 'earth_field', 'site', 'sensors'}
_SITE = ('latitude', 'longitude', 'height', 'date', 'x_azimuth_deg')
_SENSOR = {'position', 'orientation', 'orientation_std_deg', 'clock_offset', 'noise_std',
           'background', 'offset', 'correction', 'topic', 'imu_topic', 'calibrated'}

_LONGEST = 1e8
"""[m] No position is farther from the origin: room for any frame of the Earth."""

_QUIETEST = 1e-15
"""[T] No sensor is quieter."""

_MAX_OFFSET = 3600.0
"""[s] A clock that is off by more is to be set, not corrected."""


def _vector(what: str, value: object, lengths: tuple[int, ...]) -> FloatArray:
    """A list of finite numbers of one of `lengths`, as an array."""
    if not isinstance(value, list) or len(value) not in lengths:
        raise NetworkError(f'{what}: expected {" or ".join(map(str, lengths))} numbers, '
                           f'got {shown(value)}')
    for v in value:
        # YAML 1.1 reads 1e-8, without a point, as text, and 1.0e8, without a sign, too.
        if isinstance(v, str):
            raise NetworkError(f'{what}: {shown(v)} is text; write numbers as 1.0e-8 or 1.0e+8')
        if isinstance(v, bool) or not isinstance(v, (int, float)) or not abs(v) < 1e300:
            raise NetworkError(f'{what}: {shown(v)} is not a finite number')
    return np.array(value, dtype=float)


def _known(what: str, mapping: object, keys: Collection[str]) -> None:
    """Raise NetworkError for a key that is not among `keys`."""
    if not isinstance(mapping, dict):
        raise NetworkError(f'{what}: expected a mapping, got {shown(mapping)}')
    for key in mapping:
        if key not in keys:
            raise NetworkError(f'{what}: unknown key {shown(key)}; known are '
                               f'{", ".join(sorted(keys))}')


def _sensor(name: str, entry: Any) -> dict[str, Any]:
    """The values of one entry, by the names that `SensorNetwork` has for them."""
    what = f'sensor {name}'
    _known(what, entry, _SENSOR)
    if 'position' not in entry:
        raise NetworkError(f'{what}: position is missing')
    position = _vector(f'{what}: position', entry['position'], (3,))
    if np.abs(position).max() > _LONGEST:
        raise NetworkError(f'{what}: position: {position.tolist()} m is nowhere on Earth')
    q = _vector(f'{what}: orientation', entry.get('orientation', [0, 0, 0, 1]), (4,))
    R_ws = _rotation(f'{what}: orientation', q)
    topic = _topic(what, 'topic', entry.get('topic', f'{name}/imu/mag'))
    # Where a driver puts a sensor's accelerometer, by REP-145, beside its magnetometer.
    beside = topic.removesuffix('/mag') + '/data_raw' if topic.endswith('/mag') else None
    imu_topic = entry.get('imu_topic', beside)
    return {'positions': position, 'R_ws': R_ws, 'topics': topic,
            'imu_topics': None if imu_topic is None else _topic(what, 'imu_topic', imu_topic),
            'noise_std': _noise(what, entry.get('noise_std')),
            'background': _small_field(what, 'background', entry.get('background')),
            'offset': _small_field(what, 'offset', entry.get('offset')),
            'correction': _correction(what, entry.get('correction')),
            'orientation_std': _orientation_std(what, entry.get('orientation_std_deg')),
            'clock_offset': _clock_offset(what, entry.get('clock_offset', 0.0)),
            'calibrated': _calibrated(what, entry.get('calibrated'))}


def _noise(what: str, noise: object) -> FloatArray | None:
    """(3,) [T] of one number or three."""
    if noise is None:
        return None
    numbers = noise if isinstance(noise, list) else [noise]
    std = _vector(f'{what}: noise_std', numbers, (1, 3)) * np.ones(3)
    if not ((std >= _QUIETEST) & (std < 1e-3)).all():
        raise NetworkError(f'{what}: noise_std must be above a femtotesla and below a '
                           f'millitesla, got {std.tolist()} T')
    return std


def _small_field(what: str, key: str, value: object) -> FloatArray | None:
    """(3,) [T] of three numbers."""
    if value is None:
        return None
    B = _vector(f'{what}: {key}', value, (3,))
    if np.abs(B).max() > 0.1:
        raise NetworkError(f'{what}: {key}: {B.tolist()} T is more than 0.1 T; is it in '
                           'microtesla or gauss?')
    return B


def _correction(what: str, value: object) -> FloatArray | None:
    """(3, 3) of nine numbers."""
    if value is None:
        return None
    matrix = _vector(f'{what}: correction', value, (9,)).reshape(3, 3)
    singular = np.linalg.svd(matrix, compute_uv=False)
    if not singular[-1] > 0.02 * singular[0]:
        raise NetworkError(f'{what}: correction: {matrix.ravel().tolist()} takes away a direction')
    return matrix


def _orientation_std(what: str, value: object) -> FloatArray | None:
    """(3,) [rad] of one number or three [deg]."""
    if value is None:
        return None
    numbers = value if isinstance(value, list) else [value]
    std = _vector(f'{what}: orientation_std_deg', numbers, (1, 3)) * np.ones(3)
    if not ((std > 0.0) & (std <= 180.0)).all():
        raise NetworkError(f'{what}: orientation_std_deg must be above 0 and at most 180 degrees, '
                           f'got {std.tolist()}')
    return np.deg2rad(std)


def _clock_offset(what: str, value: object) -> float:
    """[s]."""
    offset = _vector(f'{what}: clock_offset', [value], (1,))[0]
    if abs(offset) > _MAX_OFFSET:
        raise NetworkError(f'{what}: clock_offset: {offset} s is more than {_MAX_OFFSET:g} s; '
                           'set the clock')
    return float(offset)


def _calibrated(what: str, value: Any) -> Calibrated | None:
    """`Calibrated`."""
    if value is None:
        return None
    what = f'{what}: calibrated'
    _known(what, value, {'date', 'by', 'clock_offset_std', 'stated', 'stated_std_deg'})
    for key in ('date', 'by'):
        if not isinstance(value.get(key), str) or not is_text(value[key]):
            raise NetworkError(f"{what}: {key} must be text ('...'), "
                               f'got {shown(value.get(key))}')
    std, stated = value.get('clock_offset_std'), value.get('stated')
    std = float('nan') if std is None else float(_vector(what, [std], (1,))[0])
    if std < 0.0:
        raise NetworkError(f'{what}: clock_offset_std: {std} s is negative')
    if stated is not None:
        stated = _vector(f'{what}: stated', stated, (4,))
        _rotation(f'{what}: stated', stated)
        stated = tuple(stated.tolist())
    spread = _orientation_std(what, value.get('stated_std_deg'))
    return Calibrated(value['date'], value['by'], std, stated,
                      None if spread is None else tuple(spread.tolist()))


def _rotation(what: str, q: FloatArray) -> FloatArray:
    """(3, 3) of a quaternion."""
    try:
        return rotation_from_quaternion(q)
    except ValueError as error:
        raise NetworkError(f'{what}: {error}') from error


def _topic(what: str, key: str, topic: object) -> str:
    """A topic's name."""
    if not isinstance(topic, str) or not NAME.fullmatch(topic):
        raise NetworkError(f'{what}: {key}: {shown(topic)} is not a ROS topic: letters, digits and '
                           '_, and no part begins with a digit')
    return topic


def read_network(path: str | PathLike[str]) -> SensorNetwork:
    """The `SensorNetwork` in a file; raises NetworkError, which names file and key."""
    content = read_yaml(path, NetworkError)
    try:
        return _network(content)
    except NetworkError as error:
        raise NetworkError(f'{path}: {error}') from error


def _network(content: Any) -> SensorNetwork:
    """The network of the parsed file."""
    _known('the file', content, _TOP)
    sensors = content.get('sensors')
    if not isinstance(sensors, dict) or not sensors:
        raise NetworkError('sensors: expected at least one sensor')
    earth = _earth_field(content)
    frame = content.get('frame', 'map')
    if not isinstance(frame, str) or not _FRAME.fullmatch(frame):
        raise NetworkError(f'frame: expected a name, got {shown(frame)}')
    names = tuple(str(name) for name in sensors)
    for name in names:
        if not _NAME.fullmatch(name):
            raise NetworkError(f'{shown(name)} is no name for a sensor: letters, digits, _ . and -')
    entries = [_sensor(n, e) for n, e in zip(names, sensors.values(), strict=True)]
    columns: dict[str, Any] = {key: tuple(e[key] for e in entries) for key in entries[0]}
    for key in ('positions', 'R_ws', 'clock_offset'):
        columns[key] = np.array(columns[key])
    return SensorNetwork(names, frame=frame, earth_field=earth, **columns)


def _earth_field(content: dict[str, Any]) -> FloatArray | None:
    """(3,) [T] as it is given, or by the World Magnetic Model at the site; None without both."""
    earth, site = content.get('earth_field'), content.get('site')
    if earth is not None and site is not None:
        raise NetworkError('earth_field and site are both there, and each says the field: '
                           'leave one out')
    if earth is not None:
        earth = _vector('earth_field', earth, (3,))
        if np.linalg.norm(earth) > 1e-3:
            raise NetworkError(f'earth_field: {earth.tolist()} T is more than a millitesla; '
                               'is it in microtesla or gauss?')
    if site is None:
        return earth
    _known('site', site, _SITE)
    missing = [key for key in _SITE if key not in site]
    if missing:
        raise NetworkError(f'site: {missing[0]} is missing')
    day = site['date']
    if not isinstance(day, datetime.date) or isinstance(day, datetime.datetime):
        raise NetworkError(f'site: date: expected a day such as 2026-05-01, got {shown(day)}')
    latitude, longitude, height, azimuth = _vector('site', [
        site[key] for key in ('latitude', 'longitude', 'height', 'x_azimuth_deg')], (4,))
    try:
        return earth_field(Site(latitude, longitude, height, decimal_year(day), azimuth))
    except ValueError as error:
        raise NetworkError(f'site: {error}') from error
    except ModuleNotFoundError as error:
        raise NetworkError('site: the World Magnetic Model needs pygeomag (pip install pygeomag); '
                           'or give earth_field instead') from error


def _numbers(values: Iterable[float]) -> str:
    """A flow list that YAML reads back as floats."""
    return '[' + ', '.join(_number(v) for v in values) + ']'


def _number(value: float) -> str:
    """A float with a point, which YAML 1.1 wants before an exponent."""
    text = repr(float(value))
    return text.replace('e', '.0e') if 'e' in text and '.' not in text else text


def _sensor_lines(network: SensorNetwork, i: int) -> list[str]:
    """The entry of sensor `i`."""
    lines = [f'  {_text(network.names[i])}:', f'    position: {_numbers(network.positions[i])}',
             f'    orientation: {_numbers(quaternion_from_rotation(network.R_ws[i]))}']
    std = network.orientation_std[i]
    if std is not None:
        lines.append(f'    orientation_std_deg: {_numbers(np.rad2deg(std))}')
    if network.clock_offset[i]:
        lines.append(f'    clock_offset: {_number(network.clock_offset[i])}')
    for key in ('noise_std', 'background', 'offset', 'correction'):
        value = getattr(network, key)[i]
        if value is not None:
            lines.append(f'    {key}: {_numbers(np.ravel(value))}')
    lines.append(f'    topic: {network.topics[i]}')
    lines.append(f'    imu_topic: {network.imu_topics[i] or "null"}')
    done = network.calibrated[i]
    if done is not None:
        lines += ['    calibrated:', f'      date: {json.dumps(done.date)}',
                  f'      by: {json.dumps(done.by)}']
        if not np.isnan(done.clock_offset_std):
            lines.append(f'      clock_offset_std: {_number(done.clock_offset_std)}')
        if done.stated is not None:
            lines.append(f'      stated: {_numbers(done.stated)}')
        if done.stated_std is not None:
            lines.append(f'      stated_std_deg: {_numbers(np.rad2deg(done.stated_std))}')
    return lines


def _text(text: str) -> str:
    """Text as YAML that reads back as the same text: 'no' and '01' would not."""
    return text if yaml.safe_load(text) == text else json.dumps(text)


def write_network(path: str | PathLike[str], network: SensorNetwork, comment: str = '') -> None:
    """Write a network file; one that was there is replaced as a whole, or not at all.

    Parameters
    ----------
    path : path-like
    network : SensorNetwork
    comment : str
        Lines for the head of the file.

    Raises OutputError where the file cannot be written.
    """
    lines = [f'# {line}' for line in comment.splitlines()] + [f'frame: {_text(network.frame)}']
    if network.earth_field is not None:
        lines.append(f'earth_field: {_numbers(network.earth_field)}')
    lines.append('sensors:')
    for i in range(len(network)):
        lines += _sensor_lines(network, i)
    replace_text(path, '\n'.join(lines) + '\n')
